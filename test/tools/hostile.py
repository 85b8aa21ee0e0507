# SPDX-License-Identifier: Apache-2.0
"""Files of weights that would do something when they are opened carelessly."""

from __future__ import annotations

import os
from pathlib import Path


class Marks:
    """Pickled, it makes a file when it is loaded carelessly."""

    def __init__(self, marker: Path) -> None:
        self.marker = marker

    def __reduce__(self) -> tuple[object, ...]:
        return os.system, (f"touch {self.marker}",)
