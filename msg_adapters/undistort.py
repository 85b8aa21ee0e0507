# SPDX-License-Identifier: Apache-2.0
"""Undistortion of an image and its depth; the sampling tables are made once per calibration."""

from __future__ import annotations

import functools
from typing import Any

import numpy as np
import numpy.typing as npt

Array = npt.NDArray[Any]
CACHED_CALIBRATIONS = 8


def undistorted_pair(
    K: Array, model: str, coefficients: tuple[float, ...], rgb: Array, depth: Array | None
) -> tuple[Array, Array | None]:
    """Resample to the pinhole camera of the same K: rgb HxWx3 uint8 linearly, depth HxW float32 m by nearest pixel."""
    import cv2

    x, y = _tables(tuple(K.ravel().tolist()), model, coefficients, rgb.shape[1], rgb.shape[0])
    rgb = cv2.remap(rgb, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT, borderValue=(0, 0, 0))
    if depth is not None:
        # Interpolating across an edge would invent surfaces between the near and the far one.
        depth = cv2.remap(depth, x, y, cv2.INTER_NEAREST, borderMode=cv2.BORDER_CONSTANT, borderValue=(np.nan,))
    return rgb, depth


@functools.lru_cache(maxsize=CACHED_CALIBRATIONS)
def _tables(
    k: tuple[float, ...], model: str, coefficients: tuple[float, ...], width: int, height: int
) -> tuple[Array, Array]:
    """Positions of the pinhole image's pixels in the distorted one, HxW float32 x and y."""
    import cv2

    K, D, still = np.array(k).reshape(3, 3), np.array(coefficients), np.eye(3)
    make = cv2.fisheye.initUndistortRectifyMap if model == "equidistant" else cv2.initUndistortRectifyMap
    x, y = make(K, D, still, K, (width, height), cv2.CV_32FC1)
    return np.asarray(x), np.asarray(y)
