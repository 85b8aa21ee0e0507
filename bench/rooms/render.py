# SPDX-License-Identifier: Apache-2.0
"""A room as a camera sees it: colour, exact z-depth and labels."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from bench.rooms import shading
from bench.rooms.lights import Light
from bench.rooms.mesh import Array, Part
from bench.rooms.scene import Float32Array, Scene

DEFAULT_NOISE_SIGMA = 1.5  # grey levels of 255


@dataclass(frozen=True, eq=False)
class Rendering:
    """An image with depth and labels.

    Args:
        rgb: HxWx3 uint8.
        depth_m: HxW float32, metres along the optical axis at pixel centres; NaN where nothing is hit.
        labels: HxW int32, index into `LABELS`; 0 where nothing is hit.
    """

    rgb: npt.NDArray[np.uint8]
    depth_m: Float32Array
    labels: npt.NDArray[np.int32]


class Room(Scene):
    """A furnished room that can be looked at; arguments as for `Scene`."""

    def __init__(self, parts: Sequence[Part], size: Array, lights: Sequence[Light], seed: int = 0) -> None:
        super().__init__(parts, size, lights, seed)
        self.gain = shading.room_gain(self)

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
