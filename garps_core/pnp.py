# SPDX-License-Identifier: Apache-2.0
"""Metric pose from matches: each view's 3D points against the other's pixels, both directions in one estimate.

PoseLib finds the pose and its inliers; the joint refinement and its covariance are ours, since the covariance is
what the alignment takes as the prior. A residual's noise is the pixel noise plus what the depth noise of its 3D
point does to the pixel; errors that all points of a view share (scale, slow warp of a depth map) do not average
out, and are added through their effect on the pose (`systematic.py`).

What depth errors do to a pixel lies along its epipolar line. Where a network's depth is off from place to place
(`lifting.patch_sigma`), residuals along it count for less, down to the epipolar error alone, and the pose from
bearings (`bearings.py`) is one more to begin with. Each match's depth is an unknown then (`match_depth.py`).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
import poselib

from garps_core.bearings import MOST_TRIALS, pinhole, pose_from_bearings
from garps_core.config import Config, Lifting
from garps_core.errors import InitialisationError
from garps_core.features import Matches
from garps_core.geometry import Array, adjoint, point_jacobian, se3_exp, se3_inverse
from garps_core.lift import depth_sigma
from garps_core.match_depth import OneWay, across, seen_at_likely_depths, whitened
from garps_core.systematic import shared_errors, shared_sigmas
from garps_core.types import Prior, View
from garps_core.uncertainty import ros_from_twist

MIN_PIXEL_SIGMA = 0.3
"""px; no residuals, however small, make a match more precise than features are."""
HUBER = 2.0
"""Residuals beyond this many sigmas count with their length, not its square."""
REFINEMENT_STEPS = 8
READINGS_AVERAGE = 3.0
"""The depth of a match is the mean of 25 readings, whose noise is not independent: so much surer than one of them."""

Bool = npt.NDArray[np.bool_]


def pose_from_matches(matches: Matches, source: View, target: View, config: Config, origin: str = "features") -> Prior:
    """Pose with covariance from matches with depth. Raises InitialisationError with the counts when it cannot."""
    has_s, has_t = (np.isfinite(p[:, 0]) for p in (matches.source_points, matches.target_points))
    forward = OneWay(matches.source_points[has_s], matches.target_px[has_s], target.K)
    backward = OneWay(matches.target_points[has_t], matches.source_px[has_t], source.K)
    need, gate = config.start.min_inliers, (config.start.ransac_px, config.lifting.patch_sigma)
    candidates = [ransac(forward, gate[0], config), _inverse(ransac(backward, gate[0], config))]
    if config.lifting.patch_sigma > 0:
        candidates.append(pose_from_bearings(matches, source.K, target.K, config))
    scored = [
        (inliers_of(forward, T, *gate), inliers_of(backward, se3_inverse(T), *gate), T)
        for T in candidates
        if T is not None
    ]
    if not scored:
        raise InitialisationError(f"{len(matches)} feature matches, {has_s.sum()} with depth: no pose fits them")
    inlier_f, inlier_b, T = max(scored, key=lambda s: int(s[0].sum() + s[1].sum()))
    count = int(max(inlier_f.sum(), inlier_b.sum()))
    if count < need:
        raise InitialisationError(f"{len(matches)} feature matches, {count} fit one pose: expected at least {need}")
    ways = (keep(forward, inlier_f), keep(backward, inlier_b))
    T, covariance = _refine(T, *ways, config)
    reason = f"{len(matches)} feature matches, {count} inliers"
    return Prior(T, covariance, origin, reason)


def ransac(way: OneWay, threshold_px: float, config: Config, least: int = 1000) -> Array | None:
    """Pose that maps way.points into the camera that saw way.px, after so many trials at least; None without any."""
    if len(way.points) < max(4, config.start.min_inliers):
        return None
    trials = {"min_iterations": least, "max_iterations": MOST_TRIALS, "seed": config.seed}
    options = {"max_reproj_error": threshold_px, **trials}
    pose, info = poselib.estimate_absolute_pose(way.px, way.points, pinhole(way.K), options, {})
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = pose.R, pose.t
    return T if info["num_inliers"] >= 4 and np.isfinite(T).all() else None


def _inverse(T: Array | None) -> Array | None:
    return None if T is None else se3_inverse(T)


def inliers_of(way: OneWay, T: Array, threshold_px: float, patch_sigma: float = 0.0) -> Bool:
    """Which of the way's points T brings in front of the camera and within so many pixels of where it saw them.

    Where depth is off by `patch_sigma` from place to place, so many sigmas of that and of one pixel are allowed.
    """
    with np.errstate(divide="ignore", invalid="ignore"):
        seen = seen_at_likely_depths(way, T, 1.0, np.full(len(way.points), patch_sigma))
        sigmas = whitened(seen, 1.0, patch_sigma)
    return np.asarray((seen.moved[:, 2] > 0.01) & (np.linalg.norm(sigmas, axis=-1) < threshold_px))


def keep(way: OneWay, mask: Bool) -> OneWay:
    """The matches where mask is true."""
    return OneWay(way.points[mask], way.px[mask], way.K)


@dataclass(frozen=True)
class Normal:
    """Normal equations of one direction over the left twist of the pose that moves its points."""

    informations: Array
    """(n, 6, 6) what each match adds to the Hessian `H`."""
    scores: Array
    """(n, 6) what each match adds to the gradient `b`."""
    from_points: Array
    """(6, 8) d b per unit of each error that the view which measured the points may share (`systematic.py`)."""
    from_pixels: Array
    """(6, 8) the same for the view that saw the pixels: only its pointing matters."""
    residual_px: Array
    """What tells the noise of pixels: (n, 2), or (n,) across epipolar lines where depth is off by more than noise."""

    @property
    def H(self) -> Array:
        """(6, 6) Gauss-Newton Hessian of half the sum of squares."""
        return np.asarray(self.informations.sum(0))

    @property
    def b(self) -> Array:
        """(6,) gradient of half the sum of squares."""
        return np.asarray(self.scores.sum(0))


def normal_equations(way: OneWay, T: Array, pixel_sigma: float, lifting: Lifting) -> Normal:
    """Of the way's points under T: residuals over the noise of pixels and of the points' depth, made robust (Huber)."""
    sigma = depth_sigma(way.points[:, 2].astype(np.float32), lifting) / READINGS_AVERAGE
    relative = np.hypot(sigma / np.maximum(way.points[:, 2], 1e-6), lifting.patch_sigma)
    seen = seen_at_likely_depths(way, T, pixel_sigma, relative if lifting.patch_sigma > 0 else np.zeros(len(sigma)))
    residual, along = seen.residual, seen.along
    D = seen.by_point
    J = D @ point_jacobian(seen.moved)
    C = pixel_sigma**2 * np.eye(2) + along[:, :, None] * along[:, None, :] * relative[:, None, None] ** 2
    W = np.linalg.inv(C)
    size = np.sqrt(np.maximum(np.einsum("ni,nij,nj->n", residual, W, residual), 1e-12))
    W = W * np.minimum(1.0, HUBER / size)[:, None, None]
    JW = J.transpose(0, 2, 1) @ W
    fields = D @ (T[:3, :3] @ shared_errors(seen.points))
    pointing = np.zeros((2, 8))
    pointing[0, 6], pointing[1, 7] = -way.K[0, 0], -way.K[1, 1]
    scores = (JW @ residual[..., None])[..., 0]
    of_pixels = across(seen) if lifting.patch_sigma > 0 else residual
    return Normal(JW @ J, scores, (JW @ fields).sum(0), JW.sum(0) @ pointing, of_pixels)


def _refine(T: Array, forward: OneWay, backward: OneWay, config: Config) -> tuple[Array, Array]:
    """Robust joint Gauss-Newton over both directions; pose and its covariance (ROS meaning)."""
    sigma = 1.0
    for _ in range(REFINEMENT_STEPS):
        f, b, A = _both(T, forward, backward, sigma, config)
        step = -np.linalg.solve(f.H + A.T @ b.H @ A + 1e-9 * np.eye(6), f.b + A.T @ b.b)
        T = se3_exp(np.asarray(step, np.float64)) @ T
        error = np.concatenate([f.residual_px.ravel(), b.residual_px.ravel()])
        sigma = max(1.4826 * float(np.median(np.abs(error))), MIN_PIXEL_SIGMA)
    f, b, A = _both(T, forward, backward, sigma, config)
    H = f.H + A.T @ b.H @ A + 1e-9 * np.eye(6)
    # both directions use the same matches: their pixel noise is one noise, counted twice in H
    covariance = 2.0 * np.linalg.inv(H) * config.start.covariance_inflation**2
    for shared in (f.from_points + A.T @ b.from_pixels, f.from_pixels + A.T @ b.from_points):  # source, target
        effect = np.linalg.solve(H, shared) * shared_sigmas(config.lifting)
        covariance += effect @ effect.T
    return T, ros_from_twist(np.asarray(covariance, np.float64), T)


def _both(T: Array, forward: OneWay, backward: OneWay, sigma: float, config: Config) -> tuple[Normal, Normal, Array]:
    inverse = se3_inverse(T)
    f = normal_equations(forward, T, sigma, config.lifting)
    b = normal_equations(backward, inverse, sigma, config.lifting)
    return f, b, -adjoint(inverse)
