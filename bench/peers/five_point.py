# SPDX-License-Identifier: Apache-2.0
"""Relative pose from calibrated matches alone (five points and bundle adjustment), with a length from depth."""

from __future__ import annotations

import numpy as np

from bench.peers.features_pnp import MIN_INLIERS, Failure, camera, matches
from bench.peers.metres import Triangulated, with_length
from garps_core.checks import Float64Array
from garps_core.geometry import pixel_rays
from garps_core.types import View

EPIPOLAR_PX = 1.0
"""PoseLib's default; rotations are as good up to 2 px and worse from 3."""


def five_point(source: View, target: View) -> Float64Array:
    """RootSIFT, PoseLib's five points and bundle adjustment; the length of t from depth (`bench.peers.metres`).

    Raises:
        Failure: too few matches, inliers, or inliers with depth.
    """
    import poselib

    pixels = matches(source.rgb, target.rgb)
    if len(pixels[0]) < MIN_INLIERS:
        raise Failure(f"{len(pixels[0])} matches, {MIN_INLIERS} needed")
    options = {"max_epipolar_error": EPIPOLAR_PX, "max_error": EPIPOLAR_PX}
    pose, info = poselib.estimate_relative_pose(*pixels, camera(source.K), camera(target.K), options, {})
    inliers = np.asarray(info["inliers"], bool)
    if inliers.sum() < MIN_INLIERS:
        raise Failure(f"no pose with {MIN_INLIERS} inliers ({len(inliers)} matches)")
    T = np.eye(4)
    T[:3] = pose.Rt
    kept = [part[inliers] for part in pixels]
    z = _triangulated(T, *(pixel_rays(view.K, *part.T) for view, part in zip((source, target), kept, strict=True)))
    return with_length(T, [Triangulated(source, kept[0], z[:, 0]), Triangulated(target, kept[1], z[:, 1])])


def _triangulated(T: Float64Array, rays_source: Float64Array, rays_target: Float64Array) -> Float64Array:
    """Depths Nx2 at which two rays (Nx3, z = 1) come closest, under T_target_source."""
    pairs = np.stack([rays_source @ T[:3, :3].T, -rays_target], -1)
    return -np.linalg.pinv(pairs) @ T[:3, 3]
