# SPDX-License-Identifier: Apache-2.0
"""Two cameras in a room, at graded distances from each other."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import Rotation

from bench.rooms.depth import monocular_depth, sensor_depth
from bench.rooms.layout import make_room
from bench.rooms.mesh import LABELS, Array
from bench.rooms.render import Room
from bench.rooms.scene import Float32Array
from bench.rooms.shading import camera_rays
from garps_core.geometry import se3_inverse

#: level: (rotation deg, translation m, lowest and highest wanted overlap)
LEVELS: dict[int, tuple[float, float, float, float]] = {
    1: (5.0, 0.10, 0.80, 0.96),
    2: (10.0, 0.25, 0.65, 0.88),
    3: (15.0, 0.40, 0.52, 0.78),
    4: (20.0, 0.60, 0.42, 0.66),
    5: (35.0, 1.00, 0.28, 0.50),
}
CLEARANCE_M = 0.35
DEPTH_NOISES = ("none", "sensor", "monocular")
_FURNITURE = tuple(k for k, name in enumerate(LABELS) if name not in ("void", "wall", "floor", "ceiling", "trim"))


@dataclass(frozen=True, eq=False)
class RoomPair:
    """Two views of a room and the truth between them.

    Args:
        rgb0, rgb1: HxWx3 uint8.
        depth0, depth1: HxW float32 m with the requested noise, NaN = no reading.
        true_depth0, true_depth1: HxW float32 m, exact.
        labels0, labels1: HxW int32, index into `LABELS`.
        K0, K1: 3x3 pixels. They differ by a few percent.
        T_1_0: 4x4, points of camera 0 into camera 1, m.
        T_world_0: 4x4, points of camera 0 into the room, m.
        level: 1..5.
        overlap: share of pixels, 0..1, whose surface the other camera sees too; the smaller of both directions.
    """

    rgb0: npt.NDArray[np.uint8]
    rgb1: npt.NDArray[np.uint8]
    depth0: Float32Array
    depth1: Float32Array
    true_depth0: Float32Array
    true_depth1: Float32Array
    labels0: npt.NDArray[np.int32]
    labels1: npt.NDArray[np.int32]
    K0: Array
    K1: Array
    T_1_0: Array
    T_world_0: Array
    level: int
    overlap: float


_cached_room = lru_cache(maxsize=4)(make_room)


def make_pair(
    seed: int, level: int, texture: float = 1.0, width: int = 640, height: int = 480, depth_noise: str = "none"
) -> RoomPair:
    """Two views of room `seed`, apart by what `level` says; see `LEVELS`.

    Args:
        seed: decides the room and, with the level, the cameras.
        level: 1 (5 deg, 0.10 m) to 5 (35 deg, 1.0 m).
        texture: 1 = rich, 0 = almost plain; cameras and depth do not depend on it.
        width: pixels.
        height: pixels.
        depth_noise: "none", "sensor" or "monocular", for depth0 and depth1.
    Raises:
        ValueError: unknown level or depth noise.
    """
    if level not in LEVELS:
        raise ValueError(f"level is {level!r}: expected one of {sorted(LEVELS)}")
    if depth_noise not in DEPTH_NOISES:
        raise ValueError(f"depth_noise is {depth_noise!r}: expected one of {DEPTH_NOISES}")
    room = _cached_room(seed, float(texture))
    rng = np.random.default_rng([seed, level, 201])
    shapes = [_unit_intrinsics(rng) for _ in range(2)]
    poses = _place_cameras(room, rng, level, shapes)
    Ks = [S @ K for K, S in zip(shapes, [_to_pixels(width, height)] * 2, strict=True)]
    views = []
    for k in range(2):
        noise = np.random.default_rng([seed, level, 202, k])
        exposure = float(noise.uniform(0.85, 1.2))
        views.append(room.render(poses[k], Ks[k], width, height, exposure, rng=noise))
    T_1_0 = se3_inverse(poses[1]) @ poses[0]
    true = [view.depth_m for view in views]
    return RoomPair(
        views[0].rgb, views[1].rgb,
        corrupt(true[0], depth_noise, np.random.default_rng([seed, level, 203, 0])),
        corrupt(true[1], depth_noise, np.random.default_rng([seed, level, 203, 1])),
        true[0], true[1], views[0].labels, views[1].labels, Ks[0], Ks[1], T_1_0, poses[0], level,
        mutual_overlap(true[0], true[1], Ks[0], Ks[1], T_1_0),
    )  # fmt: skip


def corrupt(depth: Float32Array, kind: str, rng: np.random.Generator) -> Float32Array:
    """Depth with one of `DEPTH_NOISES`, HxW m."""
    if kind == "none":
        return depth.copy()
    return sensor_depth(depth, rng) if kind == "sensor" else monocular_depth(depth, rng)


def mutual_overlap(
    depth0: npt.NDArray[Any], depth1: npt.NDArray[Any], K0: Array, K1: Array, T_1_0: Array, stride: int = 4
) -> float:
    """Share of pixels whose surface the other camera sees, the smaller of both directions; HxW m depths."""
    forward = visible_share(depth0, depth1, K0, K1, T_1_0, stride)
    return min(forward, visible_share(depth1, depth0, K1, K0, se3_inverse(T_1_0), stride))


def visible_share(
    depth0: npt.NDArray[Any], depth1: npt.NDArray[Any], K0: Array, K1: Array, T_1_0: Array, stride: int = 1
) -> float:
    """Share of view 0's readings that project into view 1 and are not hidden there (3 cm + 3 %)."""
    rays = camera_rays(K0, depth0.shape[1], depth0.shape[0])[::stride, ::stride]
    z = depth0[::stride, ::stride, None].astype(float)
    points = (rays * z)[np.isfinite(z[..., 0])] @ T_1_0[:3, :3].T + T_1_0[:3, 3]
    ahead = points[points[:, 2] > 0.05]
    if not len(points):
        return 0.0
    pixel = np.round((ahead @ K1.T)[:, :2] / ahead[:, 2:]).astype(int)
    inside = ((pixel >= 0) & (pixel < depth1.shape[::-1])).all(axis=1)
    seen = depth1[pixel[inside, 1], pixel[inside, 0]]
    with np.errstate(invalid="ignore"):
        near = np.abs(seen - ahead[inside, 2]) < 0.03 + 0.03 * ahead[inside, 2]
    return float(near.sum() / len(points))


