# SPDX-License-Identifier: Apache-2.0
"""One camera: the topics it speaks on, and what it saw at one time as messages."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any


@dataclass(frozen=True)
class CameraTopics:
    """The topics of one camera; empty = not known yet, or a depth that a network gives."""

    image: str = ""
    info: str = ""
    depth: str = ""

    def __str__(self) -> str:
        return f"image {self.image}, info {self.info}, depth {self.depth or 'from a network'}"


@dataclass(frozen=True)
class Frame:
    """What one camera saw at one time, as messages."""

    topics: CameraTopics
    stamp_ns: int
    image: Any
    depth: Any
    """None where a network gives it."""
    info: Any
