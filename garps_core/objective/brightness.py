# SPDX-License-Identifier: Apache-2.0
"""Direct (photometric) alignment: a point that one camera measured in 3D looks equally bright to the other camera.

No features and no correspondences are needed, and depth errors hardly matter: a point whose depth is off by a few per
cent moves in the other image by that share of the parallax only, not of the depth. The basin is small, a few pixels of
the coarsest grid, so this comes after the mixtures are aligned, whose result is the prior:

    minimise  measurements / 2 * sum rho((I_y(pi(T p)) - gain I_x(p) - offset) / sigma)  +  r' Lambda r / 2

Both directions count. Gain and offset absorb the exposure, sigma is the residuals' own spread, rho is Tukey's
biweight. Where a view's depth is off from place to place (`Frustum.patch_sigma`), the brightness that this changes at a
point is added to the variance of its residual. (Direct alignment as in Steinbruecker et al. 2011 and Kerl et al. 2013,
between two whole views.)
"""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import lru_cache

import cv2
import numpy as np
import numpy.typing as npt
import torch

from garps_core.checks import Float32Array
from garps_core.depth_errors import error_fields
from garps_core.edges import GRID_EDGE_RATIO, away_from_edges
from garps_core.geometry import Array, adjoint, pixel_rays, se3_exp, se3_inverse, se3_log
from garps_core.mixture import Frustum
from garps_core.objective.visibility import SAME_SURFACE_RATIO, surface_at

GRIDS = (8, 4, 2, 1)
"""Strides through the cells of the frustum's grid, coarse to fine. The basin is a few cells of the coarsest grid."""
STEPS = 6
"""Gauss-Newton steps on every grid."""
MAX_POINTS = 6000
"""Largest number of points per direction; those with the strongest gradients are used."""
MIN_POINTS = 100
"""Smallest number of points per direction that must fall into the other image."""
NEAREST_M = 0.05
"""Smallest distance of a point from the other camera, m; nearer points are left out."""
MIN_CONTRAST = 0.02
"""Standard deviation of the brightness (of 0..1) below which there is nothing to compare."""
TUKEY = 4.0
"""Residuals of more sigmas than this are outliers, of weight 0 (Tukey's biweight)."""
SMALLEST_SIGMA = 2e-3
"""Smallest sigma of the residuals, in shares of full brightness; 8-bit images are not more precise."""


@dataclass(frozen=True)
class BrightnessFit:
    """Pose T (4x4), its covariance (6x6, left twist), and the agreement of brightness at that pose."""

    T: Array
    covariance: Array
    correlation: float
    """Correlation (-1..1) of points and the pixels they fall on, the smaller of both directions."""
    share: float
    """Share (0..1) of the points that the other camera sees, the smaller of both directions."""
    kept: Array = field(default_factory=lambda: np.eye(6))
    """Matrix (6, 6) that takes an error of the prior, a left twist, to the error of T that remains of it."""


@dataclass(frozen=True)
class Grid:
    """One resolution of a view: image, its slopes, depth and intrinsics; points (n, 3) m with their brightness."""

    image: Float32Array
    slope_x: Float32Array
    slope_y: Float32Array
    depth: Float32Array
    K: Array
    points: Array
    brightness: Array
    patch_sigma: float
    """Relative error of the points' depth that differs from place to place."""


@dataclass(frozen=True)
class _Overlay:
    """Points of one view that fall on pixels of the other: mask, places (m and pixels), and both brightnesses."""

    inside: npt.NDArray[np.bool_]
    moved: Array
    pixel: Array
    own: Array
    theirs: Array
    correlation: float
    share: float


@dataclass(frozen=True)
class Comparison:
    """Normal equations of one direction over the left twist of the pose that moves its points."""

    information: Array
    gradient: Array
    of_depth: Array
    """Gradient (6, 8) per unit of each error that the points may share (`depth_errors.py`)."""
    correlation: float
    share: float


