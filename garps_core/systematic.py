# SPDX-License-Identifier: Apache-2.0
"""Errors that all pixels of one depth map share, and so do not average out: scale, tilt and bowl.

A depth map's relative error is modelled as white noise (`Lifting.noise_*`) plus a sum of six smooth modes over the
image, the polynomials 1, x, y, x^2, xy, y^2 of the ray's slopes scaled to about +-1 across the field of view. The
first is the map's scale error. What a mode of one sigma does to the pose is added to the pose's covariance.
"""

from __future__ import annotations

import numpy as np

from garps_core.geometry import Array

MODES = 6
FIELD_SLOPE = 0.6
"""Slope |x/z| at the image border that the modes are scaled to (about a 62 degree field of view)."""


def depth_modes(points: Array) -> Array:
    """Points (n, 3) in the camera that measured them -> (n, 6): relative depth change per unit of each mode."""
    x, y = (points[:, axis] / np.maximum(points[:, 2], 1e-6) / FIELD_SLOPE for axis in (0, 1))
    return np.stack([np.ones_like(x), x, y, x * x, x * y, y * y], axis=1)
