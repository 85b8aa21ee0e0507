# SPDX-License-Identifier: Apache-2.0
"""A clock for tests that counts instead of measuring: it stands still except where a test or a sleep advances it."""

import time


class CountedTime:
    """Stands in for the module `time` of a module under test.

    Args:
        real_sleep: also let other threads and processes run for that long.
    """

    def __init__(self, real_sleep: bool = False) -> None:
        self.now_s = 1000.0
        """The time on this clock, s."""
        self._real_sleep = real_sleep

    def monotonic(self) -> float:
        return self.now_s

    def perf_counter(self) -> float:
        return self.now_s

    def monotonic_ns(self) -> int:
        return round(self.now_s * 1e9)

    def sleep(self, seconds: float) -> None:
        self.now_s += seconds
        if self._real_sleep:
            time.sleep(seconds)