def fit_brightness(
    source: Frustum, target: Frustum, T: Array, covariance: Array, measurements: float, sigmas: Array
) -> BrightnessFit | None:
    """Fit a pose to the brightness of both views and to a prior.

    Args:
        source, target: what the two cameras saw.
        T, covariance: 4x4 prior, and its 6x6 covariance over the left twist.
        measurements: independent measurements per point of the finest grid; 0 = only compare, at T.
        sigmas: (8,) of the errors that a view's points share; their effect on the pose is added to its covariance.
    Returns:
        The fit; None when a view has no brightness, or the views have too few points or too little contrast in common.
    """
    if source.brightness is None or target.brightness is None:
        return None
    if measurements <= 0:
        return _only_compared(source, target, T, covariance)
    precision, at = np.asarray(np.linalg.inv(covariance), np.float64), T
    for step in GRIDS:
        x, y = grid_of(source, step), grid_of(target, step)
        at = ascend_on(x, y, at, T, precision, 0.5 * measurements * step**2, STEPS)
    both = comparisons(x, y, at)
    if both is None:
        return None
    f, b = both
    weight = 0.5 * measurements
    inverse = np.linalg.inv(weight * summed(f, b, at)[0] + precision)
    B, spread = -adjoint(se3_inverse(at)), inverse.copy()
    for gradient in (f.of_depth, B.T @ b.of_depth):
        effect = inverse @ (weight * gradient) * sigmas
        spread += effect @ effect.T
    agreement = min(f.correlation, b.correlation), min(f.share, b.share)
    return BrightnessFit(at, np.asarray(0.5 * (spread + spread.T)), *agreement, kept=np.asarray(inverse @ precision))


def ascend_on(x: Grid, y: Grid, at: Array, T: Array, precision: Array, weight: float, steps: int) -> Array:
    """Take Gauss-Newton steps on one pair of grids from pose `at`, with a prior at T of the given precision (6, 6)."""
    for _ in range(steps):
        seen = comparisons(x, y, at)
        if seen is None:
            break
        H, g = summed(*seen, at)
        move = np.linalg.solve(weight * H + precision, weight * g - precision @ se3_log(at @ se3_inverse(T)))
        at = np.asarray(se3_exp(np.asarray(move, np.float64)) @ at)
    return at


def _only_compared(source: Frustum, target: Frustum, T: Array, covariance: Array) -> BrightnessFit | None:
    x, y = grid_of(source, GRIDS[-1]), grid_of(target, GRIDS[-1])
    f, b = _overlaid(x, y, T), _overlaid(y, x, se3_inverse(T))
    if f is None or b is None:
        return None
    return BrightnessFit(T, covariance, min(f.correlation, b.correlation), min(f.share, b.share))


