# SPDX-License-Identifier: Apache-2.0
"""Point maps as a two-view network would give them, made from a generated room, exact or with errors."""

from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
import torch

from bench.rooms import RoomPair
from garps_core import View
from garps_core.depth_errors import depth_modes
from garps_core.geometry import pixel_rays, se3_inverse, transform
from garps_core.point_maps import Framing, PairMaps, PointMap

LONG_SIDE = 256
PATCH = 16


@dataclass(frozen=True)
class Errors:
    """Sigmas of what is wrong with maps.

    Args:
        noise: of each point along its ray and across, relative to its range.
        patches: the same, but shared by every patch of 16x16 pixels and smooth between them.
        scale: relative, one for both orders, as a network's idea of a metre is.
        warp: of each of the five smooth modes, of each map of each order.
    """

    noise: float = 0.0
    patches: float = 0.0
    scale: float = 0.0
    warp: float = 0.0


def framing_of(height: int, width: int, long_side: int = LONG_SIDE) -> Framing:
    """Framing by a network of patches: long side scaled to `long_side` px, then cropped to multiples of 16."""
    factor = long_side / max(height, width)
    rows, columns = round(height * factor), round(width * factor)
    h, w = rows // PATCH * PATCH, columns // PATCH * PATCH
    return Framing((columns / width, rows / height), ((columns - w) // 2, (rows - h) // 2), (h, w))


def depth_seen(depth: Any, framing: Framing) -> Any:
    """HxW depth at the pixels of the framing, by the nearest one, hxw."""
    v, u = np.mgrid[: framing.size[0], : framing.size[1]]
    px = np.rint(framing.to_image(np.stack([u.ravel(), v.ravel()], 1).astype(float))).astype(int)
    return depth[px[:, 1].clip(0, depth.shape[0] - 1), px[:, 0].clip(0, depth.shape[1] - 1)].reshape(framing.size)


def exact_points(depth: Any, K: Any, framing: Framing) -> Any:
    """hxwx3 points in the view's own camera: those that the nearest image pixels see, on the rays of the map's own."""
    v, u = np.mgrid[: framing.size[0], : framing.size[1]].astype(float)
    return pixel_rays(framing.intrinsics(K), u, v) * depth_seen(depth, framing)[..., None]


def erring(points: Any, errors: Errors, scale: float, rng: np.random.Generator) -> Any:
    """Points hxwx3 in the first camera with errors, the shared ones along that camera's rays."""
    h, w = points.shape[:2]
    reach = np.linalg.norm(points, axis=-1, keepdims=True)
    coarse = rng.normal(size=(h // PATCH + 1, w // PATCH + 1, 3)).astype(np.float32)
    smooth = cv2.resize(coarse, (w, h), interpolation=cv2.INTER_LINEAR)
    modes = np.concatenate([[scale], rng.normal(size=5) * errors.warp])
    by_modes = depth_modes(torch.from_numpy(points.reshape(-1, 3))).numpy() @ modes
    shared = points * by_modes.reshape(h, w, 1)
    return points + shared + reach * (errors.noise * rng.normal(size=points.shape) + errors.patches * smooth)


def point_maps(
    views: tuple[View, View],
    T: Any,
    errors: Errors | None = None,
    seed: int = 0,
    confidence: float = 10.0,
    long_side: int = LONG_SIDE,
) -> PairMaps:
    """Both orders of two views with true depth; T = T_target_source."""
    errors, rng = errors or Errors(), np.random.default_rng(seed)
    framings = tuple(framing_of(*view.rgb.shape[:2], long_side) for view in views)
    own = [exact_points(view.depth, view.K, framing) for view, framing in zip(views, framings, strict=True)]
    scale = rng.normal() * errors.scale
    orders = []
    for first, T_first_second in ((0, se3_inverse(T)), (1, T)):
        pair = (own[first], transform(T_first_second, own[1 - first]))
        orders.append(tuple(_map(erring(points, errors, scale, rng), confidence) for points in pair))
    return PairMaps(orders[0], orders[1], framings, True, "made")


def _map(points: Any, confidence: float) -> PointMap:
    return PointMap(points.astype(np.float32), np.full(points.shape[:2], confidence, np.float32))


def true_views(pair: RoomPair) -> tuple[View, View]:
    """Source and target with true depth."""
    return View(pair.rgb0, pair.K0, pair.true_depth0), View(pair.rgb1, pair.K1, pair.true_depth1)
