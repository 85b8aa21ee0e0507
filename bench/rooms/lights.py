# SPDX-License-Identifier: Apache-2.0
"""The lights of a room: a lamp under the ceiling and the windows, each as a few points of an area."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from bench.rooms import prints
from bench.rooms.mesh import Array, Part, cylinder, lathe, moved
from bench.rooms.paint import Paint

POINTS = 16
GOLDEN_ANGLE = 2.39996


@dataclass(frozen=True, eq=False)
class Light:
    """An area light as points.

    Args:
        points: 16x3 m.
        power: 3, linear RGB.
        normal: 3 unit for one that shines to one side (a window), None for all sides.
    """

    points: Array
    power: Array
    normal: Array | None


def ceiling_lamp(paint: Paint, rng: np.random.Generator, size: Array) -> tuple[list[Part], Light]:
    """A lamp near the middle of the ceiling of a room of 3 m, and its light just below the shade."""
    x, y = (float(v) for v in size[:2] * rng.uniform(0.35, 0.65, 2))
    shade = paint.finish(prints.flat((0.95, 0.92, 0.85)), 0.02, glow=1.0)
    lamp = [lathe([(0.17, 0.0), (0.19, 0.06), (0.12, 0.14), (0.02, 0.16)], shade, "lamp")]
    lamp += cylinder(0.012, 0.16, 0.28, paint.metal(), "lamp", 10)
    turn = GOLDEN_ANGLE * np.arange(POINTS)
    spread = 0.22 * np.sqrt((np.arange(POINTS) + 0.5) / POINTS)
    disc = np.stack([spread * np.cos(turn), spread * np.sin(turn), np.zeros(POINTS)], axis=1)
    power = np.array([1.0, 0.93, 0.82]) * float(rng.uniform(1.6, 2.6))
    light = Light(disc + np.array([x, y, float(size[2]) - 0.3]), power, None)
    return moved(lamp, shift=(x, y, float(size[2]) - 0.28)), light


def window_light(
    rng: np.random.Generator, wall: tuple[float, tuple[float, float, float]], pane: tuple[float, float, float, float]
) -> Light:
    """Daylight through `pane` (low x, low z, high x, high z in m) on a wall of given yaw (rad) and left corner (m)."""
    (yaw, corner), (x0, z0, x1, z1) = wall, pane
    c, s = np.cos(yaw), np.sin(yaw)
    grid = (np.stack(np.meshgrid(np.arange(4), np.arange(4)), axis=-1).reshape(-1, 2) + 0.5) / 4
    # In front of the frame, so that the frame casts no shadow on the room.
    local = np.stack([x0 + grid[:, 0] * (x1 - x0), np.full(POINTS, -0.15), z0 + grid[:, 1] * (z1 - z0)], axis=1)
    points = local @ np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]]).T + corner
    power = np.array([0.88, 0.95, 1.05]) * float(rng.uniform(2.0, 3.5)) * (x1 - x0) * (z1 - z0)
    return Light(points, power, np.array([s, -c, 0.0]))
