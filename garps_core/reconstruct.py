# SPDX-License-Identifier: Apache-2.0
"""View -> Mixture: every usable pixel with metric depth becomes one Gaussian.

    mean        = z * ray(pixel)
    covariance  = footprint of the pixel spacing on the surface + depth uncertainty along the ray
    weight      = surface area the pixel stands for, so that near and flat-on surfaces are not counted more often

The same code serves a depth sensor (sigma a few mm) and a depth network (sigma a few per cent of the range): only
the noise model in `Lifting` differs. A long sigma along the ray is what makes the alignment behave like
reprojection for monocular depth and like surface matching for a sensor.
"""

from __future__ import annotations

from functools import lru_cache

import cv2
import numpy as np
import numpy.typing as npt

from garps_core.checks import Float32Array
from garps_core.config import Config, Lifting
from garps_core.errors import ReconstructionError
from garps_core.photometric import brightness_of
from garps_core.types import Frustum, Mixture, View

MIN_COMPONENTS = 50
FRUSTUM_STEP_PX = 4
"""Spacing of the coarse depth map that answers "could that camera see this point"."""

Bool = npt.NDArray[np.bool_]


def reconstruct(view: View, config: Config | None = None) -> Mixture:
    """Lift a view with depth to a 3D Gaussian mixture in its own camera frame.

    Components come along a Z-order curve through the image, so that every n-th of them is an even subsample.

    Args:
        view: image, intrinsics and registered metric depth.
        config: `config.lifting` is used.
    Returns:
        Mixture of float32 arrays, about HW / stride^2 components.
    Raises:
        ReconstructionError: no depth given, or fewer than 50 usable pixels.
    """
    lifting = (config or Config()).lifting
    if view.depth is None:
        raise ReconstructionError("the view has no depth: expected HxW float32 metres; give View(..., depth=...)")
    depth = _smoothed(_in_range(view.depth, lifting), lifting)
    rows, columns = _sampled_pixels(depth, lifting)
    if len(rows) < MIN_COMPONENTS:
        raise ReconstructionError(
            f"the view has {len(rows)} usable depth pixels of {depth.size} "
            f"({np.isfinite(view.depth).sum()} with a reading): expected at least {MIN_COMPONENTS}; "
            "check range limits, units and that the scene is not one edge"
        )
    return _lift(view, depth, rows, columns, lifting)


def _in_range(depth: Float32Array, lifting: Lifting) -> Float32Array:
    with np.errstate(invalid="ignore"):
        usable = (depth >= lifting.min_range_m) & (depth <= lifting.max_range_m)
    return np.where(usable, depth, np.float32(np.nan))


def _smoothed(depth: Float32Array, lifting: Lifting) -> Float32Array:
    """Edge-keeping average over valid neighbours (bilateral with a range kernel of a few noise sigmas)."""
    radius = lifting.smoothing_px // 2
    if radius == 0:
        return depth
    sigma = 3.0 * depth_sigma(depth, lifting)
    total, weight = np.zeros_like(depth), np.zeros_like(depth)
    padded = np.pad(depth, radius, constant_values=np.nan)
    height, width = depth.shape
    step = max(1, radius)  # a sparse kernel: centre, and eight neighbours at the radius
    with np.errstate(invalid="ignore", divide="ignore"):
        for dy in range(-radius, radius + 1, step):
            for dx in range(-radius, radius + 1, step):
                other = padded[radius + dy : radius + dy + height, radius + dx : radius + dx + width]
                close = np.abs(other - depth) <= sigma  # true for the pixel itself, even where sigma is 0
                total += np.where(close, other, 0)
                weight += close
        return np.where(weight > 0, total / weight, np.float32(np.nan)).astype(np.float32)


def depth_sigma(depth: Float32Array, lifting: Lifting) -> Float32Array:
    """Standard deviation of the depth readings, m, same shape (`Lifting.noise_*`)."""
    noise = lifting.noise_floor_m + depth * (lifting.noise_linear + depth * lifting.noise_quadratic_per_m)
    return np.asarray(noise, np.float32)


def _sampled_pixels(depth: Float32Array, lifting: Lifting) -> tuple[npt.NDArray[np.intp], npt.NDArray[np.intp]]:
    """Rows and columns of usable pixels on the sampling grid, in Z-order."""
    s = lifting.stride
    rows, columns = _z_order(*depth.shape, s)
    good = (_smooth_surface(depth, lifting) & np.isfinite(depth))[rows, columns]
    return rows[good], columns[good]


def _smooth_surface(depth: Float32Array, lifting: Lifting) -> Bool:
    """True where no 3x3 neighbour lies on another surface: depth edges hold readings of neither side."""
    filled = np.where(np.isfinite(depth), depth, np.float32(0))
    kernel = np.ones((3, 3), np.uint8)
    far = cv2.dilate(filled, kernel)
    near = cv2.erode(np.where(filled > 0, filled, np.float32(1e6)), kernel)
    return np.asarray(far - near < lifting.edge_ratio * 2 * near, bool)


