# SPDX-License-Identifier: Apache-2.0
"""How wrong depth maps are: AbsRel, delta < 1.25, and what of it two maps of a pair have in common."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from bench.datasets import Pair


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


def errors_of_pair(found: Pair, true: Pair) -> list[DepthErrors]:
    """Of the depth of both views against that of another version of the same pair, which has it."""
    return [
        depth_errors(view.depth, truth.depth)
        for view, truth in ((found.source, true.source), (found.target, true.target))
        if view.depth is not None and truth.depth is not None
    ]


def depth_table(pairs: Sequence[Pair], with_depth: Callable[[Pair], Pair]) -> str:
    """Markdown: errors of depth on both views of every pair, by category, and how they hang together.

    Args:
        pairs: with their own depth, which is the truth here.
        with_depth: gives a pair the depth in question.
    """
    rows = ["| views | n | AbsRel | delta < 1.25 | AbsRel, scale put right | scale: median | sd, common | sd, own |"]
    rows.append("|---" * 8 + "|")
    of_pairs = [(pair.category, errors_of_pair(with_depth(pair), pair)) for pair in pairs]
    for category in (*dict.fromkeys(pair.category for pair in pairs), "all"):
        chosen = [errors for name, errors in of_pairs if category in (name, "all")]
        found = np.array(chosen)  # (pairs, 2, 4)
        mean = found.reshape(-1, 4).mean(axis=0)
        scales = found[:, :, 2]
        own = scales.T[0] - scales.T[1]
        common = float(np.sqrt(max(np.var(scales.mean(axis=1)) - np.var(own) / 4, 0.0)))
        rows.append(
            f"| {category} | {2 * len(chosen)} | {mean[0]:.3f} | {mean[1]:.3f} | {mean[3]:.3f} "
            f"| {np.exp(np.median(scales)):.3f} | {common:.3f} | {np.std(own) / math.sqrt(2):.3f} |"
        )
    return "\n".join(rows) + "\n"
