# SPDX-License-Identifier: Apache-2.0
"""Ablations of GARPS in the layout of the published one, with intervals."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from bench.rows.row import GARPS, Row
from bench.rows.variants import VARIANTS
from bench.scoring.intervals import relative_change

ERRORS = {"e_trans_m": "E_trans", "e_rot_deg": "E_rot", "e_3d_m": "E_3D"}


def ablation_tables(rows: Sequence[Row]) -> str:
    """Markdown, one table per depth, set and start with variants of GARPS: relative change of the mean errors, 95 %.

    Over the pairs for which both the full method and the variant have a pose; how many that are is in the table.
    """
    text = []
    for place in dict.fromkeys((row["depth"], row["set"], row["start"]) for row in rows):
        own = [row for row in rows if (row["depth"], row["set"], row["start"]) == place]
        methods = [name for name in dict.fromkeys(row["method"] for row in own) if name in VARIANTS and name != GARPS]
        full = {row["pair"]: row for row in own if row["method"] == GARPS and row["found"]}
        if not methods or not full:
            continue
        depth, name, start = place
        text += [f"**Ablation, {name}, depth {depth}, start {start}**: change of the mean error against `garps`", ""]
        text += [f"| variant | pairs | {' | '.join(ERRORS.values())} |", "|---" * (2 + len(ERRORS)) + "|"]
        for method in methods:
            rows_of = {row["pair"]: row for row in own if row["method"] == method and row["found"]}
            pairs = [pair for pair in full if pair in rows_of]
            cells = [_cell([rows_of[p][e] for p in pairs], [full[p][e] for p in pairs]) for e in ERRORS]
            text.append(f"| {method}: {VARIANTS[method].what} | {len(pairs)} of {len(full)} | {' | '.join(cells)} |")
        text.append("")
    return "\n".join(text)


def _cell(ours: Sequence[float], theirs: Sequence[float]) -> str:
    if not ours or not np.isfinite([ours, theirs]).all() or not np.mean(theirs) > 0:
        return ""
    found = relative_change(ours, theirs)
    return f"{100 * found.value:+.1f} % [{100 * found.low:+.1f}, {100 * found.high:+.1f}]"
