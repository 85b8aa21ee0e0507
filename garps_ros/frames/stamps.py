# SPDX-License-Identifier: Apache-2.0
"""Pairing of two message streams by their stamps. The rule is the same offline and live."""

from __future__ import annotations

from collections import deque
from typing import Any

MAX_WAITING, MAX_WAITING_LIVE = 60, 15
"""Largest number of items that wait for a partner, offline and live; image and depth of a camera take several MB."""
INTERVALS = 20
ENOUGH_INTERVALS = 3


class Pairer:
    """Pairs items of two streams whose stamps differ by at most `slop_ns`; each item is used once.

    Equal stamps always pair. Otherwise an item pairs with the nearest of the other stream unless that one is nearer
    to (or equal to) another: an item is held back until its stream has shown the next one. Stamps must grow within
    a stream; items that do not are refused, because after a jump back in time no order is left to rely on.

    Args:
        slop_ns: largest difference of a pair, nanoseconds; 0 = equal stamps only.
        live: do not hold an item back where its stream's rhythm says that the next one will be farther; for regular
            streams the pairs are the same, one period sooner.
    """

    def __init__(self, slop_ns: int, live: bool = False) -> None:
        self.slop_ns = slop_ns
        self._most_waiting = MAX_WAITING_LIVE if live else MAX_WAITING
        self._intervals: tuple[deque[int], deque[int]] | None = (
            (deque(maxlen=INTERVALS), deque(maxlen=INTERVALS)) if live else None
        )
        self.unpaired = [0, 0]
        """Items of each stream that found no partner."""
        self._waiting: tuple[deque[tuple[int, Any]], deque[tuple[int, Any]]] = (deque(), deque())
        self.latest = [-1, -1]
        """Newest stamp of each stream, ns; -1 before the first."""

    def add(self, stream: int, stamp_ns: int, item: Any) -> list[tuple[Any, Any]] | None:
        """Add an item to stream 0 or 1; return the pairs that are now certain, or None if its stamp does not grow."""
        if stamp_ns <= self.latest[stream]:
            return None
        if self._intervals is not None and self.latest[stream] >= 0:
            self._intervals[stream].append(stamp_ns - self.latest[stream])
        self.latest[stream] = stamp_ns
        self._waiting[stream].append((stamp_ns, item))
        pairs = self._matched(finished=False)
        if len(self._waiting[stream]) > self._most_waiting:  # the other stream has stopped
            self._drop(stream)
        return pairs

    def settle(self) -> list[tuple[Any, Any]]:
        """Return the pairs that wait for a better partner which is overdue; items without partner go on waiting."""
        return self._matched(finished=True)

    def finish(self) -> list[tuple[Any, Any]]:
        """Return the pairs that wait for a better partner, and drop the items without partner."""
        pairs = self._matched(finished=True)
        for stream in (0, 1):
            while self._waiting[stream]:
                self._drop(stream)
        return pairs

    def _matched(self, finished: bool) -> list[tuple[Any, Any]]:
        pairs = []
        while self._waiting[0] and self._waiting[1]:
            older = 0 if self._waiting[0][0][0] <= self._waiting[1][0][0] else 1
            queue, newest = self._waiting[older], self._waiting[1 - older][0][0]
            gap = newest - queue[0][0]
            if gap > self.slop_ns or (len(queue) > 1 and abs(queue[1][0] - newest) < gap):
                self._drop(older)
            elif gap == 0 or len(queue) > 1 or finished or self._next_is_farther(older, gap):
                pairs.append((self._waiting[0].popleft()[1], self._waiting[1].popleft()[1]))
            else:
                break
        return pairs

    def _next_is_farther(self, stream: int, gap: int) -> bool:
        """Tell whether the next item of the stream, one period on, will be farther away than `gap` (ns)."""
        intervals = self._intervals[stream] if self._intervals else ()
        return len(intervals) >= ENOUGH_INTERVALS and 10 * min(intervals) > 22 * gap

    def _drop(self, stream: int) -> None:
        self._waiting[stream].popleft()
        self.unpaired[stream] += 1
