# SPDX-License-Identifier: Apache-2.0
"""Counts of a replay and their table: pairs in, used, rejected by reason, latency."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, field

import numpy as np
from rich.table import Table


@dataclass
class Summary:
    """Counts of the messages and pairs of a replay."""

    pairs: int = 0
    used: int = 0
    rejected: Counter[str] = field(default_factory=Counter)
    """Pairs without a published pose, by status."""
    refused: int = 0
    """Messages that could not be used at all."""
    first_refused: str = ""
    unpaired: int = 0
    broken_end: str = ""
    seconds: list[float] = field(default_factory=list)
    """Wall time of each pair from messages to pose, s."""

    def count(self, status: str, published: bool, seconds: float | None) -> None:
        """Count a pair by its status; `seconds` is its wall time, None if the core never got it."""
        self.pairs += 1
        if published:
            self.used += 1
        else:
            self.rejected[status] += 1
        if seconds is not None:
            self.seconds.append(seconds)

    def refuse(self, reason: str) -> None:
        """Count a message that cannot be used; the first reason is kept for the table."""
        self.refused += 1
        self.first_refused = self.first_refused or reason

    def table(self) -> Table:
        """Return the summary as a table for people."""
        table = Table(show_header=False, title="Replay")
        table.add_row("pairs in", str(self.pairs))
        table.add_row("poses used", str(self.used))
        for status, count in sorted(self.rejected.items()):
            table.add_row(f"rejected: {status}", str(count))
        table.add_row("messages without partner", str(self.unpaired))
        table.add_row("messages refused", str(self.refused))
        if self.first_refused:
            table.add_row("  the first", self.first_refused)
        if self.broken_end:
            table.add_row("recording breaks off", self.broken_end)
        if self.seconds:
            median, p95 = np.percentile(self.seconds, [50, 95]) * 1000
            table.add_row("latency median / p95", f"{median:.0f} / {p95:.0f} ms")
        return table
