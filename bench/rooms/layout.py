# SPDX-License-Identifier: Apache-2.0
"""A furnished room from a seed. World frame: z up, floor at z = 0, metres."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np

from bench.rooms import furniture as fu
from bench.rooms import lights, prints
from bench.rooms.mesh import Array, Part, bounds, box, moved, superellipsoid
from bench.rooms.paint import Paint
from bench.rooms.render import Room
from bench.rooms.small_things import ball, plant

Rect = tuple[float, float, float, float]  # low x, low y, high x, high y
Maker = Callable[[Paint, np.random.Generator], list[Part]]

SKIN = 0.1  # thickness of walls, m


@dataclass(eq=False)
class _Plan:
    """Furniture placed up to now. Wall k has its own frame: x along it, y into it, z up, origin in its left corner."""

    size: Array
    parts: list[Part] = field(default_factory=list)
    floor: list[Rect] = field(default_factory=list)
    hung: list[list[Rect]] = field(default_factory=lambda: [[], [], [], []])

    def wall(self, k: int) -> tuple[float, tuple[float, float, float], float]:
        """Yaw in rad, left corner and length of wall 0 (+y), 1 (+x), 2 (-y), 3 (-x)."""
        w, d, _ = (float(v) for v in self.size)
        corner = ((0.0, d, 0.0), (w, d, 0.0), (w, 0.0, 0.0), (0.0, 0.0, 0.0))[k]
        return -0.5 * np.pi * k, corner, (w, d)[k % 2]

    def on_wall(self, k: int, x: float, parts: list[Part], out: float = 0.0) -> list[Part]:
        """Parts from their own frame to wall k, their x = 0 at `x` m along it, `out` m away from it."""
        yaw, corner, _ = self.wall(k)
        return moved(moved(parts, shift=(x, -out, 0.0)), yaw, corner)

    def against_wall(self, parts: list[Part], rng: np.random.Generator, tries: int = 30) -> bool:
        """Put a piece with its back to a wall where nothing stands or hangs yet."""
        low, high = bounds(parts)
        for _ in range(tries):
            k = int(rng.integers(4))
            length = self.wall(k)[2]
            half = max(-low[0], high[0]) + 0.04
            if length < 2 * half:
                continue
            x = float(rng.uniform(half, length - half))
            out = max(float(high[1]), 0.0) + float(rng.uniform(0.02, 0.06))
            placed = self.on_wall(k, x, parts, out)
            shade = (x - half, 0.0, x + half, float(high[2]))
            if any(_overlap(shade, r) for r in self.hung[k]) or not self.claim(placed, 0.12):
                continue
            self.hung[k].append(shade)
            return True
        return False

    def free_standing(self, parts: list[Part], rng: np.random.Generator, gap: float, tries: int = 40) -> bool:
        """Put a piece anywhere on the floor, at any angle."""
        for _ in range(tries):
            at = rng.uniform(0.15, 0.85, 2) * self.size[:2]
            angle = float(rng.integers(4)) * np.pi / 2 + float(rng.uniform(-0.3, 0.3))
            low, high = bounds(parts)
            centred = moved(parts, shift=(0.0, -float(low[1] + high[1]) / 2, 0.0))
            if self.claim(moved(centred, angle, (at[0], at[1], 0.0)), gap):
                return True
        return False

    def claim(self, parts: list[Part], gap: float) -> bool:
        """Keep the parts if their footprint is inside the room and clear of others by `gap` m."""
        low, high = bounds(parts)
        if low[:2].min() < 0.0 or (high[:2] > self.size[:2]).any():
            return False
        rect = (low[0] - gap / 2, low[1] - gap / 2, high[0] + gap / 2, high[1] + gap / 2)
        if any(_overlap(rect, r) for r in self.floor):
            return False
        self.floor.append(rect)
        self.parts += parts
        return True


def _overlap(a: Rect, b: Rect) -> bool:
    return a[0] < b[2] and b[0] < a[2] and a[1] < b[3] and b[1] < a[3]


def make_room(seed: int, texture: float = 1.0) -> Room:
    """A furnished room.

    Args:
        seed: decides everything; the same seed gives the same room.
        texture: 1 = rich surfaces, 0 = almost plain ones. The shape of the room does not depend on it.
    Returns:
        Room with 3-6 x 3-6 x 2.4-3 m inside.
    """
    rng = np.random.default_rng([seed, 101])
    paint = Paint(np.random.default_rng([seed, 102]), float(texture))
    size = np.array([rng.uniform(3.2, 6.0), rng.uniform(3.2, 6.0), rng.uniform(2.4, 3.0)])
    plan = _Plan(size)
    _shell(plan, paint)
    panes = _openings(plan, paint, rng)
    _furnish(plan, paint, rng)
    _hang_pictures(plan, paint, rng)
    lamp, light = lights.ceiling_lamp(paint, rng, size)
    plan.parts += lamp
    shining = [light, *(lights.window_light(rng, plan.wall(k)[:2], pane) for k, pane in panes)]
    return Room(plan.parts, size, shining, seed)


def _shell(plan: _Plan, paint: Paint) -> None:
    """Walls, floor, ceiling, skirting boards."""
    w, d, h = (float(v) for v in plan.size)
    s = SKIN
    floor, ceiling = paint.floor((w + 2 * s, d + 2 * s)), paint.ceiling((w + 2 * s, d + 2 * s))
    plan.parts.append(box((-s, -s, -s), (w + s, d + s, 0), floor, "floor", faces=("top",)))
    plan.parts.append(box((-s, -s, h), (w + s, d + s, h + s), ceiling, "ceiling", faces=("bottom",)))
    lengths = [plan.wall(k)[2] + 2 * s for k in range(4)]
    board = paint.plain((0.88, 0.87, 0.84))
    for k, wall in enumerate(paint.walls([(length, h + s) for length in lengths])):
        half = lengths[k] / 2
        parts = [box((-half, 0, -s), (half, s, h + s), wall, "wall", faces=("front",))]
        parts.append(box((-half + s, -0.014, 0), (half - s, 0, 0.08), board, "trim"))
        plan.parts += plan.on_wall(k, half - s, parts)


def _openings(plan: _Plan, paint: Paint, rng: np.random.Generator) -> list[tuple[int, Rect]]:
    """A door and one or two windows; returns the panes as (wall, rectangle on it)."""
    order = [int(k) for k in rng.permutation(4)]
    _door(plan, paint, rng, order[0])
    panes = []
    for k in order[1 : 1 + int(rng.integers(1, 3))]:
        length, h = plan.wall(k)[2], float(plan.size[2])
        w = float(rng.uniform(1.0, min(1.8, length - 1.0)))
        x, z0, z1 = float(rng.uniform(0.3 + w / 2, length - 0.3 - w / 2)), float(rng.uniform(0.85, 1.0)), h - 0.35
        plan.parts += plan.on_wall(k, x, _window(paint, w, z0, z1))
        plan.hung[k].append((x - w / 2 - 0.05, z0, x + w / 2 + 0.05, z1))
        panes.append((k, (x - w / 2, z0, x + w / 2, z1)))
    return panes


def _door(plan: _Plan, paint: Paint, rng: np.random.Generator, k: int) -> None:
    w, h = 0.86, 2.04
    x = float(rng.uniform(0.7, plan.wall(k)[2] - 0.7))
    leaf, trim, metal = paint.printed((w, h), prints.door_leaf, 0.0025), paint.plain((0.9, 0.89, 0.86)), paint.metal()
    parts = [box((-w / 2, -0.02, 0), (w / 2, 0, h), leaf, "door")]
    out = w / 2 + 0.07
    for x0, z0, x1, z1 in ((-out, 0, -w / 2, h), (w / 2, 0, out, h), (-out, h, out, h + 0.07)):
        parts.append(box((x0, -0.035, z0), (x1, 0, z1), trim, "trim"))
    parts += moved([superellipsoid((0.06, 0.018, 0.012), metal, "door", 0.6, 16)], shift=(w / 2 - 0.1, -0.06, 1.02))
    parts += moved([superellipsoid((0.018, 0.03, 0.018), metal, "door", 1.0, 12)], shift=(w / 2 - 0.06, -0.035, 1.02))
    placed = plan.on_wall(k, x, parts)
    plan.parts += placed
    plan.hung[k].append((x - w / 2 - 0.1, 0.0, x + w / 2 + 0.1, h + 0.1))
    step = bounds(plan.on_wall(k, x, [box((-w / 2, -0.7, 0), (w / 2, 0, 0.1), trim, "trim")]))
    plan.floor.append((*step[0, :2], *step[1, :2]))


def _window(paint: Paint, w: float, z0: float, z1: float) -> list[Part]:
    """Frame with a bright view; centred on x = 0, its sill sticks out."""
    trim, h = paint.plain((0.92, 0.91, 0.89)), z1 - z0
    view = paint.printed((w, h), prints.outdoors, glow=1.0)
    parts = [box((-w / 2, -0.004, z0), (w / 2, 0, z1), view, "window", faces=("front",))]
    bar = 0.05
    for x in (-w / 2, -bar / 2, w / 2 - bar):
        parts.append(box((x, -0.04, z0), (x + bar, 0, z1), trim, "window"))
    for z in (z0, z0 + 0.62 * h, z1 - bar):
        parts.append(box((-w / 2, -0.036, z), (w / 2, 0, z + bar), trim, "window"))
    parts.append(box((-w / 2 - 0.05, -0.14, z0 - 0.03), (w / 2 + 0.05, 0, z0), trim, "window"))
    return parts


def _furnish(plan: _Plan, paint: Paint, rng: np.random.Generator) -> None:
    """6-10 pieces: the large ones to the walls first, then the middle, then what fits."""
    for maker in (fu.sofa, fu.bookshelf, fu.cabinet if rng.random() < 0.6 else fu.desk):
        plan.against_wall(maker(paint, rng), rng)
    if plan.free_standing(_seating_group(paint, rng), rng, 0.5):
        _lay_rug(plan, paint, rng)
    extra: tuple[Maker, ...] = (
        fu.bookshelf, fu.cabinet, fu.desk, plant, fu.floor_lamp, fu.parcels, fu.chair, plant, fu.parcels, fu.floor_lamp,
    )  # fmt: skip
    for index in rng.permutation(len(extra))[: int(rng.integers(4, 6))]:
        plan.against_wall(extra[int(index)](paint, rng), rng)
    for maker in (fu.pouf, ball):
        plan.free_standing(maker(paint, rng), rng, 0.2)


def _seating_group(paint: Paint, rng: np.random.Generator) -> list[Part]:
    """A low table, or a dining table with chairs around it."""
    if rng.random() < 0.5:
        return fu.coffee_table(paint, rng)
    parts = fu.table(paint, rng)
    low, high = bounds(parts)
    for side in (-1, 1):
        for x in (-0.28, 0.28):
            if rng.random() < 0.75:
                seat = moved(fu.chair(paint, rng), shift=(0.0, 0.22, 0.0))
                yaw = (np.pi if side < 0 else 0.0) + float(rng.uniform(-0.25, 0.25))
                y = float(high[1]) + 0.18 if side > 0 else float(low[1]) - 0.18
                parts += moved(seat, yaw, (x, y, 0.0))
    return parts


def _lay_rug(plan: _Plan, paint: Paint, rng: np.random.Generator) -> None:
    """A rug under the last piece, clipped to the room."""
    x0, y0, x1, y1 = plan.floor[-1]
    grow = float(rng.uniform(0.1, 0.5))
    low = np.maximum((x0 - grow, y0 - grow), 0.1)
    high = np.minimum((x1 + grow, y1 + grow), plan.size[:2] - 0.1)
    size = (float(high[0] - low[0]), float(high[1] - low[1]))
    texture = paint.printed(size, prints.rug, 0.0025)
    # No sides: at a few millimetres they would only flicker along the edge.
    plan.parts.append(box((*low, 0), (*high, 0.004), texture, "rug", faces=("top",)))


def _hang_pictures(plan: _Plan, paint: Paint, rng: np.random.Generator) -> None:
    """Pictures, and a clock, on the free places of the walls."""
    for n in range(int(rng.integers(12, 17))):
        w, h = (0.3, 0.3) if n == 0 else (float(v) for v in rng.uniform(0.25, 0.75, 2))
        k = int(rng.integers(4))
        x, z = float(rng.uniform(0.1 + w / 2, plan.wall(k)[2] - 0.1 - w / 2)), float(rng.uniform(1.45, 1.75))
        rect = (x - w / 2 - 0.08, z - h / 2 - 0.08, x + w / 2 + 0.08, z + h / 2 + 0.08)
        if any(_overlap(rect, r) for r in plan.hung[k]) or rect[3] > plan.size[2]:
            continue
        plan.hung[k].append(rect)
        front = paint.printed((w, h), prints.clock_face if n == 0 else prints.picture)
        edge = paint.plain((0.2, 0.16, 0.12))
        low, high = (-w / 2, -0.025, z - h / 2), (w / 2, 0.0, z + h / 2)
        parts = [box(low, high, front, "picture", faces=("front",))]
        parts.append(box(low, high, edge, "picture", faces=("left", "right", "top", "bottom")))
        plan.parts += plan.on_wall(k, x, parts)
