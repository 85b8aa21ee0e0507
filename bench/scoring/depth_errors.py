# SPDX-License-Identifier: Apache-2.0
"""How wrong depth maps are: AbsRel, delta < 1.25, and what of it two maps of a pair have in common."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from bench.pairs.datasets import Pair
from bench.scoring.tables import Row
from garps_core.types import View


class DepthErrors(NamedTuple):
    """Of one depth map against the truth; ratios are found / true."""

    abs_rel: float
    delta: float
    """Share of the pixels within a factor of 1.25."""
    log_scale: float
    """Median logarithm of the ratio."""
    shape: float
    """AbsRel once the scale is put right."""


def depth_errors(found: npt.NDArray[np.float32], true: npt.NDArray[np.float32]) -> DepthErrors:
    """HxW m each, NaN where there is no truth. Raises ValueError where nothing can be compared."""
    known = np.isfinite(true) & np.isfinite(found) & (true > 0) & (found > 0)
    if not known.any():
        raise ValueError("no pixel has both depths: expected maps of the same view")
    off = np.log(found[known].astype(float) / true[known])
    scale = float(np.median(off))
    return DepthErrors(
        float(np.abs(np.expm1(off)).mean()),
        float((np.abs(off) < math.log(1.25)).mean()),
        scale,
        float(np.abs(np.expm1(off - scale)).mean()),
    )


def errors_of_pair(found: Pair, true: Pair) -> list[DepthErrors] | None:
    """Of the depth of source and target against that of another version of the same pair; None where it has none."""
    views = ((found.source, true.source), (found.target, true.target))
    try:
        return [depth_errors(_depth(view), _depth(truth)) for view, truth in views]
    except ValueError:
        return None


def _depth(view: View) -> npt.NDArray[np.float32]:
    if view.depth is None:
        raise ValueError("the view has no depth: expected an RGB-D view")
    return view.depth


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
