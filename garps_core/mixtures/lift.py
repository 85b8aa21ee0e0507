# SPDX-License-Identifier: Apache-2.0
"""View with depth -> Mixture: every usable pixel becomes one Gaussian.

    mean        = z * ray(pixel)
    covariance  = footprint of the pixel spacing on the surface + depth uncertainty along the ray
    weight      = surface area the pixel stands for, so that near and flat-on surfaces are not counted more often

The same code serves a depth sensor and a depth network: only the noise model in `Lifting` differs. Errors that
a whole depth map shares are not in the components; the alignment models them (`depth_errors.py`).
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from garps_core.checks import Float32Array, Float64Array
from garps_core.config.lifting import Lifting
from garps_core.depth_errors import depth_sigma
from garps_core.edges import away_from_edges
from garps_core.errors import MissingDepthError, ReconstructionError
from garps_core.mixtures.frustum import MIN_COMPONENTS, frustum_of, in_range, z_order
from garps_core.types import Mixture, View


def lift(view: View, lifting: Lifting) -> Mixture:
    """Lift a view with depth to a 3D Gaussian mixture in its own camera frame.

    Components come along a Z-order curve through the image, so that every n-th of them is an even subsample.

    Args:
        view: image, intrinsics and registered metric depth.
        lifting: settings.
    Returns:
        Mixture of float32 arrays, about HW / stride^2 components.
    Raises:
        MissingDepthError: no depth given.
        ReconstructionError: fewer than 50 usable pixels.
    """
    if view.depth is None:
        raise MissingDepthError("the view has no depth: expected HxW float32 metres. Give View(..., depth=...)")
    depth = in_range(view.depth, lifting)
    rows, columns = _sampled(depth, lifting)
    if len(rows) < MIN_COMPONENTS:
        raise ReconstructionError(
            f"the view has {len(rows)} usable depth pixels of {depth.size} "
            f"({np.isfinite(view.depth).sum()} with a reading): expected at least {MIN_COMPONENTS}. "
            "Check range limits, units and that the scene is not one edge"
        )
    return _lift(view, depth, rows, columns, lifting)


def _smoothed(depth: Float32Array, lifting: Lifting) -> Float32Array:
    """Depth on the sampling grid, averaged over close valid neighbours (bilateral, range kernel of one sigma)."""
    s, radius = lifting.stride, lifting.smoothing_px // 2
    first = s // 2
    centre = depth[first::s, first::s]
    if radius == 0:
        return centre
    sigma = depth_sigma(centre, lifting)
    total, weight = np.zeros_like(centre), np.zeros_like(centre)
    padded = np.pad(depth, radius, constant_values=np.nan)
    height, width = depth.shape
    with np.errstate(invalid="ignore", divide="ignore"):
        for dy in (-radius, 0, radius):  # a sparse kernel: centre, and eight neighbours at the radius
            for dx in (-radius, 0, radius):
                top, left = radius + dy + first, radius + dx + first
                other = padded[top : radius + dy + height : s, left : radius + dx + width : s]
                close = np.abs(other - centre) <= sigma  # true for the pixel itself, even where sigma is 0
                np.add(total, other, out=total, where=close)
                weight += close
        return np.where(weight > 0, total / weight, np.float32(np.nan)).astype(np.float32)


def averaged_sigma(depth: Float32Array, lifting: Lifting) -> Float32Array:
    """Standard deviation of the depth of a component, m, same shape: a third of one reading's where it is smoothed.

    Calibrated, on real sensors with their documented noise (docs/alignment_notes.md): readings close to each other are
    averaged, and a row is compared with many partners.
    """
    return depth_sigma(depth, lifting) / np.float32(3 if lifting.smoothing_px > 1 else 1)


def _sampled(depth: Float32Array, lifting: Lifting) -> tuple[npt.NDArray[np.intp], npt.NDArray[np.intp]]:
    """Rows and columns, on the sampling grid, of usable pixels in Z-order."""
    s = lifting.stride
    rows, columns = z_order(*depth[s // 2 :: s, s // 2 :: s].shape)
    good = away_from_edges(depth, 2 * lifting.edge_ratio)[s // 2 :: s, s // 2 :: s][rows, columns]
    return rows[good], columns[good]


def _lift(
    view: View, depth: Float32Array, rows: npt.NDArray[np.intp], columns: npt.NDArray[np.intp], lifting: Lifting
) -> Mixture:
    s = lifting.stride
    fx, fy, cx, cy = (np.float32(view.K[i, j]) for i, j in ((0, 0), (1, 1), (0, 2), (1, 2)))
    v, u = rows * s + s // 2, columns * s + s // 2
    smooth = _smoothed(depth, lifting)
    z = smooth[rows, columns]
    x, y = ((u - cx) / fx).astype(np.float32), ((v - cy) / fy).astype(np.float32)
    rays = np.stack([x, y, np.ones_like(z)], axis=1)
    normals = _normals(smooth, view.K, s)[rows, columns]
    length = np.sqrt(x * x + y * y + 1)
    along = normals[:, 0] * x + normals[:, 1] * y + normals[:, 2]
    cosine = np.maximum(np.abs(along) / length, np.float32(lifting.min_cosine))
    # the pixel's solid angle, (stride^2 / fx fy) / length^3, times range^2, over the cosine
    area = (z * s) ** 2 / (fx * fy) / (cosine * length)
    return Mixture._trusted(
        rays * z[:, None],
        _covariances(z, rays, normals, along, averaged_sigma(z, lifting), (fx, fy), lifting),
        area if lifting.weighting == "area" else np.ones_like(area),
        view.rgb[v, u].astype(np.float32) / np.float32(255),
        None,
        frustum_of(view, depth, lifting),
    )


def _normals(depth: Float32Array, K: Float64Array, stride: int) -> Float32Array:
    """Unit normals (h, w, 3) from central differences of the inverse depth, which is linear in the pixel on a plane.

    On a plane n.X = d, with X = z ray: n.ray / d = 1/z, so the gradient of 1/z gives the normal up to scale. depth is
    that of every stride-th pixel.
    """
    fx, fy, cx, cy = (np.float32(K[i, j]) for i, j in ((0, 0), (1, 1), (0, 2), (1, 2)))
    with np.errstate(invalid="ignore"):
        inverse = 1.0 / depth
    reach = 2 if stride == 1 else 1
    gx, gy = _difference(inverse, reach, 1) / np.float32(stride), _difference(inverse, reach, 0) / np.float32(stride)
    v, u = (np.arange(n, dtype=np.float32) * stride + stride // 2 for n in depth.shape)
    a, b = gx * fx, gy * fy
    c = inverse - gx * (u - cx) - gy * (v - cy)[:, None]
    with np.errstate(invalid="ignore", divide="ignore"):
        scale = 1 / np.sqrt(a * a + b * b + c * c)
    missing = ~np.isfinite(scale)
    return np.stack([np.where(missing, o, part * scale) for part, o in ((a, 0), (b, 0), (c, 1))], axis=2).astype(
        np.float32, copy=False
    )


def _difference(field: Float32Array, reach: int, axis: int) -> Float32Array:
    """Slope per cell along an axis: central where both neighbours are there, else one-sided, else NaN."""
    moved = np.moveaxis(field, axis, 0)
    edge = np.full((reach, *moved.shape[1:]), np.nan, np.float32)
    ahead, behind = np.concatenate([moved[reach:], edge]), np.concatenate([edge, moved[:-reach]])
    with np.errstate(invalid="ignore"):
        central, forward, backward = (ahead - behind) / (2 * reach), (ahead - moved) / reach, (moved - behind) / reach
    one_sided = np.where(np.isfinite(forward), forward, backward)
    return np.moveaxis(np.where(np.isfinite(central), central, one_sided), 0, axis)


def _covariances(
    z: Float32Array,
    rays: Float32Array,
    normals: Float32Array,
    along: Float32Array,
    sigma: Float32Array,
    focal: tuple[np.float32, np.float32],
    lifting: Lifting,
) -> Float32Array:
    """Footprint in the tangent plane + sigma^2 along the ray, Nx3x3 m^2.

    The footprint of a pixel step is the move on the tangent plane that keeps the next pixel's ray:
    dX = (z / f) (e - ray (n.e) / (n.ray)), e the image axis; n.ray is clipped at the smallest cosine.
    """
    signed = np.where(along < 0, -1, 1) * np.maximum(np.abs(along), np.float32(lifting.min_cosine))
    spread = np.float32(lifting.footprint * lifting.stride)
    spans = [[sigma * rays[:, i] for i in range(3)]]
    for axis in (0, 1):
        tilt, size = normals[:, axis] / signed, z * (spread / focal[axis])
        spans.append([size * ((1 if i == axis else 0) - rays[:, i] * tilt) for i in range(3)])
    floor = np.float32(1e-3) * np.maximum(z * spread / focal[0], np.float32(1e-4)) ** 2  # keeps exact depth definite
    covariances = np.empty((len(z), 3, 3), np.float32)
    for i in range(3):
        for j in range(i, 3):
            element = sum((span[i] * span[j] for span in spans), start=floor if i == j else np.float32(0))
            covariances[:, i, j] = covariances[:, j, i] = element
    return covariances
