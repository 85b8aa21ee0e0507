# SPDX-License-Identifier: Apache-2.0
"""Reprojection residuals of matches under a pose, with the depth of each match estimated beside the pose.

A depth that is off moves the point's pixel along its epipolar line. Where depth is off by much more than noise
(`lifting.patch_sigma`) it is an unknown of its own, d = log(depth / measured), beside the pose:

    minimise  |pi(T p e^d) - u|^2 / s^2  +  d^2 / p^2          pixel noise s, depth error p

Eliminating d leaves a residual over the pose with the covariance s^2 1 + p^2 a a', a = d pixel / d d. All derivatives
are taken at the estimated depth. At the measured depth they would contain its error, and draw the translation to zero,
as noise in a regressor does.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from garps_core.config.lifting import Lifting
from garps_core.depth_errors import depth_sigma, error_fields
from garps_core.geometry import Array, point_jacobian, project, transform

DAMPING = 1e-9 * np.eye(6)
"""Added to a Hessian, so that an open direction is not singular."""
MIN_PIXEL_SIGMA = 0.3
"""Smallest sigma of a match's pixel, px; small residuals do not make a match more precise than its feature."""
HUBER = 2.0
"""Residuals beyond this many sigmas have a linear cost (Huber's loss)."""
READINGS_AVERAGE = 3.0
"""Ratio of the sigma of one depth reading to that of a match: a mean of 25 readings, whose noise is correlated."""
Bool = npt.NDArray[np.bool_]

STEPS = 3
"""Gauss-Newton steps of each match's depth under one pose."""
NO_PARALLAX = 1e-6
"""Smallest pixel motion per unit of log depth for which an epipolar line has a direction, px."""
FARTHEST = 3.0
"""Largest change of a match's log depth from its measurement, sigmas."""


@dataclass(frozen=True)
class OneWay:
    """3D points (n, 3) m of one view, and the pixels px (n, 2) at which the other view, with intrinsics K, saw them."""

    points: Array
    px: Array
    K: Array


@dataclass(frozen=True)
class Reprojected:
    """The points of one direction under a pose, at their estimated depth."""

    points: Array
    """(n, 3) m, in the camera that measured them."""
    moved: Array
    """(n, 3) m, in the camera that saw the pixels."""
    by_point: Array
    """(n, 2, 3) px per metre, derivative of the pixel by the moved point."""
    along: Array
    """(n, 2) px, derivative of the pixel by the logarithm of the point's depth."""
    residual: Array
    """(n, 2) px, residual at the measured depth, linearised at the estimated one."""


def reprojected(way: OneWay, T: Array, pixel_sigma: float, depth_sigma: Array) -> Reprojected:
    """Reproject under T (4x4); depth_sigma (n,): sigma of the points' log depth, zeros keep the measured depth."""
    seen = _seen(way, T, np.zeros(len(way.points)))
    if not depth_sigma.any():
        return seen
    variance = np.square(depth_sigma)
    for _ in range(STEPS):
        gain = variance / (pixel_sigma**2 + variance * np.square(seen.along).sum(1))
        change = -gain * (seen.along * seen.residual).sum(1)
        seen = _seen(way, T, np.clip(change, -FARTHEST * depth_sigma, FARTHEST * depth_sigma))
    return seen


def _seen(way: OneWay, T: Array, change: Array) -> Reprojected:
    points = way.points * np.exp(change)[:, None]
    moved = transform(T, points)
    by_point = _by_point(moved, way.K)
    turned = (T[:3, :3] @ points.T).T
    along = np.asarray((by_point @ turned[..., None])[..., 0])
    return Reprojected(points, moved, by_point, along, project(way.K, moved) - way.px - along * change[:, None])


def _by_point(points: Array, K: Array) -> Array:
    """(n, 2, 3) px per metre, derivative of the projection at points (n, 3) m."""
    x, y, z = points.T
    D = np.zeros((len(z), 2, 3))
    D[:, 0, 0], D[:, 0, 2] = K[0, 0] / z, -K[0, 0] * x / z**2
    D[:, 1, 1], D[:, 1, 2] = K[1, 1] / z, -K[1, 1] * y / z**2
    return D


