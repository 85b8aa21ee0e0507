# SPDX-License-Identifier: Apache-2.0
"""Other people's ways to the same pose, each behind one signature.

`method(source, target, T_start) -> Result`: two RGB-D views and a 4x4 start pose (or None) to a 4x4 pose or the reason
why there is none. A method never raises on data. Every call starts from the images, so its wall time is honest.
Registration works on every second pixel, without those at depth edges, which are artefacts of the sensor: each peer got
the settings that served it best on the pairs of `bench.datasets`.
"""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import Any, NamedTuple

import cv2
import numpy as np
import numpy.typing as npt

from bench.odometry import rgbd_odometry
from bench.pnp import Failure, features_pnp
from garps_core.checks import Float64Array
from garps_core.geometry import pixel_rays
from garps_core.types import View

Levels = tuple[tuple[float, float], ...]
LEVELS: Levels = ((0.08, 0.5), (0.04, 0.25), (0.02, 0.1))
"""(voxel, correspondence distance) in m, coarse to fine: the most accurate."""
FAST_LEVELS: Levels = ((0.08, 0.5), (0.06, 0.25), (0.04, 0.1))
"""The same with larger last voxels: a few times faster, a little worse."""
CLOUD_STRIDE = 2
ITERATIONS = 50
MIN_POINTS = 100
KISS_VOXEL_M = 0.05
"""Of the keypoints for KISS-Matcher: at 0.08 and 0.1 m it is right less often on clouds of one room."""
EDGE_RATIO = 0.04
"""Pixels whose neighbour's depth differs by more than this share lie at an edge."""


class Result(NamedTuple):
    """A 4x4 T_target_source, or None and the reason."""

    T: Float64Array | None
    reason: str = ""


Method = Callable[[View, View, Float64Array | None], Result]


def _never_raises(method: Callable[[View, View, Any], Float64Array]) -> Method:
    """Turn whatever a method or its library raises into a Result."""

    @functools.wraps(method)
    def wrapped(source: View, target: View, T_start: Float64Array | None = None) -> Result:
        try:
            T = method(source, target, T_start)
        except (Failure, RuntimeError, ValueError, np.linalg.LinAlgError, cv2.error) as error:
            return Result(None, str(error).strip().splitlines()[-1] if str(error) else type(error).__name__)
        return Result(T) if np.isfinite(T).all() else Result(None, "pose is not finite")

    return wrapped


def cloud(view: View) -> tuple[Float64Array, Float64Array]:
    """Points (Nx3, m, camera frame) and colours (Nx3, 0..1) of every second pixel with depth and at no edge."""
    if view.depth is None:
        raise Failure("no depth")
    z = without_edges(view.depth)[::CLOUD_STRIDE, ::CLOUD_STRIDE].astype(np.float64)
    v, u = np.mgrid[: view.depth.shape[0] : CLOUD_STRIDE, : view.depth.shape[1] : CLOUD_STRIDE].astype(np.float64)
    seen = np.isfinite(z)
    if seen.sum() < MIN_POINTS:
        raise Failure(f"{seen.sum()} pixels with depth, {MIN_POINTS} needed")
    points = (pixel_rays(view.K, u, v) * z[..., None])[seen]
    return points, view.rgb[::CLOUD_STRIDE, ::CLOUD_STRIDE][seen] / 255.0


def without_edges(depth: npt.NDArray[np.float32]) -> npt.NDArray[np.float32]:
    """HxW m with NaN also where a neighbour in the row or column is missing or off by more than `EDGE_RATIO`."""
    edge = np.zeros(depth.shape, bool)
    for view, marked in ((depth, edge), (depth.T, edge.T)):
        off = ~(np.abs(view[1:] - view[:-1]) < EDGE_RATIO * np.minimum(view[1:], view[:-1]))
        marked[1:] |= off
        marked[:-1] |= off
    return np.where(edge, np.float32("nan"), depth)


def _need_start(T_start: Float64Array | None) -> Float64Array:
    if T_start is None:
        raise Failure("no start pose")
    return T_start


def _open3d_levels(
    source: View, target: View, T_start: Float64Array | None, kind: str, levels: Levels = LEVELS
) -> Float64Array:
    import open3d as o3d

    registration = o3d.pipelines.registration
    estimators = {
        "gicp": (registration.registration_generalized_icp, registration.TransformationEstimationForGeneralizedICP),
        "colored": (registration.registration_colored_icp, registration.TransformationEstimationForColoredICP),
        "plane": (registration.registration_icp, registration.TransformationEstimationPointToPlane),
    }
    register, estimation = estimators[kind]
    criteria = registration.ICPConvergenceCriteria(max_iteration=ITERATIONS)
    T = _need_start(T_start)
    full = [_open3d_cloud(o3d, view) for view in (source, target)]
    for voxel, distance in levels:
        level = [_open3d_prepared(o3d, part, voxel) for part in full]
        result = register(*level, distance, T, estimation(), criteria)
        if result.fitness == 0:
            raise Failure(f"no correspondences within {distance} m")
        T = np.asarray(result.transformation)
    return T


