# SPDX-License-Identifier: Apache-2.0
"""RANSAC (PoseLib) over matches: absolute pose from 3D points, or relative pose from bearings with depth for its scale.

PnP on depth that is off by a tenth finds few matches that agree with each other, and turns the errors of depth into
rotation. The essential matrix (five points) needs no depth for the rotation and the direction of the translation.
"""

from __future__ import annotations

import numpy as np
import poselib

from garps_core.config import Config
from garps_core.geometry import Array, pixel_rays
from garps_core.start.features import Matches
from garps_core.start.reprojection import (
    OneWay,
)

MOST_TRIALS = 10_000
"""Largest number of RANSAC trials; more would take over a second where most matches are wrong."""
EPIPOLAR_SHARE = 1 / 3
"""Largest distance of an inlier from its epipolar line, as a share of `start.ransac_px`; it holds no depth error."""
MIN_LENGTHS = 4
"""Fewest matches with a positive ratio of measured over triangulated depth; fewer do not determine the scale."""


def pose_from_bearings(matches: Matches, K_source: Array, K_target: Array, config: Config) -> Array | None:
    """Estimate 4x4 T_target_source (m); the median ratio of measured to triangulated depth sets its scale.

    None where too few matches fit one pose. The scale is arbitrary, and irrelevant, where the cameras only turn.
    """
    if len(matches) < max(5, config.start.min_inliers):
        return None
    px = EPIPOLAR_SHARE * config.start.ransac_px
    trials = {"max_iterations": MOST_TRIALS, "seed": config.seed}
    options = {"max_epipolar_error": px, "max_error": px, **trials}
    cameras = [pinhole(K_source), pinhole(K_target)]
    pose, info = poselib.estimate_relative_pose(matches.source_px, matches.target_px, *cameras, options, {})
    T, inlier = np.eye(4), np.asarray(info["inliers"], bool)
    T[:3] = pose.Rt
    if inlier.sum() < config.start.min_inliers or not np.isfinite(T).all():
        return None
    rays = [pixel_rays(K_source, *matches.source_px[inlier].T), pixel_rays(K_target, *matches.target_px[inlier].T)]
    measured = np.stack([matches.source_points[inlier, 2], matches.target_points[inlier, 2]], axis=1)
    ratios = measured / triangulated(T, *rays)
    ratios = ratios[np.isfinite(ratios) & (ratios > 0)]
    if len(ratios) < MIN_LENGTHS:
        return None
    T[:3, 3] *= np.median(ratios)
    return T


def triangulated(T: Array, rays_source: Array, rays_target: Array) -> Array:
    """Depths (n, 2) in both cameras at which two rays (n, 3), z = 1, come closest; in the unit of T_target_source."""
    along = np.stack([rays_source @ T[:3, :3].T, -rays_target], -1)
    return np.asarray(-np.linalg.pinv(along) @ T[:3, 3])


def pinhole(K: Array) -> dict[str, object]:
    """The camera K (3x3) for PoseLib, which does not use the image size."""
    parameters = [K[index] for index in ((0, 0), (1, 1), (0, 2), (1, 2))]
    return {"model": "PINHOLE", "width": 0, "height": 0, "params": parameters}


def ransac(way: OneWay, threshold_px: float, config: Config, least: int = 1000) -> Array | None:
    """Find the 4x4 pose from way.points (m) to the camera that saw way.px in at least `least` trials; None without."""
    if len(way.points) < max(4, config.start.min_inliers):
        return None
    trials = {"min_iterations": least, "max_iterations": MOST_TRIALS, "seed": config.seed}
    options = {"max_reproj_error": threshold_px, **trials}
    pose, info = poselib.estimate_absolute_pose(way.px, way.points, pinhole(way.K), options, {})
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = pose.R, pose.t
    return T if info["num_inliers"] >= 4 and np.isfinite(T).all() else None
