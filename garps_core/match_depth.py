# SPDX-License-Identifier: Apache-2.0
"""Where a match's depth lies, by its measurement and by the pixel that the other camera saw, under a pose.

A depth that is off moves the point's pixel along its epipolar line. Where depth is off by much more than noise
(`lifting.patch_sigma`) it is an unknown of its own, d = log(depth / measured), beside the pose:

    minimise  |pi(T p e^d) - u|^2 / s^2  +  d^2 / p^2          pixel noise s, depth error p

Eliminated, what is left over the pose is a residual with the covariance s^2 1 + p^2 a a', a = d pixel / d d, where all
derivatives are taken at the likely depth. Taken at the measured one, whose error is in them, they would draw the
translation to zero, as noise in a regressor does.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from garps_core.geometry import Array, project, transform

STEPS = 3
"""Of each match's depth under one pose."""
NO_PARALLAX = 1e-6
"""Pixels per unit of the logarithm of the depth below which an epipolar line has no direction."""
FARTHEST = 3.0
"""Sigmas of its measurement within which a match's depth is looked for."""


@dataclass(frozen=True)
class OneWay:
    """3D points (n, 3) m of one view and where the other view, with intrinsics K, saw them: px (n, 2)."""

    points: Array
    px: Array
    K: Array


@dataclass(frozen=True)
class Seen:
    """A way's points under a pose, at some depth."""

    points: Array
    """(n, 3) m, in the camera that measured them."""
    moved: Array
    """(n, 3) m, in the camera that saw the pixels."""
    by_point: Array
    """(n, 2, 3) px per metre that a moved point moves there."""
    along: Array
    """(n, 2) px by which a point moves in the image per unit of the logarithm of its depth."""
    residual: Array
    """(n, 2) px, at the measured depth, by the derivative at this one."""


def seen_at_likely_depths(way: OneWay, T: Array, pixel_sigma: float, depth_sigma: Array) -> Seen:
    """The way under T where depth is off by `depth_sigma` (n,) of its logarithm; zeros leave it as measured."""
    seen = _seen(way, T, np.zeros(len(way.points)))
    if not depth_sigma.any():
        return seen
    variance = np.square(depth_sigma)
    for _ in range(STEPS):
        gain = variance / (pixel_sigma**2 + variance * np.square(seen.along).sum(1))
        change = -gain * (seen.along * seen.residual).sum(1)
        seen = _seen(way, T, np.clip(change, -FARTHEST * depth_sigma, FARTHEST * depth_sigma))
    return seen


def _seen(way: OneWay, T: Array, change: Array) -> Seen:
    points = way.points * np.exp(change)[:, None]
    moved = transform(T, points)
    by_point = _by_point(moved, way.K)
    turned = (T[:3, :3] @ points.T).T
    along = np.asarray((by_point @ turned[..., None])[..., 0])
    return Seen(points, moved, by_point, along, project(way.K, moved) - way.px - along * change[:, None])


def _by_point(points: Array, K: Array) -> Array:
    """(n, 2, 3) px per metre that points (n, 3) m move in front of the camera that sees them."""
    x, y, z = points.T
    D = np.zeros((len(z), 2, 3))
    D[:, 0, 0], D[:, 0, 2] = K[0, 0] / z, -K[0, 0] * x / z**2
    D[:, 1, 1], D[:, 1, 2] = K[1, 1] / z, -K[1, 1] * y / z**2
    return D


def whitened(seen: Seen, pixel_sigma: float, depth_sigma: float) -> Array:
    """Residuals (n, 2) px with the covariance s^2 1 + p^2 a a' -> with s^2 1: less of what lies along a."""
    if depth_sigma == 0:
        return seen.residual
    direction, length = _directions(seen.along)
    share = pixel_sigma / np.hypot(pixel_sigma, depth_sigma * length)
    return np.asarray(seen.residual - direction * (seen.residual * direction).sum(1, keepdims=True) * (1 - share))


def across(seen: Seen) -> Array:
    """(n,) px, residuals across the epipolar lines: what no depth explains."""
    direction, _ = _directions(seen.along)
    return np.asarray(seen.residual[:, 1] * direction[:, 0] - seen.residual[:, 0] * direction[:, 1])


def _directions(along: Array) -> tuple[Array, Array]:
    """Unit vectors (n, 2), any where there is no parallax, and lengths (n, 1) px."""
    length = np.linalg.norm(along, axis=1, keepdims=True)
    return np.where(length > NO_PARALLAX, along / np.maximum(length, NO_PARALLAX), [1.0, 0.0]), length
