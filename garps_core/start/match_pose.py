# SPDX-License-Identifier: Apache-2.0
"""Metric pose from matches: each view's 3D points against the other's pixels, both directions in one estimate.

PoseLib finds the pose and its inliers; the joint refinement and its covariance are ours, since the covariance is
what the alignment takes as the prior. A residual's noise is the pixel noise plus what the depth noise of its 3D
point does to the pixel; errors that all points of a view share (scale, slow warp of a depth map) do not average
out, and are added through their effect on the pose (`depth_errors.py`).

What depth errors do to a pixel lies along its epipolar line. Where a network's depth is off from place to place
(`lifting.patch_sigma`), residuals along it count for less, down to the epipolar error alone, and the pose from
bearings (`ransac.py`) is one more to begin with. Each match's depth is an unknown then (`reprojection.py`).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from garps_core.config import Config
from garps_core.config.lifting import Lifting
from garps_core.depth_errors import error_sigmas
from garps_core.errors import InitialisationError
from garps_core.gauss_newton import NormalEquations, gauss_newton
from garps_core.geometry import Array, adjoint, ros_from_twist, se3_inverse
from garps_core.start.degenerate import fixed_pose
from garps_core.start.features import Matches
from garps_core.start.ransac import pose_from_bearings, ransac
from garps_core.start.reprojection import (
    DAMPING,
    MIN_PIXEL_SIGMA,
    Normal,
    OneWay,
    inliers_of,
    keep,
    normal_equations,
)
from garps_core.types import Prior, View

REFINEMENT_STEPS = 8


def pose_from_matches(matches: Matches, source: View, target: View, config: Config, origin: str = "features") -> Prior:
    """Return the pose with covariance that matches with depth give.

    Raises:
        InitialisationError: too few matches fit one pose, or those that do leave it open; with their counts.
    """
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
    places = max(matches.places(np.flatnonzero(has)[fit]) for has, fit in ((has_s, inlier_f), (has_t, inlier_b)))
    if places < need:
        counted = f"{count}" if places == count else f"{count} at {places} places"
        raise InitialisationError(f"{len(matches)} feature matches, {counted} fit one pose: expected at least {need}")
    ways = (keep(forward, inlier_f), keep(backward, inlier_b))
    reason = f"{len(matches)} feature matches, {count} inliers"
    with fixed_pose(reason):
        return Prior(*_refine(T, *ways, config), origin, reason)


def _inverse(T: Array | None) -> Array | None:
    return None if T is None else se3_inverse(T)


def _refine(T: Array, forward: OneWay, backward: OneWay, config: Config) -> tuple[Array, Array]:
    """Refine a pose by robust Gauss-Newton over both directions; return it and its covariance (ROS meaning)."""
    joint = TwoWayReprojection(forward, backward, config.lifting)
    T = gauss_newton(T, joint, REFINEMENT_STEPS)
    f, b, A = joint.directions(T)
    H = f.H + A.T @ b.H @ A + DAMPING
    # both directions use the same matches: their pixel noise is one noise, counted twice in H
    covariance = 2.0 * np.linalg.inv(H) * config.start.covariance_inflation**2
    for shared in (f.from_points + A.T @ b.from_pixels, f.from_pixels + A.T @ b.from_points):  # source, target
        effect = np.linalg.solve(H, shared) * error_sigmas(config.lifting)
        covariance += effect @ effect.T
    return T, ros_from_twist(np.asarray(covariance, np.float64), T)


@dataclass
class TwoWayReprojection:
    """Normal equations of the reprojection errors of both directions, for `gauss_newton`."""

    forward: OneWay
    backward: OneWay
    lifting: Lifting
    pixel_sigma: float = 1.0
    """Noise of the pixels, px, read off the residuals of the last pose."""

    def __call__(self, T: Array) -> NormalEquations:
        """Return H and g at the pose T (4x4), and update the noise of the pixels for the next one."""
        f, b, A = self.directions(T)
        error = np.concatenate([f.residual_px.ravel(), b.residual_px.ravel()])
        self.pixel_sigma = max(1.4826 * float(np.median(np.abs(error))), MIN_PIXEL_SIGMA)
        return f.H + A.T @ b.H @ A + DAMPING, f.b + A.T @ b.b

    def directions(self, T: Array) -> tuple[Normal, Normal, Array]:
        """Return the equations of each direction, and the map (6, 6) from the twist of T to that of its inverse."""
        inverse = se3_inverse(T)
        f = normal_equations(self.forward, T, self.pixel_sigma, self.lifting)
        b = normal_equations(self.backward, inverse, self.pixel_sigma, self.lifting)
        return f, b, -adjoint(inverse)
