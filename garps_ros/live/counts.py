# SPDX-License-Identifier: Apache-2.0
"""Counts of the live node: messages refused, pairs rejected or dropped, poses used, and how long they took."""

from __future__ import annotations

from collections import Counter, deque
from dataclasses import dataclass, field

WINDOW = 200
"""Number of results that latencies look back on."""


@dataclass
class Counts:
    """Counts since the start, and latencies of the last results."""

    pairs_in: int = 0
    used: int = 0
    last_pair_s: float | None = None
    """Steady time at which frames last became complete, s."""
    dropped: Counter[str] = field(default_factory=Counter)
    """Pairs that were not computed or not published on purpose, by reason."""
    rejected: Counter[str] = field(default_factory=Counter)
    """Pairs without a usable pose, by status."""
    refused: Counter[str] = field(default_factory=Counter)
    """Messages that could not be used at all, by topic."""
    last_refused: str = ""
    last_rejected: str = ""
    last_status: str = ""
    errors: Counter[str] = field(default_factory=Counter)
    """Errors of the node itself: deaths of the worker, exceptions in callbacks."""
    last_error: str = ""
    restarts: int = 0
    """Number of resets and jumps back in time; each makes the node forget everything before it."""
    last_restart: str = ""
    latencies_s: deque[float] = field(default_factory=lambda: deque(maxlen=WINDOW))
    waiting_s: deque[float] = field(default_factory=lambda: deque(maxlen=WINDOW))
    core_s: deque[float] = field(default_factory=lambda: deque(maxlen=WINDOW))

    def refuse(self, topic: str, reason: str) -> None:
        """Count a message that cannot be used."""
        self.refused[topic] += 1
        self.last_refused = f"{topic}: {reason}"

    def reject(self, status: str, reason: str) -> None:
        """Count a pair without a usable pose."""
        self.rejected[status] += 1
        self.last_status, self.last_rejected = status, f"{status}: {reason}"

    def fail(self, kind: str, reason: str) -> None:
        """Count an error of the node itself."""
        self.errors[kind] += 1
        self.last_error = f"{kind}: {reason}"

    def restart(self, reason: str) -> None:
        """Count a reset or a jump back in time."""
        self.restarts, self.last_restart = self.restarts + 1, reason

    def publish(self, latency_s: float, waiting_s: float, core_s: float) -> None:
        """Count a pose that was published.

        Args:
            latency_s: from the arrival of the newest message to publication, s.
            waiting_s: part of the latency spent until the worker was free, s.
            core_s: part of the latency spent inside the core, s.
        """
        self.used += 1
        self.last_status = "converged"
        self.latencies_s.append(latency_s)
        self.waiting_s.append(waiting_s)
        self.core_s.append(core_s)
