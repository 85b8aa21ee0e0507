# SPDX-License-Identifier: Apache-2.0
"""Room and its ray caster: colour, exact z-depth and labels from any camera."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt
from embreex.mesh_construction import TriangleMesh  # type: ignore[import-untyped]
from embreex.rtcore_scene import EmbreeScene  # type: ignore[import-untyped]

from bench.rooms import shading
from bench.rooms.lights import Light
from bench.rooms.mesh import LABELS, Array, Part

Float32Array = npt.NDArray[np.float32]
DEFAULT_NOISE_SIGMA = 1.5  # grey levels of 255


@dataclass(frozen=True, eq=False)
class Rendering:
    """What a camera sees.

    Args:
        rgb: HxWx3 uint8.
        depth_m: HxW float32, metres along the optical axis at pixel centres; NaN where nothing is hit.
        labels: HxW int32, index into `LABELS`; 0 where nothing is hit.
    """

    rgb: npt.NDArray[np.uint8]
    depth_m: Float32Array
    labels: npt.NDArray[np.int32]


@dataclass(frozen=True, eq=False)
class Hits:
    """Where N rays ended. `face` is -1 for a miss; t is then 0, u and v are meaningless."""

    face: npt.NDArray[np.int64]
    t: Float32Array
    u: Float32Array
    v: Float32Array


class Room:
    """A furnished room. World frame: z up, floor at z = 0, one corner at the origin, metres.

    Args:
        parts: everything in it.
        size: 3 m, inner width (x), depth (y), height (z).
        lights: what shines.
        seed: default seed of the sensor noise.
    """

    label_names = LABELS

    def __init__(self, parts: Sequence[Part], size: Array, lights: Sequence[Light], seed: int = 0) -> None:
        self.size = size
        self.lights = tuple(lights)
        self.seed = seed
        self.textures = tuple({id(p.texture): p.texture for p in parts}.values())
        index = {id(t): k for k, t in enumerate(self.textures)}
        counts = [len(p.corners) for p in parts]
        self.corners = np.concatenate([p.corners for p in parts]).astype(np.float32)
        self.uv = np.concatenate([p.uv for p in parts]).astype(np.float32)
        self.normals = np.concatenate([p.normals for p in parts]).astype(np.float32)
        self.smooth = (self.normals != self.normals[:, :1]).any(axis=(1, 2))
        self.texture = np.repeat([index[id(p.texture)] for p in parts], counts).astype(np.int16)
        self.label = np.repeat([LABELS.index(p.label) for p in parts], counts).astype(np.int32)
        first = np.cumsum([0] + [int(p.patch.max()) + 1 for p in parts])
        self.patch = np.concatenate([p.patch + k for p, k in zip(parts, first[:-1], strict=True)]).astype(np.int32)
        self._scene = EmbreeScene(robust=True)
        index3 = np.arange(3 * len(self.corners), dtype=np.int32).reshape(-1, 3)
        TriangleMesh(self._scene, self.corners.reshape(-1, 3), index3)
        self.gain = 1.0
        self.gain = shading.room_gain(self)

    def cast(self, origins: npt.NDArray[Any], directions: npt.NDArray[Any]) -> Hits:
        """First hits of N rays: Nx3 or 3 origins in m, Nx3 directions; `t` is in units of the direction's length."""
        d = np.ascontiguousarray(directions, np.float32)
        o = np.ascontiguousarray(np.broadcast_to(np.asarray(origins, np.float32), d.shape))
        hit = self._scene.run(o, d, query="INTERSECT", output=True)
        face = hit["primID"].astype(np.int64)
        # A finite t for misses keeps infinities out of the rays that start at the hits.
        return Hits(face, np.where(face < 0, np.float32(0), hit["tfar"]), hit["u"], hit["v"])

    def blocked(self, origins: Float32Array, directions: Float32Array) -> npt.NDArray[np.bool_]:
        """Whether anything is hit within one length of each of N directions."""
        hits = self.cast(origins, directions)
        return np.asarray((hits.face >= 0) & (hits.t < 1.0))

    def render(
        self,
        T_world_camera: npt.NDArray[Any],
        K: npt.NDArray[Any],
        width: int,
        height: int,
        exposure: float = 1.0,
        noise_sigma: float = DEFAULT_NOISE_SIGMA,
        rng: np.random.Generator | int | None = None,
        supersample: int = 2,
    ) -> Rendering:
        """Look at the room.

        Args:
            T_world_camera: 4x4, points of the camera (OpenCV optical frame) to the room, m.
            K: 3x3 pixels; pixel centres at integers.
            width: pixels.
            height: pixels.
            exposure: factor on the light, before the tone curve.
            noise_sigma: sensor noise in grey levels of 255.
            rng: source of that noise, or its seed; None = from the room's seed.
            supersample: colour is the mean of this many samples per pixel and direction.
        """
        T = np.asarray(T_world_camera, float)
        K = np.asarray(K, float)
        rays = shading.camera_rays(K, width, height).reshape(-1, 3) @ T[:3, :3].T.astype(np.float32)
        hits = self.cast(T[:3, 3], rays)
        miss = hits.face < 0
        depth = np.where(miss, np.float32(np.nan), hits.t).reshape(height, width)
        labels = np.where(miss, 0, self.label[hits.face]).astype(np.int32).reshape(height, width)
        light = shading.radiance(self, T, K, width, height, supersample, hits)
        if not isinstance(rng, np.random.Generator):
            rng = np.random.default_rng([self.seed, 7] if rng is None else rng)
        rgb = shading.develop(light, exposure * self.gain, noise_sigma, rng)
        return Rendering(rgb, depth.astype(np.float32), labels)
