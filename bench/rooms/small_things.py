# SPDX-License-Identifier: Apache-2.0
"""Books, vases, plants, balls and boxes, and how they are strewn over a table top."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from bench.rooms import prints
from bench.rooms.mesh import Part, bounds, box, lathe, leaf, moved, superellipsoid
from bench.rooms.paint import Paint

SPINE_M = 0.04  # width of one spine on the shared canvas


def book_row(paint: Paint, rng: np.random.Generator, width: float, depth: float, height: float) -> list[Part]:
    """Standing books from x = 0 to `width`, backs at y = 0, at most depth x height m."""
    parts: list[Part] = []
    x = 0.0
    while True:
        t, h, d = rng.uniform(0.018, SPINE_M), height * rng.uniform(0.62, 1), depth * rng.uniform(0.75, 1)
        k = int(rng.integers(64))
        if x + t > width:
            return parts
        parts += book((x, -d, 0), (x + t, 0, h), paint, k)
        x += t + (0.002 if rng.random() < 0.93 else rng.uniform(0.02, 0.08))


def book(low: tuple[float, ...], high: tuple[float, ...], paint: Paint, spine: int) -> list[Part]:
    """A standing book whose spine is its front; cover and spine share their colours."""
    cover = box(low, high, paint.spines(), "book", (SPINE_M * spine, 0.0), ("front",))
    # Covers must stay within one spine's strip of the canvas: squeeze u.
    sides = box(low, high, paint.spines(), "book", (0.0, 0.0), ("left", "right"))
    sides.uv[..., 0] = SPINE_M * (spine + 0.2) + 0.1 * sides.uv[..., 0]
    pages = box(low, high, paint.paper(), "book", (0.0, 0.0), ("top", "bottom", "back"))
    return [cover, sides, pages]


def pile(paint: Paint, rng: np.random.Generator) -> list[Part]:
    """A few books lying on each other, spines to the front."""
    parts, z = [], 0.0
    for _ in range(int(rng.integers(2, 5))):
        h, d, t = rng.uniform(0.2, 0.27), rng.uniform(0.14, 0.19), rng.uniform(0.02, 0.038)
        standing = book((-t / 2, -d / 2, -h / 2), (t / 2, d / 2, h / 2), paint, int(rng.integers(64)))
        lying = np.array([[0.0, 0.0, 1.0], [0.0, 1.0, 0.0], [-1.0, 0.0, 0.0]])
        parts += moved([p.transformed(lying, (0, 0, 0)) for p in standing], rng.uniform(-0.3, 0.3), (0, 0, z + t / 2))
        z += t
    return parts


def vase(paint: Paint, rng: np.random.Generator) -> list[Part]:
    """Glazed vase, half of the time with a twig of leaves."""
    h, r = rng.uniform(0.15, 0.3), rng.uniform(0.05, 0.09)
    t = np.linspace(0, 1, 14)
    bulge = 0.55 + 0.45 * np.sin(np.pi * (0.15 + rng.uniform(0.6, 0.9) * t)) ** 2
    mouth = r * bulge[-1]
    profile = [(0.0, 0.0), *zip(r * bulge, h * t, strict=True), (0.8 * mouth, h), (0.5 * mouth, h - 0.05)]
    parts = [lathe(profile, paint.glaze(), "vase")]
    if rng.random() < 0.5:
        parts += _leaves(paint, rng, np.array([0, 0, h - 0.03]), 14, 0.22, 0.035)
    return parts


def _leaves(
    paint: Paint, rng: np.random.Generator, base: np.ndarray, count: int, reach: float, width: float
) -> list[Part]:
    """Blades that fan out of one point."""
    green = paint.foliage()
    out = []
    for k in range(count):
        angle, lift = 2.4 * k + rng.uniform(-0.4, 0.4), rng.uniform(0.35, 1.4)
        length = reach * rng.uniform(0.6, 1.1)
        way = np.array([np.cos(angle) * np.cos(lift), np.sin(angle) * np.cos(lift), np.sin(lift)])
        root = base + rng.uniform(0, 0.3) * length * np.array([0, 0, 1.0])
        out.append(leaf(root, root + length * way, width * rng.uniform(0.8, 1.3), green, "plant"))
    return out


def plant(paint: Paint, rng: np.random.Generator) -> list[Part]:
    """Large plant in a pot for the floor."""
    r, h = rng.uniform(0.13, 0.18), rng.uniform(0.26, 0.36)
    pot = lathe(
        [(0.0, 0.0), (0.75 * r, 0.0), (r, h), (0.9 * r, h), (0.88 * r, h - 0.03), (0.0, h - 0.03)],
        paint.glaze(),
        "vase",
    )
    leaves = _leaves(paint, rng, np.array([0, 0, h - 0.04]), int(rng.integers(26, 40)), rng.uniform(0.5, 0.75), 0.08)
    return moved([pot, *leaves], shift=(0, -0.32, 0))


def ball(paint: Paint, rng: np.random.Generator) -> list[Part]:
    """Ball with a printed pattern."""
    r = rng.uniform(0.06, 0.13)
    texture = paint.printed((2 * np.pi * r, np.pi * r), prints.abstract)
    return moved([superellipsoid((r, r, r), texture, "ball", n=32)], rng.uniform(0, 6), (0, 0, r))


def carton(paint: Paint, rng: np.random.Generator) -> list[Part]:
    """Small printed box."""
    w, d, h = rng.uniform(0.1, 0.22), rng.uniform(0.08, 0.16), rng.uniform(0.08, 0.26)
    texture = paint.printed((w, h), prints.poster)
    return moved([box((-w / 2, -d / 2, 0), (w / 2, d / 2, h), texture, "box")], rng.uniform(-0.6, 0.6))


def mug(paint: Paint, rng: np.random.Generator) -> list[Part]:
    """Cup without a handle."""
    r, h = rng.uniform(0.035, 0.045), rng.uniform(0.08, 0.1)
    return [lathe([(0.0, 0.0), (r, 0.0), (r, h), (0.9 * r, h), (0.88 * r, 0.01), (0, 0.01)], paint.glaze(), "vase", 20)]


def stand_picture(paint: Paint, rng: np.random.Generator) -> list[Part]:
    """Small framed picture that leans back."""
    w, h = rng.uniform(0.14, 0.24), rng.uniform(0.18, 0.28)
    front = paint.printed((w, h), prints.picture)
    parts = [box((-w / 2, -0.01, 0), (w / 2, 0.0, h), front, "picture", faces=("front",))]
    parts.append(
        box(
            (-w / 2, -0.01, 0),
            (w / 2, 0.008, h),
            paint.plain((0.2, 0.16, 0.12)),
            "picture",
            faces=("left", "right", "top", "back"),
        )
    )
    tilt = -0.18
    R = np.array([[1, 0, 0], [0, np.cos(tilt), -np.sin(tilt)], [0, np.sin(tilt), np.cos(tilt)]])
    return [p.transformed(R, (0, 0, 0)) for p in parts]


def table_lamp(paint: Paint, rng: np.random.Generator) -> list[Part]:
    """Lamp with a ceramic foot."""
    r = rng.uniform(0.1, 0.14)
    profile = [(0.0, 0.0), (0.06, 0.0), (0.075, 0.06), (0.03, 0.17), (0.012, 0.2), (0.012, 0.3)]
    foot = lathe(profile, paint.glaze(), "lamp")
    return [foot, lathe([(r, 0.24), (0.6 * r, 0.42)], paint.fabric((0.84, 0.78, 0.64)), "lamp")]


def clutter(
    paint: Paint, rng: np.random.Generator, width: float, depth: float, count: int, height: float = 0.5
) -> list[Part]:
    """Up to `count` things on a plane width x depth m (x centred, y from -depth to 0), none taller than `height`."""
    makers: tuple[Callable[[Paint, np.random.Generator], list[Part]], ...] = (
        pile, vase, ball, carton, carton, mug, stand_picture, table_lamp, pile,
    )  # fmt: skip
    parts: list[Part] = []
    taken: list[tuple[float, float, float]] = []
    for _ in range(count):
        thing = makers[int(rng.integers(len(makers)))](paint, rng)
        low, high = bounds(thing)
        radius = float(np.abs(np.stack([low, high])[:, :2]).max())
        radius = min(radius, 0.16)  # leaves may reach over their neighbours
        spots = rng.uniform(-0.5, 0.5, (12, 2)) * (max(width - 2 * radius, 0), max(depth - 2 * radius, 0))
        free = [s for s in spots if all(np.hypot(s[0] - x, s[1] - y) > radius + r for x, y, r in taken)]
        if high[2] > height or 2 * radius > depth + 0.04 or not free:
            continue
        taken.append((*free[0], radius))
        parts += moved(thing, rng.uniform(-0.3, 0.3), (free[0][0], free[0][1] - depth / 2, 0))
    return parts
