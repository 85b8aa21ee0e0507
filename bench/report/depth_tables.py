# SPDX-License-Identifier: Apache-2.0
"""Tables of how wrong the depth maps of a run are."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from bench.rows.row import Row


def depth_tables(rows: Sequence[Row]) -> str:
    """Markdown, a table per depth and set of rows with `depth_errors`: by category, and how both maps hang together."""
    start = {(row["depth"], row["set"], row["pair"]): row for row in rows if row.get("depth_errors")}
    text = []
    for depth, name in dict.fromkeys(key[:2] for key in start):
        own = [row for key, row in start.items() if key[:2] == (depth, name)]
        text += [f"**Errors of {depth} depth, {name}**\n", *_lines(own), ""]
    return "\n".join(text)


def _lines(rows: Sequence[Row]) -> list[str]:
    lines = ["| views | n | AbsRel | delta < 1.25 | AbsRel, scale put right | scale: median | sd, common | sd, own |"]
    lines.append("|---" * 8 + "|")
    for category in (*dict.fromkeys(row["category"] for row in rows), "all"):
        chosen = [row["depth_errors"] for row in rows if category in (row["category"], "all")]
        found = np.array(chosen)  # (pairs, 2, 4)
        mean = found.reshape(-1, 4).mean(axis=0)
        scales = found[:, :, 2]
        own = scales.T[0] - scales.T[1]
        common = float(np.sqrt(max(np.var(scales.mean(axis=1)) - np.var(own) / 4, 0.0)))
        lines.append(
            f"| {category} | {2 * len(chosen)} | {mean[0]:.3f} | {mean[1]:.3f} | {mean[3]:.3f} "
            f"| {np.exp(np.median(scales)):.3f} | {common:.3f} | {np.std(own) / math.sqrt(2):.3f} |"
        )
    return lines