@lru_cache(maxsize=8)
def _z_order(height: int, width: int, stride: int) -> tuple[npt.NDArray[np.intp], npt.NDArray[np.intp]]:
    offset = stride // 2
    y, x = np.mgrid[0 : (height - offset + stride - 1) // stride, 0 : (width - offset + stride - 1) // stride]
    key = np.zeros(y.shape, np.int64)
    for bit in range(14):
        key |= ((x >> bit) & 1) << (2 * bit) | ((y >> bit) & 1) << (2 * bit + 1)
    order = np.argsort(key, axis=None)
    return y.ravel()[order] * stride + offset, x.ravel()[order] * stride + offset


def _lift(
    view: View, depth: Float32Array, rows: npt.NDArray[np.intp], columns: npt.NDArray[np.intp], lifting: Lifting
) -> Mixture:
    fx, fy, cx, cy = (np.float32(view.K[i, j]) for i, j in ((0, 0), (1, 1), (0, 2), (1, 2)))
    z = depth[rows, columns]
    rays = np.stack([(columns - cx) / fx, (rows - cy) / fy, np.ones_like(z)], axis=1).astype(np.float32)
    normals = _normals(depth, rows, columns, (fx, fy, cx, cy), lifting.stride)
    length = np.linalg.norm(rays, axis=1)
    cosine = np.maximum(np.abs((normals * rays).sum(1)) / length, np.float32(lifting.min_cosine))
    # the pixel's solid angle, (stride^2 / fx fy) / length^3, times range^2, over the cosine
    area = (z * lifting.stride) ** 2 / (fx * fy) / (cosine * length)
    covariances = _covariances(z, rays, normals, cosine, depth_sigma(z, lifting), fx, fy, lifting)
    return Mixture._trusted(
        rays * z[:, None],
        covariances,
        area if lifting.weighting == "area" else np.ones_like(area),
        view.rgb[rows, columns].astype(np.float32) / np.float32(255),
        None,
        _frustum(view, depth),
    )


def _normals(
    depth: Float32Array,
    rows: npt.NDArray[np.intp],
    columns: npt.NDArray[np.intp],
    camera: tuple[np.float32, ...],
    stride: int,
) -> Float32Array:
    """Unit normals from central differences of the inverse depth, which is linear in the pixel on a plane.

    On a plane n.X = d, with X = z ray: n.ray / d = 1/z, so the gradient of 1/z gives the normal up to scale.
    """
    fx, fy, cx, cy = camera
    with np.errstate(invalid="ignore"):
        inverse = 1.0 / depth
    h, w = depth.shape
    reach = max(2, stride)
    gx = _difference(inverse, rows, columns, 0, reach, h, w)
    gy = _difference(inverse, rows, columns, reach, 0, h, w)
    a, b = gx * fx, gy * fy
    c = inverse[rows, columns] - gx * (columns - cx) - gy * (rows - cy)
    normals = np.stack([a, b, c], axis=1)
    missing = ~np.isfinite(normals).all(1)
    normals[missing] = np.stack([np.zeros(missing.sum())] * 2 + [np.ones(missing.sum())], axis=1)
    return np.asarray(normals / np.linalg.norm(normals, axis=1, keepdims=True), np.float32)


def _difference(
    field: Float32Array,
    rows: npt.NDArray[np.intp],
    columns: npt.NDArray[np.intp],
    dy: int,
    dx: int,
    height: int,
    width: int,
) -> Float32Array:
    """Slope per pixel: central where both neighbours are there, else one-sided, else NaN."""
    ahead = field[np.minimum(rows + dy, height - 1), np.minimum(columns + dx, width - 1)]
    behind = field[np.maximum(rows - dy, 0), np.maximum(columns - dx, 0)]
    here = field[rows, columns]
    reach_ahead = np.minimum(rows + dy, height - 1) - rows + np.minimum(columns + dx, width - 1) - columns
    reach_behind = rows - np.maximum(rows - dy, 0) + columns - np.maximum(columns - dx, 0)
    with np.errstate(invalid="ignore", divide="ignore"):
        central = (ahead - behind) / (reach_ahead + reach_behind)
        forward, backward = (ahead - here) / reach_ahead, (here - behind) / reach_behind
    one_sided = np.where(np.isfinite(forward), forward, backward)
    return np.asarray(np.where(np.isfinite(central), central, one_sided), np.float32)


def _covariances(
    z: Float32Array,
    rays: Float32Array,
    normals: Float32Array,
    cosine: Float32Array,
    sigma: Float32Array,
    fx: np.float32,
    fy: np.float32,
    lifting: Lifting,
) -> Float32Array:
    """Footprint in the tangent plane + sigma^2 along the ray, Nx3x3 m^2.

    The footprint of a pixel step is the move on the tangent plane that keeps the next pixel's ray:
    dX = (z / f) (e - ray (n.e) / (n.ray)), e the image axis; n.ray is clipped at the smallest cosine.
    """
    along = (normals * rays).sum(1)
    signed = np.where(along < 0, -1, 1) * np.maximum(np.abs(along), lifting.min_cosine)
    spread = np.float32(lifting.footprint * lifting.stride)
    covariances = np.einsum("ni,nj->nij", rays * sigma[:, None], rays * sigma[:, None])
    for axis, focal in ((0, fx), (1, fy)):
        step = -rays * (normals[:, axis] / signed)[:, None]
        step[:, axis] += 1
        step *= (z * spread / focal)[:, None]
        covariances += np.einsum("ni,nj->nij", step, step)
    floor = np.float32(1e-3) * np.maximum(z * spread / fx, 1e-4) ** 2  # keeps exact depth (sigma 0) definite
    covariances[:, range(3), range(3)] += floor[:, None]
    return np.asarray(covariances, np.float32)


def _frustum(view: View, depth: Float32Array) -> Frustum:
    step = FRUSTUM_STEP_PX
    K = view.K.copy()
    K[:2] /= step
    K[:2, 2] -= (step // 2) / step  # grid cell i holds pixel i * step + step // 2
    seen = np.ascontiguousarray(depth[step // 2 :: step, step // 2 :: step])
    return Frustum(K, seen, brightness_of(view.rgb, step))
