# SPDX-License-Identifier: Apache-2.0
"""Errors that all pixels of one view share. They do not average out as noise does.

A depth map may be off in scale and smoothly warped, and a calibrated principal point by a fraction of a pixel.
Eight modes of one view stand for these errors, each a field of displacements of its points p:

    0..5  p times the polynomials 1, x, y, x^2, xy, y^2 of the ray's slopes, scaled to about +-1 across the image:
          relative depth error; the first is the scale
    6, 7  z times the x and y axes: error of the direction of a pixel's ray, in rad

Depth errors may be solved for together with the pose (`with_depth_errors.py`). The effect of one sigma of
every other mode is added to the covariance of the pose.
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
"""Largest slope, in field slopes, of the polynomials; mixtures may reach beyond the image of any camera."""
DEPTH_MODES = 6
"""Number of modes that are depth errors; they come first."""


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
    """Sigmas (8,) of the modes: relative depth, then rad."""
    return np.array([lifting.scale_sigma] + [lifting.warp_sigma] * 5 + [lifting.pointing_sigma_rad] * 2)


def depth_sigma(depth: Float32Array, lifting: Lifting) -> Float32Array:
    """Standard deviation of one depth reading, m, same shape (`Lifting.noise_*`)."""
    noise = lifting.noise_floor_m + depth * (lifting.noise_linear + depth * lifting.noise_quadratic_per_m)
    return np.asarray(noise, np.float32)
