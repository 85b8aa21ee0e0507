# SPDX-License-Identifier: Apache-2.0
"""RGB-D odometry of Open3D: direct alignment of two images with depth, coarse to fine, from a start pose.

The older of Open3D's two implementations: from the starts of `bench.pairs.starts` it ends nearer to the truth than
the tensor one does with any number of levels and iterations.
"""

from __future__ import annotations

import dataclasses
from typing import Any

import cv2
import numpy as np

from bench.peers.features_pnp import Failure
from bench.peers.registration import open3d
from garps_core.checks import Float64Array
from garps_core.types import View

SAME_K_PX = 1.0
"""Two cameras whose intrinsics differ by less are taken as one."""
ITERATIONS = [40, 30, 30]
"""Coarse (a quarter of the resolution) to fine; a fourth level loses pairs."""
DEPTH_DIFFERENCE_M = {"hybrid": 0.15, "intensity": 0.3}
"""Pixels whose depths differ by more are left out. Colour alone needs more of them; the other does as well at 0.07."""
NEAR_M, FAR_M = 0.1, 20.0


def rgbd_hybrid(source: View, target: View, T_start: Float64Array) -> Float64Array:
    """RGB-D odometry of Open3D, colour and depth."""
    return rgbd_odometry(source, target, T_start, "hybrid")


def rgbd_intensity(source: View, target: View, T_start: Float64Array) -> Float64Array:
    """RGB-D odometry of Open3D, colour alone."""
    return rgbd_odometry(source, target, T_start, "intensity")


def rgbd_odometry(source: View, target: View, T_start: Float64Array, kind: str) -> Float64Array:
    """4x4 T_target_source by Open3D's odometry.

    Args:
        source: has depth.
        target: has depth; it is resampled to the source's intrinsics where they differ by `SAME_K_PX` or more, because
            the library knows one camera only.
        T_start: 4x4.
        kind: "hybrid" (colour and depth) or "intensity".
    Raises:
        Failure: no depth, or the library says that it failed.
    """
    o3d = open3d()
    odometry = o3d.pipelines.odometry
    terms = {
        "hybrid": odometry.RGBDOdometryJacobianFromHybridTerm,
        "intensity": odometry.RGBDOdometryJacobianFromColorTerm,
    }
    levels = o3d.utility.IntVector(ITERATIONS)
    option = odometry.OdometryOption(levels, DEPTH_DIFFERENCE_M[kind], NEAR_M, FAR_M)
    height, width = source.rgb.shape[:2]
    K = source.K
    camera = o3d.camera.PinholeCameraIntrinsic(width, height, K[0, 0], K[1, 1], K[0, 2], K[1, 2])
    images = [_rgbd(o3d, view) for view in (source, with_intrinsics(target, source))]
    found, T, _ = odometry.compute_rgbd_odometry(*images, camera, T_start, terms[kind](), option)
    if not found:
        raise Failure("odometry failed")
    return np.asarray(T, np.float64)


def with_intrinsics(view: View, other: View) -> View:
    """`view` as a camera with the intrinsics and size of `other` would see it from the same place.

    Exact but for the interpolation of colours: depth is along z, which does not depend on K, and takes the nearest.
    Pixels from beyond the image have no depth. Unchanged where K differs by less than `SAME_K_PX` and sizes agree.
    """
    if view.rgb.shape == other.rgb.shape and np.abs(view.K - other.K).max() < SAME_K_PX:
        return view
    H = other.K @ np.linalg.inv(view.K)
    size = other.rgb.shape[1::-1]
    rgb = cv2.warpPerspective(view.rgb, H, size, flags=cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    depth = None
    if view.depth is not None:
        border: Any = {"borderMode": cv2.BORDER_CONSTANT, "borderValue": float("nan")}
        depth = np.asarray(cv2.warpPerspective(view.depth, H, size, flags=cv2.INTER_NEAREST, **border), np.float32)
    return dataclasses.replace(view, rgb=np.asarray(rgb, np.uint8), K=other.K, depth=depth)


def _rgbd(o3d: Any, view: View) -> Any:
    if view.depth is None:
        raise Failure("no depth")
    if not np.isfinite(view.depth).any():
        raise Failure("no pixel with depth")
    colour = o3d.geometry.Image(np.ascontiguousarray(view.rgb))
    depth = o3d.geometry.Image(np.nan_to_num(view.depth, nan=0.0).astype(np.float32))
    return o3d.geometry.RGBDImage.create_from_color_and_depth(colour, depth, 1.0, FAR_M, True)
