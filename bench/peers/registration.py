# SPDX-License-Identifier: Apache-2.0
"""Registration of two clouds by Open3D, small_gicp and KISS-Matcher: `method(source, target, T_start)` to a 4x4 pose.

All work on every second pixel, without those at depth edges, which are artefacts of the sensor. All run on one thread:
several sum in another order every time.
"""

from __future__ import annotations

import contextlib
import os
from collections.abc import Iterator
from typing import Any

import numpy as np
import numpy.typing as npt

from bench.peers.features_pnp import Failure, features_pnp
from garps_core.checks import Float64Array
from garps_core.geometry import pixel_rays
from garps_core.types import View

Levels = tuple[tuple[float, float], ...]
LEVELS: Levels = ((0.08, 0.5), (0.04, 0.25), (0.02, 0.1))
"""(voxel, correspondence distance) in m, coarse to fine: the most accurate."""
FAST_LEVELS: Levels = ((0.08, 0.5), (0.06, 0.25), (0.04, 0.1))
"""Levels with larger last voxels: a few times faster, a little worse."""
CLOUD_STRIDE = 2
ITERATIONS = 50
MIN_POINTS = 100
KISS_VOXEL_M = 0.05
"""Voxel of the keypoints for KISS-Matcher: at 0.08 and 0.1 m it is right less often on clouds of one room."""
EDGE_RATIO = 0.04
"""Pixels whose neighbour's depth differs by more than this share lie at an edge."""
THREADS = 1
"""Threads of Open3D and small_gicp: with two, poses differ in their last bits from call to call."""


def open3d() -> Any:
    """The library, on `THREADS` threads."""
    import open3d as o3d

    o3d.utility.set_max_threads(THREADS)
    return o3d


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


def _open3d_levels(
    source: View, target: View, T_start: Float64Array, kind: str, levels: Levels = LEVELS
) -> Float64Array:
    o3d = open3d()
    registration = o3d.pipelines.registration
    estimators = {
        "gicp": (registration.registration_generalized_icp, registration.TransformationEstimationForGeneralizedICP),
        "colored": (registration.registration_colored_icp, registration.TransformationEstimationForColoredICP),
        "plane": (registration.registration_icp, registration.TransformationEstimationPointToPlane),
        "point": (registration.registration_icp, registration.TransformationEstimationPointToPoint),
    }
    register, estimation = estimators[kind]
    criteria = registration.ICPConvergenceCriteria(max_iteration=ITERATIONS)
    T = T_start
    full = [_open3d_cloud(o3d, view) for view in (source, target)]
    for voxel, distance in levels:
        level = [part.voxel_down_sample(voxel) for part in full]
        if kind != "point":
            for part in level:
                part.estimate_normals(o3d.geometry.KDTreeSearchParamHybrid(radius=3 * voxel, max_nn=30))
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


def icp(source: View, target: View, T_start: Float64Array) -> Float64Array:
    """Point-to-point ICP of Open3D."""
    return _open3d_levels(source, target, T_start, "point")


def open3d_gicp(source: View, target: View, T_start: Float64Array) -> Float64Array:
    """Generalized ICP of Open3D."""
    return _open3d_levels(source, target, T_start, "gicp")


def open3d_colored(source: View, target: View, T_start: Float64Array) -> Float64Array:
    """Colored ICP of Open3D."""
    return _open3d_levels(source, target, T_start, "colored")


def open3d_colored_fast(source: View, target: View, T_start: Float64Array) -> Float64Array:
    """Colored ICP of Open3D with `FAST_LEVELS`."""
    return _open3d_levels(source, target, T_start, "colored", FAST_LEVELS)


def open3d_plane(source: View, target: View, T_start: Float64Array) -> Float64Array:
    """Point-to-plane ICP of Open3D."""
    return _open3d_levels(source, target, T_start, "plane")


def small_gicp(source: View, target: View, T_start: Float64Array) -> Float64Array:
    """GICP of small_gicp, first and last level."""
    import small_gicp as library

    T = T_start
    points = [cloud(view)[0] for view in (source, target)]
    for voxel, distance in (LEVELS[0], LEVELS[-1]):
        prepared = [library.preprocess_points(part, voxel, num_threads=THREADS) for part in points]
        (source_cloud, _), (target_cloud, tree) = prepared
        result = library.align(
            target_cloud,
            source_cloud,
            tree,
            T,
            registration_type="GICP",
            max_correspondence_distance=distance,
            num_threads=THREADS,
            max_iterations=ITERATIONS,
        )
        if result.num_inliers == 0:
            raise Failure(f"no correspondences within {distance} m")
        T = np.asarray(result.T_target_source)
    return T


def sift_pnp_small_gicp(source: View, target: View) -> Float64Array:
    """The pose of `sift-pnp`, refined by GICP of small_gicp."""
    return small_gicp(source, target, features_pnp(source, target))


def kiss_matcher_gicp(source: View, target: View) -> Float64Array:
    """KISS-Matcher (global registration of clouds), refined by Generalized ICP of Open3D."""
    clouds = [cloud(view)[0].astype(np.float32) for view in (source, target)]
    with one_core():
        import kiss_matcher

        matcher = kiss_matcher.KISSMatcher(kiss_matcher.KISSMatcherConfig(voxel_size=KISS_VOXEL_M))
        found = matcher.estimate(*clouds)
    if not found.valid:
        raise Failure("KISS-Matcher found no valid pose")
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = np.asarray(found.rotation), np.ravel(found.translation)
    return open3d_gicp(source, target, T)


@contextlib.contextmanager
def one_core() -> Iterator[None]:
    """This thread sees one core alone, for libraries that start a thread per core and cannot be told otherwise.

    They count the cores once, when they are first used; where the system has no such thing, nothing happens.
    """
    if not hasattr(os, "sched_setaffinity"):
        yield
        return
    cores = os.sched_getaffinity(0)
    os.sched_setaffinity(0, {min(cores)})
    try:
        yield
    finally:
        os.sched_setaffinity(0, cores)