def _unit_intrinsics(rng: np.random.Generator) -> Array:
    """Intrinsics for an image 1 wide and 0.75 high, centred on the origin."""
    focal = rng.uniform(0.82, 0.95)
    return np.array([[focal, 0, rng.uniform(-0.01, 0.01)], [0, focal, rng.uniform(-0.01, 0.01)], [0, 0, 1]])


def _to_pixels(width: int, height: int) -> Array:
    """Unit image to pixels; pixels stay square, and the wider field belongs to the longer side of 4:3."""
    scale = max(float(width), height / 0.75)
    return np.array([[scale, 0, (width - 1) / 2], [0, scale, (height - 1) / 2], [0, 0, 1]])


_COARSE = (32, 24)


class _Look:
    """A coarse view, for choosing cameras."""

    def __init__(self, room: Room, T: Array, shape: Array) -> None:
        self.T = T
        self.K = _to_pixels(*_COARSE) @ shape
        rays = camera_rays(self.K, *_COARSE).reshape(-1, 3)
        hits = room.cast(T[:3, 3], rays @ T[:3, :3].T)
        self.depth = np.where(hits.face < 0, np.nan, hits.t).reshape(_COARSE[::-1])
        labels = room.label[np.maximum(hits.face, 0)]
        self.furnished = float(np.isin(labels, _FURNITURE).mean())
        self.kinds = len(np.unique(labels))

    def quality(self) -> float:
        """1 or more when the view is worth having: nothing in front of the lens, and more than bare walls."""
        near, middle = (float(v) for v in np.nanquantile(self.depth, (0.04, 0.5)))
        return min(near / 0.7, middle / 1.5, self.furnished / 0.35, self.kinds / 5, 5.0 / middle)