def _open3d_cloud(o3d: Any, view: View) -> Any:
    points, colours = cloud(view)
    made = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(points))
    made.colors = o3d.utility.Vector3dVector(colours)
    return made


def _open3d_prepared(o3d: Any, full: Any, voxel: float) -> Any:
    part = full.voxel_down_sample(voxel)
    part.estimate_normals(o3d.geometry.KDTreeSearchParamHybrid(radius=3 * voxel, max_nn=30))
    return part


@_never_raises
def open3d_gicp(source: View, target: View, T_start: Float64Array | None) -> Float64Array:
    """Generalized ICP of Open3D."""
    return _open3d_levels(source, target, T_start, "gicp")


@_never_raises
def open3d_colored(source: View, target: View, T_start: Float64Array | None) -> Float64Array:
    """Colored ICP of Open3D."""
    return _open3d_levels(source, target, T_start, "colored")


@_never_raises
def open3d_colored_fast(source: View, target: View, T_start: Float64Array | None) -> Float64Array:
    """Colored ICP of Open3D with `FAST_LEVELS`."""
    return _open3d_levels(source, target, T_start, "colored", FAST_LEVELS)


@_never_raises
def open3d_plane(source: View, target: View, T_start: Float64Array | None) -> Float64Array:
    """Point-to-plane ICP of Open3D."""
    return _open3d_levels(source, target, T_start, "plane")


def _small_gicp(source: View, target: View, T_start: Float64Array) -> Float64Array:
    """GICP of small_gicp: first and last level, two threads."""
    import small_gicp as library

    T = T_start
    points = [cloud(view)[0] for view in (source, target)]
    for voxel, distance in (LEVELS[0], LEVELS[-1]):
        prepared = [library.preprocess_points(part, voxel, num_threads=2) for part in points]
        (source_cloud, _), (target_cloud, tree) = prepared
        result = library.align(
            target_cloud,
            source_cloud,
            tree,
            T,
            registration_type="GICP",
            max_correspondence_distance=distance,
            num_threads=2,
            max_iterations=ITERATIONS,
        )
        if result.num_inliers == 0:
            raise Failure(f"no correspondences within {distance} m")
        T = np.asarray(result.T_target_source)
    return T


@_never_raises
def small_gicp(source: View, target: View, T_start: Float64Array | None) -> Float64Array:
    """GICP of small_gicp."""
    return _small_gicp(source, target, _need_start(T_start))


@_never_raises
def rgbd_hybrid(source: View, target: View, T_start: Float64Array | None) -> Float64Array:
    """RGB-D odometry of Open3D, colour and depth (`bench.odometry`)."""
    return rgbd_odometry(source, target, _need_start(T_start), "hybrid")


@_never_raises
def rgbd_intensity(source: View, target: View, T_start: Float64Array | None) -> Float64Array:
    """RGB-D odometry of Open3D, colour alone (`bench.odometry`)."""
    return rgbd_odometry(source, target, _need_start(T_start), "intensity")


@_never_raises
def sift_pnp(source: View, target: View, T_start: Float64Array | None) -> Float64Array:
    """RootSIFT and PnP both ways (`bench.pnp`). Ignores the start."""
    return features_pnp(source, target)


@_never_raises
def sift_pnp_small_gicp(source: View, target: View, T_start: Float64Array | None) -> Float64Array:
    """The pose of `sift_pnp`, refined by GICP of small_gicp. Ignores the start."""
    return _small_gicp(source, target, features_pnp(source, target))


@_never_raises
def kiss_matcher_gicp(source: View, target: View, T_start: Float64Array | None) -> Float64Array:
    """KISS-Matcher (global registration of clouds), refined by Generalized ICP of Open3D. Ignores the start."""
    import kiss_matcher

    matcher = kiss_matcher.KISSMatcher(kiss_matcher.KISSMatcherConfig(voxel_size=KISS_VOXEL_M))
    found = matcher.estimate(*(cloud(view)[0].astype(np.float32) for view in (source, target)))
    if not found.valid:
        raise Failure("KISS-Matcher found no valid pose")
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = np.asarray(found.rotation), np.ravel(found.translation)
    return _open3d_levels(source, target, T, "gicp")


METHODS: dict[str, Method] = {
    "open3d-gicp": open3d_gicp,
    "open3d-colored": open3d_colored,
    "open3d-colored-fast": open3d_colored_fast,
    "open3d-plane": open3d_plane,
    "small-gicp": small_gicp,
    "rgbd-hybrid": rgbd_hybrid,
    "rgbd-intensity": rgbd_intensity,
    "sift-pnp": sift_pnp,
    "sift-pnp+small-gicp": sift_pnp_small_gicp,
    "kiss-matcher+gicp": kiss_matcher_gicp,
}
NEED_NO_START = ("sift-pnp", "sift-pnp+small-gicp", "kiss-matcher+gicp")
