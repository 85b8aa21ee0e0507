# SPDX-License-Identifier: Apache-2.0
"""Depth edges: where two surfaces meet in the image, a reading may be of either of them.

There is one test, and every caller has its own largest share by which the depths of one surface may differ:

    2 `lifting.edge_ratio`    3x3 pixels. A setting, because it depends on the sensor; doubled, because the corners of
                              the neighbourhood are two steps apart.
    `GRID_EDGE_RATIO`         3x3 cells of a brightness grid. A cell is 4 to 32 pixels wide, so the depths of one
                              slanted surface differ by more.
    `MATCH_EDGE_RATIO`        5x5 pixels around a matched feature. Their mean becomes the depth of the match, so they
                              must be nearly flat; `MATCH_SLACK_M` keeps a sensor's noise close by from looking like an
                              edge.
"""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
import numpy.typing as npt

from garps_core.checks import Float32Array, FloatArray

GRID_EDGE_RATIO = 0.12
"""Largest relative difference of depth between the cells of one surface in a brightness grid."""
MATCH_EDGE_RATIO = 0.03
"""Largest relative difference of depth between the pixels of one surface around a matched feature."""
MATCH_SLACK_M = 0.005
"""Difference of depth around a matched feature that is allowed in addition, m."""


def one_surface(near: FloatArray, far: FloatArray, ratio: float, slack_m: float = 0.0) -> npt.NDArray[np.bool_]:
    """True where depths between `near` and `far` (m, same shape) differ by less than the share `ratio` of `near`."""
    return np.asarray(far - near < ratio * near + slack_m, bool)


def away_from_edges(depth: Float32Array, ratio: float) -> npt.NDArray[np.bool_]:
    """Mask (h, w) of known depths whose 3x3 neighbourhood is `one_surface`; depth (h, w) m, NaN = unknown."""
    known, kernel = np.isfinite(depth), np.ones((3, 3), np.uint8)
    far: npt.NDArray[Any] = cv2.dilate(np.where(known, depth, np.float32(0)), kernel)
    near: npt.NDArray[Any] = cv2.erode(np.where(known, depth, np.float32(1e6)), kernel)
    return known & one_surface(near, far, ratio)