def _is_free(room: Room, point: Array) -> bool:
    """Inside the room, with `CLEARANCE_M` around it."""
    if (point < CLEARANCE_M).any() or (point > room.size - CLEARANCE_M).any():
        return False
    k = np.arange(128) + 0.5
    z, turn = 1 - 2 * k / 128, 2.39996 * k
    ball = np.stack([np.sqrt(1 - z**2) * np.cos(turn), np.sqrt(1 - z**2) * np.sin(turn), z], axis=1)
    return float(room.cast(point, ball).t.min()) > CLEARANCE_M


def _place_cameras(room: Room, rng: np.random.Generator, level: int, shapes: list[Array]) -> tuple[Array, Array]:
    """T_world_camera of both cameras: the first candidate that is good enough, or the best of all."""
    best: tuple[float, Array, Array] | None = None
    for _ in range(25):
        first = _first_camera(room, rng, shapes[0])
        if first is None:
            continue
        for _ in range(40):
            T = first.T @ _motion(rng, level)
            if not _is_free(room, T[:3, 3]):
                continue
            second = _Look(room, T, shapes[1])
            low, high = LEVELS[level][2:]
            overlap = mutual_overlap(first.depth, second.depth, first.K, second.K, se3_inverse(T) @ first.T, 1)
            miss = max(low - overlap, overlap - high, 0.0) + max(1 - second.quality(), 0.0)
            miss += max(1 - first.quality(), 0.0)
            if best is None or miss < best[0]:
                best = (miss, first.T, T)
            if miss == 0.0:
                return first.T, T
    if best is None:
        raise RuntimeError(f"room {room.seed} has no free space for two cameras {LEVELS[level][1]} m apart")
    return best[1], best[2]


def _first_camera(room: Room, rng: np.random.Generator, shape: Array) -> _Look | None:
    """The best of a few free places and directions: eye height, looking a little down across the room."""
    looks = []
    for _ in range(12):
        eye = np.append(rng.uniform(0.12, 0.88, 2) * room.size[:2], rng.uniform(1.0, 1.7))
        target = np.append(rng.uniform(0.2, 0.8, 2) * room.size[:2], rng.uniform(0.5, 1.2))
        roll = float(rng.normal(0, 0.04))
        if np.linalg.norm(target[:2] - eye[:2]) > 0.8 and _is_free(room, eye):
            looks.append(_Look(room, look_at(eye, target, roll), shape))
            if looks[-1].quality() >= 1.2:
                break
    return max(looks, key=_Look.quality, default=None)


def look_at(eye: Array, target: Array, roll: float = 0.0) -> Array:
    """4x4 T_world_camera at `eye` (m) with its optical axis through `target`, rolled by rad about that axis."""
    z = (target - eye) / np.linalg.norm(target - eye)
    x = np.cross(z, [0.0, 0.0, 1.0])
    x /= np.linalg.norm(x)
    T = np.eye(4)
    T[:3, :3] = np.stack([x, np.cross(z, x), z], axis=1) @ Rotation.from_rotvec([0, 0, roll]).as_matrix()
    T[:3, 3] = eye
    return T


def _motion(rng: np.random.Generator, level: int) -> Array:
    """4x4 T_0_1: exact angle and length of the level, mostly yaw and mostly sideways."""
    angle, length = np.deg2rad(LEVELS[level][0]), LEVELS[level][1]
    axis = rng.normal(0, 1, 3) * (0.45, 1.0, 0.35)
    way = rng.normal(0, 1, 3) * (1.0, 0.35, 0.8)
    T = np.eye(4)
    T[:3, :3] = Rotation.from_rotvec(angle * axis / np.linalg.norm(axis)).as_matrix()
    T[:3, 3] = length * way / np.linalg.norm(way)
    return T
