# SPDX-License-Identifier: Apache-2.0
"""Relative pose from features and depth, written apart from `garps_core`: a competitor in its own right."""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from garps_core.checks import Float64Array
from garps_core.geometry import pixel_rays, project, se3_inverse, transform
from garps_core.types import View

FEATURES = 4000
MATCH_RATIO = 0.8
RANSAC_PX = 3.0
MIN_INLIERS = 8
MAX_RELIEF = 0.03
"""Share of depth by which a keypoint's 5x5 surroundings may vary: on silhouettes the reading is foreground or
background by chance."""


class Failure(Exception):
    """A method found no pose; the text says why."""


def features_pnp(source: View, target: View) -> Float64Array:
    """RootSIFT, PoseLib's absolute pose each way (depth of one, pixels of the other), then both refined together.

    Raises:
        Failure: too few matches or inliers.
    """
    pixels_source, pixels_target = matches(source.rgb, target.rgb)
    forward = _Projections(*_with_depth(source, pixels_source, pixels_target), target.K, inverse=False)
    backward = _Projections(*_with_depth(target, pixels_target, pixels_source), source.K, inverse=True)
    found = [pose for way in (forward, backward) if (pose := way.ransac()) is not None]
    if not found:
        raise Failure(f"no pose with {MIN_INLIERS} inliers ({len(pixels_source)} matches)")
    best = max(found, key=lambda T: forward.inliers(T).sum() + backward.inliers(T).sum())
    return _refined(best, [way.subset(way.inliers(best)) for way in (forward, backward)])


def features_pnp_oneway(source: View, target: View) -> Float64Array:
    """RootSIFT and PoseLib's absolute pose: depth of the source, pixels of the target.

    Raises:
        Failure: too few matches or inliers.
    """
    pixels_source, pixels_target = matches(source.rgb, target.rgb)
    points = _with_depth(source, pixels_source, pixels_target)
    pose = _Projections(*points, target.K, inverse=False).ransac()
    if pose is None:
        raise Failure(f"no pose with {MIN_INLIERS} inliers ({len(pixels_source)} matches)")
    return pose


def matches(rgb_source: Any, rgb_target: Any) -> tuple[Float64Array, Float64Array]:
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
    z = trusted_depth(view, own)
    good = np.isfinite(z)
    return (pixel_rays(view.K, own[:, 0], own[:, 1]) * z[:, None])[good], other[good]


def trusted_depth(view: View, pixels: Float64Array) -> Float64Array:
    """Depth (N, m) at pixels Nx2, NaN where there is none or its surroundings vary by more than `MAX_RELIEF`."""
    if view.depth is None:
        return np.full(len(pixels), np.nan)
    height, width = view.depth.shape
    u, v = np.rint(pixels).astype(int).T
    offsets = np.arange(-2, 3)
    patch_v = np.clip(v[:, None, None] + offsets[:, None], 0, height - 1)
    patch_u = np.clip(u[:, None, None] + offsets, 0, width - 1)
    patches = view.depth[patch_v, patch_u].astype(np.float64).reshape(len(pixels), 25)
    z = patches[:, 12]
    with np.errstate(invalid="ignore"):
        high = np.where(np.isfinite(patches), patches, -np.inf).max(1, initial=-np.inf)
        low = np.where(np.isfinite(patches), patches, np.inf).min(1, initial=np.inf)
        return np.where(np.isfinite(z) & (high - low < MAX_RELIEF * z), z, np.nan)


def camera(K: Float64Array) -> dict[str, Any]:
    """A pinhole camera as PoseLib takes it."""
    return {"model": "PINHOLE", "width": 0, "height": 0, "params": [K[0, 0], K[1, 1], K[0, 2], K[1, 2]]}


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
        options = {"max_reproj_error": RANSAC_PX, "max_error": RANSAC_PX}
        pose, info = poselib.estimate_absolute_pose(self.pixels, self.points, camera(self.K), options, {})
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
