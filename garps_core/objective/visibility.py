# SPDX-License-Identifier: Apache-2.0
"""Visibility: which points a camera sees, by comparison with its depth map at the pixel on which they fall.

There is one test, `surface_at`, and two callers who draw different conclusions from it:

    pairing (`plain.visible`)      A component is visible unless it is further *behind* the depth map than a share of
                                   the depth: `alignment.occlusion_ratio`, or that of a rung. In front of it, two depth
                                   maps merely disagree, and the alignment must be able to pull them together.
    brightness (`brightness.py`)   A point must lie *on* the surface, within `SAME_SURFACE_RATIO` on both sides: in
                                   front of it, the pixel shows the brightness of something else. It must also lie
                                   inside the image by a margin, where brightness and slopes can be interpolated.

`neighbours.visible` is the compiled form of `plain.visible`.
"""

from __future__ import annotations

import torch
from torch import Tensor

NEAREST_M = 1e-3
"""Points nearer than this, or behind the camera, are not in its image, m."""
SAME_SURFACE_RATIO = 0.15
"""Largest relative difference of depth between a point and the surface whose brightness it is compared with."""


def surface_at(points: Tensor, K: Tensor, depth: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Look up the depth map of a camera where points in its frame project to.

    Args:
        points: (n, 3) m.
        K, depth: intrinsics (3, 3) and depth map (h, w) m, NaN = unknown.
    Returns:
        Pixels (n, 2); mask (n,) of those whose nearest pixel is in the image; depth (n,) m of the surface at that
        pixel, to be used under the mask only.
    """
    height, width = depth.shape
    z = points[:, 2].clamp_min(1e-6)
    u, v = (points[:, axis] / z * K[axis, axis] + K[axis, 2] for axis in (0, 1))
    column, row = u.round().clamp(-1, width).long(), v.round().clamp(-1, height).long()
    inside = (points[:, 2] > NEAREST_M) & (column >= 0) & (column < width) & (row >= 0) & (row < height)
    surface = depth[row.clamp(0, height - 1), column.clamp(0, width - 1)]
    return torch.stack([u, v], dim=1), inside, surface
