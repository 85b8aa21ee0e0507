# SPDX-License-Identifier: Apache-2.0
"""A node's log that writes each kind of warning at most every few seconds, so that the others stay visible."""

from __future__ import annotations

import time
from typing import Any

PERIOD_S = 5.0
"""Shortest time between two warnings of one kind, s; /diagnostics counts all."""


class Log:
    """Writes to a logger of rclpy.

    Args:
        logger: with methods info, warning and error.
    """

    def __init__(self, logger: Any) -> None:
        self._logger = logger
        self._last_s: dict[str, float] = {}

    def info(self, text: str) -> None:
        """Write a line, without limit and from any thread."""
        self._logger.info(text)

    def warn(self, kind: str, text: str) -> None:
        """Write a warning, unless one of its kind has just been written."""
        if self._due(kind):
            self._logger.warning(text)

    def error(self, kind: str, text: str) -> None:
        """Write an error, unless one of its kind has just been written."""
        if self._due(kind):
            self._logger.error(text)

    def _due(self, kind: str) -> bool:
        now_s = time.monotonic()
        if now_s - self._last_s.get(kind, -PERIOD_S) < PERIOD_S:
            return False
        self._last_s[kind] = now_s
        return True
