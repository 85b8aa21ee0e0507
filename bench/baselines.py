# SPDX-License-Identifier: Apache-2.0
"""Other people's ways to the same pose, each behind one signature.

`method(source, target, T_start) -> Result`: two RGB-D views and a 4x4 start pose (or None) to a 4x4 pose or the reason
why there is none. A method never raises on data. Every call starts from the images, so its wall time is honest.
Registration: three levels, voxels 8/6/4 cm, correspondence distance 0.5/0.25/0.1 m, on every second pixel.
"""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import Any, NamedTuple

import cv2
import numpy as np
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from garps_core.geometry import pixel_rays, project, se3_inverse, transform
from garps_core.types import Float64Array, View

LEVELS = ((0.08, 0.5), (0.06, 0.25), (0.04, 0.1))
"""(voxel, correspondence distance) in m, coarse to fine."""
CLOUD_STRIDE = 2
ITERATIONS = 30
MIN_POINTS = 100
FEATURES = 4000
MATCH_RATIO = 0.8
RANSAC_PX = 3.0
MIN_INLIERS = 12
MAX_RELIEF = 0.03
"""Share of depth by which a keypoint's 5x5 surroundings may vary: on silhouettes the reading is foreground or
background by chance."""


class Result(NamedTuple):
    """A 4x4 T_target_source, or None and the reason."""

    T: Float64Array | None
    reason: str = ""


Method = Callable[[View, View, Float64Array | None], Result]


class Failure(Exception):
    """A method found no pose; the text says why."""


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
    """Points (Nx3, m, camera frame) and colours (Nx3, 0..1) of every second pixel that has depth."""
    if view.depth is None:
        raise Failure("no depth")
    z = view.depth[::CLOUD_STRIDE, ::CLOUD_STRIDE].astype(np.float64)
    v, u = np.mgrid[: view.depth.shape[0] : CLOUD_STRIDE, : view.depth.shape[1] : CLOUD_STRIDE].astype(np.float64)
    seen = np.isfinite(z)
    if seen.sum() < MIN_POINTS:
        raise Failure(f"{seen.sum()} pixels with depth, {MIN_POINTS} needed")
    points = (pixel_rays(view.K, u, v) * z[..., None])[seen]
    return points, view.rgb[::CLOUD_STRIDE, ::CLOUD_STRIDE][seen] / 255.0


def _need_start(T_start: Float64Array | None) -> Float64Array:
    if T_start is None:
        raise Failure("no start pose")
    return T_start


def _open3d_levels(source: View, target: View, T_start: Float64Array | None, kind: str) -> Float64Array:
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
    for voxel, distance in LEVELS:
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
def open3d_plane(source: View, target: View, T_start: Float64Array | None) -> Float64Array:
    """Point-to-plane ICP of Open3D."""
    return _open3d_levels(source, target, T_start, "plane")


@_never_raises
def small_gicp(source: View, target: View, T_start: Float64Array | None) -> Float64Array:
    """GICP of small_gicp: first and last level, two threads."""
    import small_gicp as library

    T = _need_start(T_start)
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
def features_pnp(source: View, target: View, T_start: Float64Array | None) -> Float64Array:
    """RootSIFT, then PoseLib's absolute pose each way (depth of one, pixels of the other), then both refined together.

    Ignores the start.
    """
    pixels_source, pixels_target = _matches(source.rgb, target.rgb)
    forward = _Projections(*_with_depth(source, pixels_source, pixels_target), target.K, inverse=False)
    backward = _Projections(*_with_depth(target, pixels_target, pixels_source), source.K, inverse=True)
    found = [pose for way in (forward, backward) if (pose := way.ransac()) is not None]
    if not found:
        raise Failure(f"no pose with {MIN_INLIERS} inliers ({len(pixels_source)} matches)")
    best = max(found, key=lambda T: forward.inliers(T).sum() + backward.inliers(T).sum())
    return _refined(best, [way.subset(way.inliers(best)) for way in (forward, backward)])


def _matches(rgb_source: Any, rgb_target: Any) -> tuple[Float64Array, Float64Array]:
    """Mutual RootSIFT matches that pass the ratio test: pixels Nx2 in each image."""
    found = [_root_sift(rgb) for rgb in (rgb_source, rgb_target)]
    if min(len(pixels) for pixels, _ in found) < 2:
        raise Failure("fewer than 2 features")
    (pixels_source, source), (pixels_target, target) = found
    similarity = source @ target.T  # of unit vectors: squared distance is 2 - 2 similarity
    rows = np.arange(len(source))
    best = similarity.argmax(1)
    first = similarity[rows, best]
    mutual = similarity.argmax(0)[best] == rows
    similarity[rows, best] = -1
    kept = mutual & (1 - first < MATCH_RATIO**2 * (1 - similarity.max(1)))
    return pixels_source[kept], pixels_target[best[kept]]


