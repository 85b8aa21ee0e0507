# SPDX-License-Identifier: Apache-2.0
"""A node's log in which no complaint drowns the others: each kind at most every few seconds."""

from __future__ import annotations

import time
from typing import Any

PERIOD_S = 5.0
"""/diagnostics counts what is left out here."""


class Log:
    """Writes to a logger of rclpy.

    Args:
        logger: with methods info, warning and error.
    """

    def __init__(self, logger: Any) -> None:
        self._logger = logger
        self._last_s: dict[str, float] = {}

    def info(self, text: str) -> None:
        """A line without limit, also from other threads."""
        self._logger.info(text)

    def warn(self, kind: str, text: str) -> None:
        """A warning, unless one of its kind has just been written."""
        if self._due(kind):
            self._logger.warning(text)

    def error(self, kind: str, text: str) -> None:
        """An error, unless one of its kind has just been written."""
        if self._due(kind):
            self._logger.error(text)

    def _due(self, kind: str) -> bool:
        now_s = time.monotonic()
        if now_s - self._last_s.get(kind, -PERIOD_S) < PERIOD_S:
            return False
        self._last_s[kind] = now_s
        return True
