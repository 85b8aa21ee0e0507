# SPDX-License-Identifier: Apache-2.0
"""Errors that all pixels of one view share, and so do not average out.

Noise is not all: a depth map may be off in scale and smoothly warped, and a calibration's principal point is off by a
fraction of a pixel. Eight modes of one view stand for them, each a field of displacements of its points p:

    0..5  p times the polynomials 1, x, y, x^2, xy, y^2 of the ray's slopes, scaled to about +-1 across the image:
          relative depth error; the first is the scale
    6, 7  z times the x and y axes: the direction in which the camera believes a pixel to look, in rad

Depth errors may be solved for together with the pose (`with_depth_errors.py`). What one sigma of every mode that is not
does to the pose is added to the pose's covariance.
"""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from garps_core.checks import Float32Array
from garps_core.config.lifting import Lifting
from garps_core.geometry import Array

FIELD_SLOPE = 0.6
"""Slope |x/z| at the image border that the depth modes are scaled to (about a 62 degree field of view)."""
LARGEST = 3.0
"""Slopes, in field slopes, beyond which the polynomials are held: no camera's image, but any mixture may be given."""
DEPTH_MODES = 6


def depth_modes(points: Tensor) -> Tensor:
    """Points (n, 3) m in the camera that measured them -> (n, 6) relative depth error per unit of each depth mode."""
    z = points[:, 2].clamp_min(1e-6)
    x, y = ((points[:, axis] / z / FIELD_SLOPE).clamp(-LARGEST, LARGEST) for axis in (0, 1))
    return torch.stack([torch.ones_like(x), x, y, x * x, x * y, y * y], dim=1)


def error_fields(points: Array) -> Array:
    """Points (n, 3) m in the camera that measured them -> (n, 3, 8) displacement per unit of each mode."""
    fields = np.zeros((len(points), 3, 8))
    fields[:, :, :6] = points[:, :, None] * depth_modes(torch.from_numpy(points)).numpy()[:, None, :]
    fields[:, 0, 6] = fields[:, 1, 7] = np.maximum(points[:, 2], 1e-6)
    return fields


def error_sigmas(lifting: Lifting) -> Array:
    """Sigmas (8,) of the modes."""
    return np.array([lifting.scale_sigma] + [lifting.warp_sigma] * 5 + [lifting.pointing_sigma_rad] * 2)


def depth_sigma(depth: Float32Array, lifting: Lifting) -> Float32Array:
    """Standard deviation of one depth reading, m, same shape (`Lifting.noise_*`)."""
    noise = lifting.noise_floor_m + depth * (lifting.noise_linear + depth * lifting.noise_quadratic_per_m)
    return np.asarray(noise, np.float32)
