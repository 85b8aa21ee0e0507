# SPDX-License-Identifier: Apache-2.0
"""Metres for poses that have none: triangulation tells the direction of a motion, the views' own depth its length."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from bench.peers.features_pnp import MIN_INLIERS, Failure, trusted_depth
from garps_core.checks import Float64Array
from garps_core.types import View

LENGTH = "depth"
"""With "depth" it is the median of measured / triangulated depth, over all points in both views; with "none" it is 1,
for tables of rotation and direction alone, which owe nothing to the depth."""


class Triangulated(NamedTuple):
    """Points in one view: where it sees them (Nx2 px) and how far ahead they are (N), in the unit of the pose."""

    view: View
    pixels: Float64Array
    z: Float64Array


def with_length(T: Float64Array, seen: Sequence[Triangulated]) -> Float64Array:
    """4x4 T_target_source with its translation in metres, as `LENGTH` says.

    The median, since ratios have long tails where the parallax is small; one weighted by parallax is no better.

    Raises:
        Failure: fewer than `MIN_INLIERS` points have trusted depth.
    """
    scaled = T.copy()
    if LENGTH == "none":
        scaled[:3, 3] /= np.linalg.norm(T[:3, 3])
        return scaled
    ratios = np.concatenate([trusted_depth(part.view, part.pixels) / part.z for part in seen])
    known = ratios[ratios > 0]
    if len(known) < MIN_INLIERS:
        raise Failure(f"{len(known)} triangulated points with depth, {MIN_INLIERS} needed for the length")
    scaled[:3, 3] *= np.median(known)
    return scaled
