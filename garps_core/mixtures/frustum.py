# SPDX-License-Identifier: Apache-2.0
"""Frustum of a view: depth in range, brightness, and a coarse grid of both (`Frustum`)."""

from __future__ import annotations

from functools import lru_cache

import cv2
import numpy as np
import numpy.typing as npt

from garps_core.checks import Float32Array
from garps_core.config import Lifting
from garps_core.mixture import Frustum
from garps_core.types import View

MIN_COMPONENTS = 50
FRUSTUM_STEP_PX = 4
"""Spacing of the coarse depth map of a frustum, pixels."""


def brightness_of(rgb: npt.NDArray[np.uint8], step: int) -> Float32Array:
    """HxWx3 uint8 -> grey 0..1 at every step-th pixel, low-passed to that spacing."""
    grey = cv2.cvtColor(rgb, cv2.COLOR_RGB2GRAY)
    smooth = cv2.GaussianBlur(grey, (0, 0), 0.5 * step)
    return np.ascontiguousarray(smooth[step // 2 :: step, step // 2 :: step]).astype(np.float32) / np.float32(255)


def in_range(depth: Float32Array, lifting: Lifting) -> Float32Array:
    """HxW m with NaN where a reading is outside the range that `lifting` allows."""
    with np.errstate(invalid="ignore"):
        usable = (depth >= lifting.min_range_m) & (depth <= lifting.max_range_m)
    return np.where(usable, depth, np.float32(np.nan))


@lru_cache(maxsize=8)
def z_order(height: int, width: int) -> tuple[npt.NDArray[np.intp], npt.NDArray[np.intp]]:
    """Rows and columns of a grid\'s cells along a Z-order curve: every n-th cell is an even subsample."""
    y, x = np.mgrid[0:height, 0:width]
    key = np.zeros(y.shape, np.int64)
    for bit in range(14):
        key |= ((x >> bit) & 1) << (2 * bit) | ((y >> bit) & 1) << (2 * bit + 1)
    order = np.argsort(key, axis=None)
    return y.ravel()[order], x.ravel()[order]


def frustum_of(view: View, depth: Float32Array, lifting: Lifting) -> Frustum:
    """Frustum of the view on a coarse grid; depth is HxW m, NaN = unknown."""
    step = FRUSTUM_STEP_PX
    K = view.K.copy()
    K[:2] /= step
    K[:2, 2] -= (step // 2) / step  # grid cell i holds pixel i * step + step // 2
    seen = np.ascontiguousarray(depth[step // 2 :: step, step // 2 :: step])
    return Frustum(K, seen, brightness_of(view.rgb, step), lifting.patch_sigma)
