# SPDX-License-Identifier: Apache-2.0
"""What is known of one input from the arrivals of its messages: rate, age, delay, and how many seem to be missing."""

from __future__ import annotations

from collections import deque

import numpy as np

WINDOW = 100
"""Arrivals that statistics look back on."""
MANY_MISSING = 0.3
PAUSE_S = 5.0
"""A gap this long is no loss on the way: the publisher has paused."""


class Arrivals:
    """Arrival times and stamps of one topic."""

    def __init__(self) -> None:
        self.count = 0
        self._times_s: deque[float] = deque(maxlen=WINDOW)
        self._stamps_s: deque[float] = deque(maxlen=WINDOW)
        self._delays_s: deque[float] = deque(maxlen=WINDOW)

    def note(self, now_s: float, stamp_ns: int, clock_ns: int) -> None:
        """A message has arrived.

        Args:
            now_s: steady time, s.
            stamp_ns: of its header, ns.
            clock_ns: the ROS clock, ns; 0 when it is not running.
        """
        self.count += 1
        self._times_s.append(now_s)
        if self._stamps_s and not 0 < stamp_ns * 1e-9 - self._stamps_s[-1] < PAUSE_S:
            self._stamps_s.clear()
        self._stamps_s.append(stamp_ns * 1e-9)
        if clock_ns:
            self._delays_s.append((clock_ns - stamp_ns) * 1e-9)

    def age_s(self, now_s: float) -> float | None:
        """Steady time since the last arrival, s; None before the first."""
        return now_s - self._times_s[-1] if self._times_s else None

    def rate_hz(self, now_s: float, window_s: float = 5.0) -> float:
        """Arrivals per second over the last few seconds."""
        recent = [time for time in self._times_s if now_s - time <= window_s]
        if len(recent) < 2:
            return len(recent) / window_s
        return (len(recent) - 1) / max(recent[-1] - recent[0], 1e-6)

    def delay_ms(self) -> tuple[float, float] | None:
        """Median and largest time from stamp to arrival on the ROS clock, ms; None when that is not known."""
        if not self._delays_s:
            return None
        return 1000 * float(np.median(self._delays_s)), 1000 * max(self._delays_s)

    def missing(self) -> float:
        """Share of messages that seem to have been lost on the way, from gaps between stamps; 0 while unknown."""
        if len(self._stamps_s) < 10:
            return 0.0
        gaps = np.diff(np.asarray(self._stamps_s))
        # A low percentile is one period even where most messages are lost, and is no single burst either.
        period = float(np.percentile(gaps, 10))
        return max(0.0, 1.0 - len(gaps) * period / float(gaps.sum()))
