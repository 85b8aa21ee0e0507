# SPDX-License-Identifier: Apache-2.0
"""Surfaces and lights of a room, and its ray caster."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt
from embreex.mesh_construction import TriangleMesh  # type: ignore[import-untyped]
from embreex.rtcore_scene import EmbreeScene  # type: ignore[import-untyped]

from bench.rooms.lights import Light
from bench.rooms.mesh import LABELS, Array, Part

Float32Array = npt.NDArray[np.float32]


@dataclass(frozen=True, eq=False)
class Hits:
    """First hits of N rays. `face` is -1 for a miss; t is then 0, u and v are meaningless."""

    face: npt.NDArray[np.int64]
    t: Float32Array
    u: Float32Array
    v: Float32Array


class Scene:
    """The surfaces and lights of a room, and the rays cast into it.

    World frame: z up, floor at z = 0, one corner at the origin, metres. Lamps glow 1 / `gain` times their colour, so
    that they look the same in any light.

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