def _root_sift(rgb: Any) -> tuple[Float64Array, Any]:
    sift = cv2.SIFT_create(nfeatures=FEATURES, enable_precise_upscale=True)
    keypoints, descriptors = sift.detectAndCompute(cv2.cvtColor(rgb, cv2.COLOR_RGB2GRAY), None)
    if not keypoints:
        return np.zeros((0, 2)), np.zeros((0, 128), np.float32)
    root = np.sqrt(descriptors / np.maximum(descriptors.sum(1, keepdims=True), 1e-9))
    return np.array([k.pt for k in keypoints]), root


def _with_depth(view: View, own: Float64Array, other: Float64Array) -> tuple[Float64Array, Float64Array]:
    """Points (Mx3, m, frame of `view`) of its keypoints that have trusted depth, and the other image's pixels (Mx2)."""
    if view.depth is None:
        return np.zeros((0, 3)), np.zeros((0, 2))
    height, width = view.depth.shape
    u, v = np.rint(own).astype(int).T
    offsets = np.arange(-2, 3)
    patch_v = np.clip(v[:, None, None] + offsets[:, None], 0, height - 1)
    patch_u = np.clip(u[:, None, None] + offsets, 0, width - 1)
    patches = view.depth[patch_v, patch_u].astype(np.float64).reshape(len(own), -1)
    z = patches[:, 12]
    with np.errstate(invalid="ignore"):
        high = np.where(np.isfinite(patches), patches, -np.inf).max(1, initial=-np.inf)
        low = np.where(np.isfinite(patches), patches, np.inf).min(1, initial=np.inf)
        good = np.isfinite(z) & (high - low < MAX_RELIEF * z)
    return (pixel_rays(view.K, own[:, 0], own[:, 1]) * z[:, None])[good], other[good]


class _Projections:
    """3D points of one view and where the other view saw them; `inverse` when the points are the target's."""

    def __init__(self, points: Float64Array, pixels: Float64Array, K: Float64Array, inverse: bool) -> None:
        self.points, self.pixels, self.K, self.inverse = points, pixels, K, inverse

    def subset(self, keep: Any) -> _Projections:
        return _Projections(self.points[keep], self.pixels[keep], self.K, self.inverse)

    def residuals(self, T: Float64Array) -> Float64Array:
        """Reprojection residuals Nx2, px, under T_target_source; infinite behind the camera."""
        seen = transform(se3_inverse(T) if self.inverse else T, self.points)
        with np.errstate(divide="ignore", invalid="ignore"):
            return np.where(seen[:, 2:] > 1e-3, project(self.K, seen) - self.pixels, np.inf)

    def inliers(self, T: Float64Array) -> Any:
        return np.linalg.norm(self.residuals(T), axis=1) < RANSAC_PX

    def ransac(self) -> Float64Array | None:
        """T_target_source by PoseLib, or None with too few inliers."""
        import poselib

        if len(self.points) < MIN_INLIERS:
            return None
        K = self.K
        params = [K[0, 0], K[1, 1], K[0, 2], K[1, 2]]
        camera = {"model": "PINHOLE", "width": 0, "height": 0, "params": params}
        options = {"max_reproj_error": RANSAC_PX, "max_error": RANSAC_PX}
        pose, info = poselib.estimate_absolute_pose(self.pixels, self.points, camera, options, {})
        if info["num_inliers"] < MIN_INLIERS:
            return None
        T = np.eye(4)
        T[:3] = pose.Rt
        return se3_inverse(T) if self.inverse else T


def _refined(T: Float64Array, ways: list[_Projections]) -> Float64Array:
    """The pose of least robust reprojection error over both ways."""

    def moved(x: Float64Array) -> Float64Array:
        changed = T.copy()
        changed[:3, :3] = Rotation.from_rotvec(x[3:]).as_matrix() @ T[:3, :3]
        changed[:3, 3] += x[:3]
        return changed

    def residuals(x: Float64Array) -> Float64Array:
        stacked = np.concatenate([way.residuals(moved(x)).ravel() for way in ways])
        return np.clip(np.nan_to_num(stacked, posinf=1e3), -1e3, 1e3)

    return moved(least_squares(residuals, np.zeros(6), loss="cauchy", max_nfev=20).x)


METHODS: dict[str, Method] = {
    "open3d-gicp": open3d_gicp,
    "open3d-colored": open3d_colored,
    "open3d-plane": open3d_plane,
    "small-gicp": small_gicp,
    "sift-pnp": features_pnp,
}
NEED_NO_START = ("sift-pnp",)