def whitened(seen: Reprojected, pixel_sigma: float, depth_sigma: float) -> Array:
    """Residuals (n, 2) px, shrunk along a so that their covariance s^2 1 + p^2 a a' becomes s^2 1."""
    if depth_sigma == 0:
        return seen.residual
    direction, length = _directions(seen.along)
    share = pixel_sigma / np.hypot(pixel_sigma, depth_sigma * length)
    return np.asarray(seen.residual - direction * (seen.residual * direction).sum(1, keepdims=True) * (1 - share))


def across(seen: Reprojected) -> Array:
    """(n,) px, residuals across the epipolar lines, which no depth explains."""
    direction, _ = _directions(seen.along)
    return np.asarray(seen.residual[:, 1] * direction[:, 0] - seen.residual[:, 0] * direction[:, 1])


def _directions(along: Array) -> tuple[Array, Array]:
    """Unit vectors (n, 2) and lengths (n, 1) px; the unit vector is arbitrary where there is no parallax."""
    length = np.linalg.norm(along, axis=1, keepdims=True)
    return np.where(length > NO_PARALLAX, along / np.maximum(length, NO_PARALLAX), [1.0, 0.0]), length


def inliers_of(way: OneWay, T: Array, threshold_px: float, patch_sigma: float = 0.0) -> Bool:
    """Mask (n,) of the points that T brings in front of the camera and within `threshold_px` of their pixels.

    With `patch_sigma` (relative error of depth), residuals are whitened to one pixel before they are compared.
    """
    with np.errstate(divide="ignore", invalid="ignore"):
        seen = reprojected(way, T, 1.0, np.full(len(way.points), patch_sigma))
        sigmas = whitened(seen, 1.0, patch_sigma)
    return np.asarray((seen.moved[:, 2] > 0.01) & (np.linalg.norm(sigmas, axis=-1) < threshold_px))


def keep(way: OneWay, mask: Bool) -> OneWay:
    """The matches where mask is true."""
    return OneWay(way.points[mask], way.px[mask], way.K)


@dataclass(frozen=True)
class Normal:
    """Normal equations of one direction over the left twist of the pose that moves its points."""

    informations: Array
    """(n, 6, 6) summands of the Hessian `H`, one per match."""
    scores: Array
    """(n, 6) summands of the gradient `b`, one per match."""
    from_points: Array
    """(6, 8) derivative of `b` by each error that the measured points may share (`depth_errors.py`)."""
    from_pixels: Array
    """(6, 8) derivative of `b` by each error of the view that saw the pixels; only its pointing matters."""
    residual_px: Array
    """Residuals for the estimate of pixel noise, px: (n, 2), or (n,) across epipolar lines if `patch_sigma` > 0."""

    @property
    def H(self) -> Array:
        """(6, 6) Gauss-Newton Hessian of half the sum of squares."""
        return np.asarray(self.informations.sum(0))

    @property
    def b(self) -> Array:
        """(6,) gradient of half the sum of squares."""
        return np.asarray(self.scores.sum(0))


def normal_equations(way: OneWay, T: Array, pixel_sigma: float, lifting: Lifting) -> Normal:
    """Normal equations under T: residuals weighted by the noise of pixels and depth, with Huber's loss."""
    sigma = depth_sigma(way.points[:, 2].astype(np.float32), lifting) / READINGS_AVERAGE
    relative = np.hypot(sigma / np.maximum(way.points[:, 2], 1e-6), lifting.patch_sigma)
    seen = reprojected(way, T, pixel_sigma, relative if lifting.patch_sigma > 0 else np.zeros(len(sigma)))
    residual, along = seen.residual, seen.along
    D = seen.by_point
    J = D @ point_jacobian(seen.moved)
    C = pixel_sigma**2 * np.eye(2) + along[:, :, None] * along[:, None, :] * relative[:, None, None] ** 2
    W = np.linalg.inv(C)
    size = np.sqrt(np.maximum(np.einsum("ni,nij,nj->n", residual, W, residual), 1e-12))
    W = W * np.minimum(1.0, HUBER / size)[:, None, None]
    JW = J.transpose(0, 2, 1) @ W
    fields = D @ (T[:3, :3] @ error_fields(seen.points))
    pointing = np.zeros((2, 8))
    pointing[0, 6], pointing[1, 7] = -way.K[0, 0], -way.K[1, 1]
    scores = (JW @ residual[..., None])[..., 0]
    of_pixels = across(seen) if lifting.patch_sigma > 0 else residual
    return Normal(JW @ J, scores, (JW @ fields).sum(0), JW.sum(0) @ pointing, of_pixels)
