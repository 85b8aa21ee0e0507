# SPDX-License-Identifier: Apache-2.0
"""Sparse matches between two views, with depth where it can be trusted: the raw material of the metric PnP."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import cv2
import numpy as np
import numpy.typing as npt

from garps_core.config.start import Start
from garps_core.edges import MATCH_EDGE_RATIO, MATCH_SLACK_M, one_surface
from garps_core.geometry import Array, pixel_rays
from garps_core.types import View


@dataclass(frozen=True)
class Matches:
    """Pairs of matched pixels, and the 3D point of each pixel in its own camera; NaN where its depth is not trusted.

    source_px, target_px: (n, 2) pixels; source_points, target_points: (n, 3) m.
    """

    source_px: Array
    target_px: Array
    source_points: Array
    target_points: Array

    def __len__(self) -> int:
        return len(self.source_px)

    def places(self, kept: npt.NDArray[np.intp]) -> int:
        """Return how many different places the matches of these indices show, the smaller number of both views.

        A place that is matched in several orientations is one piece of evidence, not several.
        """
        return min(len(np.unique(px[kept], axis=0)) for px in (self.source_px, self.target_px))


def match_features(source: View, target: View, start: Start) -> Matches:
    """Match RootSIFT features: mutual nearest neighbours that pass the ratio test (Lowe 2004; Arandjelovic 2012).

    SIFT describes one place once per orientation, so a place may be in several matches (`Matches.places`).
    """
    count = start.max_features
    with ThreadPoolExecutor(2) as pool:
        (px_s, descriptors_s), (px_t, descriptors_t) = pool.map(_describe, (source.rgb, target.rgb), (count, count))
    i, j = _mutual(descriptors_s, descriptors_t, start.match_ratio)
    return Matches(px_s[i], px_t[j], points_at(source, px_s[i]), points_at(target, px_t[j]))


def _describe(rgb: npt.NDArray[np.uint8], count: int) -> tuple[Array, npt.NDArray[np.float32]]:
    grey = cv2.cvtColor(rgb, cv2.COLOR_RGB2GRAY)
    keypoints, descriptors = cv2.SIFT.create(nfeatures=count).detectAndCompute(grey, None)
    if descriptors is None:
        return np.zeros((0, 2)), np.zeros((0, 128), np.float32)
    descriptors = np.sqrt(descriptors / np.maximum(descriptors.sum(1, keepdims=True), 1e-7))
    return np.array([k.pt for k in keypoints], float).reshape(-1, 2), descriptors.astype(np.float32)


def _mutual(
    a: npt.NDArray[np.float32], b: npt.NDArray[np.float32], ratio: float
) -> tuple[npt.NDArray[np.intp], npt.NDArray[np.intp]]:
    if len(a) < 2 or len(b) < 2:
        return np.zeros(0, np.intp), np.zeros(0, np.intp)
    similarity = a @ b.T  # unit vectors: squared distance = 2 - 2 similarity
    rows, forward, best_of_target = np.arange(len(a)), similarity.argmax(1), similarity.max(0)
    best = similarity[rows, forward]
    similarity[rows, forward] = -np.inf
    second = similarity.max(1)  # twice the largest is much faster than a partition
    distinct = (1 - best) < ratio**2 * (1 - second)
    keep = rows[(best >= best_of_target[forward]) & distinct]
    pairs = np.unique(np.stack([keep, forward[keep]], axis=1), axis=0)
    return pairs[:, 0], pairs[:, 1]


def points_at(view: View, px: Array) -> Array:
    """3D points (n, 3) m of a view's pixels (n, 2); NaN without trustworthy depth."""
    if view.depth is None or len(px) == 0:
        return np.full((len(px), 3), np.nan)
    height, width = view.depth.shape
    u, v = (np.rint(px[:, axis]).astype(int) for axis in (0, 1))
    offsets = np.arange(-2, 3)
    rows = np.clip(v[:, None, None] + offsets[:, None], 0, height - 1)
    columns = np.clip(u[:, None, None] + offsets[None, :], 0, width - 1)
    patch = view.depth[rows, columns].reshape(len(px), -1).astype(float)
    seen = np.isfinite(patch)
    nearest = np.where(seen, patch, np.inf).min(1)
    farthest = np.where(seen, patch, -np.inf).max(1)
    z = patch[:, patch.shape[1] // 2]
    flat = one_surface(nearest, farthest, MATCH_EDGE_RATIO, MATCH_SLACK_M)
    mean = np.where(seen, patch, 0).sum(1) / np.maximum(seen.sum(1), 1)
    z = np.where(flat & np.isfinite(z), mean, np.nan)  # the patch mean carries less noise than its centre
    return np.asarray(pixel_rays(view.K, px[:, 0], px[:, 1]) * z[:, None])