@lru_cache(maxsize=16)
def grid_of(view: Frustum, step: int) -> Grid:
    """Take every `step`-th cell of a frustum; cached, because a search asks for the same grid many times."""
    assert view.brightness is not None  # noqa: S101 - `fit_brightness` has checked
    image = view.brightness if step == 1 else cv2.GaussianBlur(view.brightness, (0, 0), 0.5 * step)
    image = np.ascontiguousarray(image[step // 2 :: step, step // 2 :: step], np.float32)
    depth = np.ascontiguousarray(view.depth[step // 2 :: step, step // 2 :: step])
    K = view.K.copy()
    K[:2] /= step
    K[:2, 2] -= (step // 2) / step
    slope_x, slope_y = (cv2.Scharr(image, cv2.CV_32F, dx, 1 - dx) / np.float32(32) for dx in (1, 0))
    v, u = np.nonzero(away_from_edges(depth, GRID_EDGE_RATIO))
    strength = np.hypot(slope_x, slope_y)[v, u]
    if len(u) > MAX_POINTS:
        strongest = np.sort(np.argpartition(-strength, MAX_POINTS)[:MAX_POINTS])
        u, v = u[strongest], v[strongest]
    points = pixel_rays(K, u.astype(float), v.astype(float)) * depth[v, u].astype(float)[:, None]
    return Grid(image, slope_x, slope_y, depth, K, points, image[v, u].astype(float), view.patch_sigma)


def comparisons(x: Grid, y: Grid, T: Array) -> tuple[Comparison, Comparison] | None:
    """Compare x under T with y, and y under the inverse of T with x; None when too little can be compared."""
    f = _compared(x, y, T)
    b = None if f is None else _compared(y, x, se3_inverse(T))
    return None if f is None or b is None else (f, b)


def summed(f: Comparison, b: Comparison, T: Array) -> tuple[Array, Array]:
    """Information and gradient of both directions over the left twist of T."""
    B = -adjoint(se3_inverse(T))
    return f.information + B.T @ b.information @ B, f.gradient + B.T @ b.gradient


def _overlaid(x: Grid, y: Grid, T: Array) -> _Overlay | None:
    """Lay the points of x over the pixels of y; None when too few fall on any, or there is too little contrast."""
    moved = x.points @ T[:3, :3].T + T[:3, 3]
    pixel = _pixels_of(moved, y)
    inside = np.isfinite(pixel[:, 0])
    if inside.sum() < MIN_POINTS:
        return None
    own, theirs = x.brightness[inside], _sampled(y.image, *pixel[inside].T)
    if min(np.std(own), np.std(theirs)) < MIN_CONTRAST:
        return None
    correlation = float(np.corrcoef(own, theirs)[0, 1])
    return _Overlay(inside, moved[inside], pixel[inside], own, theirs, correlation, float(inside.mean()))


def _compared(x: Grid, y: Grid, T: Array) -> Comparison | None:
    """Normal equations of the points of x against the pixels of y; None when too little can be compared."""
    overlay = _overlaid(x, y, T)
    if overlay is None:
        return None
    slope_x, slope_y = (_sampled(image, *overlay.pixel.T) for image in (y.slope_x, y.slope_y))
    exposure = np.stack([overlay.own, np.ones_like(overlay.own)], axis=1)
    z = overlay.moved[:, 2]
    a, b = slope_x * y.K[0, 0] / z, slope_y * y.K[1, 1] / z
    slope = np.stack([a, b, -(a * overlay.moved[:, 0] + b * overlay.moved[:, 1]) / z], axis=1)  # brightness per metre
    by_depth = (slope * (x.points[overlay.inside] @ T[:3, :3].T)).sum(1)  # brightness per unit of relative depth error
    error, weights = _robust(overlay.theirs, exposure, np.square(x.patch_sigma * by_depth))
    J = np.concatenate([slope, np.cross(overlay.moved, slope)], axis=1)
    weighted = exposure * weights[:, None]
    J = J - exposure @ np.linalg.solve(weighted.T @ exposure + 1e-9 * np.eye(2), weighted.T @ J)  # exposure is free
    JW = (J * weights[:, None]).T
    fields = T[:3, :3] @ error_fields(x.points[overlay.inside])
    of_depth = JW @ np.einsum("ni,nik->nk", slope, fields)
    return Comparison(JW @ J, -JW @ error, of_depth, overlay.correlation, overlay.share)


def _pixels_of(moved: Array, y: Grid) -> Array:
    """Pixels (n, 2) of y on which points (n, 3) m fall; NaN near or beyond the border, and on another surface."""
    points, (height, width) = torch.from_numpy(moved), y.image.shape
    pixel, inside, surface = surface_at(points, torch.from_numpy(y.K), torch.from_numpy(y.depth))
    (u, v), z, surface = pixel.T, points[:, 2], surface.double()
    inside &= (z > NEAREST_M) & (u > 1) & (v > 1) & (u < width - 2) & (v < height - 2)
    inside &= ~((z - surface).abs() > SAME_SURFACE_RATIO * surface)  # kept where the depth is unknown
    return np.where(inside.numpy()[:, None], pixel.numpy(), np.nan)


def _sampled(image: Float32Array, u: Array, v: Array) -> Array:
    columns, rows = u.astype(np.float32)[None], v.astype(np.float32)[None]
    return np.asarray(cv2.remap(image, columns, rows, cv2.INTER_LINEAR)[0], np.float64)


def _robust(theirs: Array, exposure: Array, variance: Array) -> tuple[Array, Array]:
    """Residuals after the best gain and offset, and Tukey's weights over their own variance and the one given (n,)."""
    weights = np.ones(len(theirs))
    for _ in range(3):
        weighted = exposure * weights[:, None]
        fit = np.linalg.solve(weighted.T @ exposure + 1e-9 * np.eye(2), weighted.T @ theirs)
        error = theirs - exposure @ fit
        sigma = max(1.4826 * float(np.median(np.abs(error))), SMALLEST_SIGMA)
        weights = np.square(np.maximum(1 - np.square(error / (TUKEY * sigma)), 0))
    return error, weights / (sigma**2 + variance)
