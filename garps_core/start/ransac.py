# SPDX-License-Identifier: Apache-2.0
"""Pose from the directions of matches, depth giving its length alone: for depth worse than what pixels say.

PnP on depth that is off by a tenth finds few matches that agree with each other, and turns what is wrong with the
depth into rotation. The essential matrix (five points, PoseLib) needs no depth for rotation and direction.
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
"""Of RANSAC: more costs a second where most matches are wrong."""
EPIPOLAR_SHARE = 1 / 3
"""Of `start.ransac_px`, a match's distance from its epipolar line: without depth in it, it is that much smaller."""
MIN_LENGTHS = 4
"""Depths that agree with the directions' triangulation; fewer say no length."""


def pose_from_bearings(matches: Matches, K_source: Array, K_target: Array, config: Config) -> Array | None:
    """4x4 T_target_source, the length of its translation in m the median of measured over triangulated depth.

    None where too few matches fit one pose. Where the cameras only turn the length means nothing, nor does it matter.
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
    """Depths (n, 2) at which two rays (n, 3), z = 1, come closest under T_target_source, in its unit."""
    along = np.stack([rays_source @ T[:3, :3].T, -rays_target], -1)
    return np.asarray(-np.linalg.pinv(along) @ T[:3, 3])


def pinhole(K: Array) -> dict[str, object]:
    """A camera for PoseLib; the size is of no use to it."""
    parameters = [K[index] for index in ((0, 0), (1, 1), (0, 2), (1, 2))]
    return {"model": "PINHOLE", "width": 0, "height": 0, "params": parameters}


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
