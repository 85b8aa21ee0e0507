# SPDX-License-Identifier: Apache-2.0
"""Errors of depth maps against the truth: AbsRel, delta < 1.25, scale and shape."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from bench.pairs.pair import Pair
from garps_core.types import View


class DepthErrors(NamedTuple):
    """Errors of one depth map against the truth; ratios are found / true."""

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
    """Errors of source and target depth against another version of the same pair; None where it has no depth."""
    views = ((found.source, true.source), (found.target, true.target))
    try:
        return [depth_errors(_depth(view), _depth(truth)) for view, truth in views]
    except ValueError:
        return None


def _depth(view: View) -> npt.NDArray[np.float32]:
    if view.depth is None:
        raise ValueError("the view has no depth: expected an RGB-D view")
    return view.depth
