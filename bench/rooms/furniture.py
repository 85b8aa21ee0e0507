# SPDX-License-Identifier: Apache-2.0
"""Pieces of furniture, each in its own frame (see `bench.rooms.mesh`): centred on x = 0, back at y = 0, floor z = 0."""

from __future__ import annotations

import numpy as np

from bench.rooms import prints
from bench.rooms.mesh import Part, board, box, cylinder, lathe, moved, superellipsoid
from bench.rooms.paint import Paint
from bench.rooms.small_things import book_row, clutter
from bench.rooms.textures import Texture


def _uv(rng: np.random.Generator) -> tuple[float, float]:
    """A random place on a repeating texture, m, so that no two boards show the same grain."""
    return float(rng.uniform(0, 3)), float(rng.uniform(0, 3))


def _legs(
    rng: np.random.Generator, width: float, depth: float, height: float, side: float, wood: Texture, label: str
) -> list[Part]:
    """Four square legs at the corners of width x depth."""
    out = []
    for x in (-width / 2, width / 2 - side):
        for y in (-depth, -side):
            out.append(box((x, y, 0), (x + side, y + side, height), wood, label, _uv(rng)))
    return out


def bookshelf(paint: Paint, rng: np.random.Generator) -> list[Part]:
    """Open shelf with books and a few things."""
    w, d, h = rng.uniform(0.8, 1.4), rng.uniform(0.26, 0.34), rng.uniform(1.3, 2.1)
    wood, t = paint.wood(), 0.022
    parts = [board((x, -d, 0), (x + t, 0, h), wood, "shelf", _uv(rng)) for x in (-w / 2, w / 2 - t)]
    parts.append(board((-w / 2, -0.008, 0), (w / 2, 0, h), wood, "shelf", _uv(rng)))
    levels = np.linspace(0.06, h - t, round(h / 0.36) + 1)
    for k, z in enumerate(levels):
        parts.append(board((-w / 2 + t, -d, z), (w / 2 - t, -0.008, z + t), wood, "shelf", _uv(rng)))
        if k + 1 < len(levels):
            parts += _shelf_contents(paint, rng, w - 2 * t, d, z + t, levels[k + 1] - z - t)
    return parts + moved(clutter(paint, rng, 0.8 * w, d, 2), shift=(0, 0, h))


def _shelf_contents(
    paint: Paint, rng: np.random.Generator, width: float, depth: float, low: float, room: float
) -> list[Part]:
    """Books over most of one shelf, things on the rest."""
    share = float(rng.uniform(0.5, 1.0)) if rng.random() < 0.8 else 0.0
    left = -width / 2 + (0 if rng.random() < 0.5 else (1 - share) * width)
    parts = (
        moved(
            book_row(paint, rng, share * width, min(depth - 0.05, 0.2), min(room - 0.03, 0.29)),
            shift=(left, -0.03, low),
        )
        if share
        else []
    )
    rest = (1 - share) * width
    if rest > 0.2 and room > 0.2:
        centre = (left + share * width + width / 2) / 2 if left < -width / 2 + 1e-6 else (left - width / 2) / 2
        things = clutter(paint, rng, 0.8 * rest, depth, max(int(rest / 0.25), 1), room - 0.03)
        parts += moved(things, shift=(centre, 0, low))
    return parts


def cabinet(paint: Paint, rng: np.random.Generator) -> list[Part]:
    """Low cabinet with drawers and things on top."""
    w, d, h = rng.uniform(0.9, 1.6), rng.uniform(0.38, 0.46), rng.uniform(0.6, 0.9)
    wood, metal = paint.wood(), paint.metal()
    parts = [board((-w / 2, -d, 0.08), (w / 2, 0, h), wood, "cabinet", _uv(rng))]
    parts += _legs(rng, w - 0.06, d - 0.02, 0.08, 0.05, wood, "cabinet")
    cols, rows = int(rng.integers(2, 4)), int(rng.integers(1, 4))
    gap = 0.012
    for i in range(cols):
        for j in range(rows):
            cw, ch = w / cols, (h - 0.1) / rows
            x, z = -w / 2 + i * cw, 0.09 + j * ch
            low, high = (x + gap, -d - 0.018, z + gap), (x + cw - gap, -d, z + ch - gap)
            parts.append(board(low, high, wood, "cabinet", _uv(rng)))
            knob = superellipsoid((0.016, 0.014, 0.016), metal, "cabinet", n=12)
            parts += moved([knob], shift=(x + cw / 2, -d - 0.03, z + ch * 0.6))
    return parts + moved(clutter(paint, rng, 0.9 * w, d, int(rng.integers(3, 6))), shift=(0, 0, h))


def sofa(paint: Paint, rng: np.random.Generator) -> list[Part]:
    """Two or three seats with cushions."""
    seats = int(rng.integers(2, 4))
    arm, seat = 0.16, rng.uniform(0.58, 0.66)
    w, d, low = seats * seat + 2 * arm, rng.uniform(0.8, 0.92), 0.24
    cloth, wood = paint.fabric(), paint.wood()
    parts = _legs(rng, w - 0.1, d - 0.1, 0.1, 0.05, wood, "sofa")
    parts.append(box((-w / 2, -d, 0.1), (w / 2, 0, low), cloth, "sofa", _uv(rng)))

    def pad(size: tuple[float, float, float], at: tuple[float, float, float], power: float = 0.22) -> None:
        shape = superellipsoid((size[0] / 2, size[1] / 2, size[2] / 2), cloth, "sofa", power, 32)
        parts.extend(moved([shape], shift=at))

    for side in (-1, 1):
        pad((arm, d, 0.5), (side * (w - arm) / 2, -d / 2, 0.37), 0.2)
    for k in range(seats):
        x = -w / 2 + arm + (k + 0.5) * seat
        pad((seat, d - 0.18, 0.22), (x, -d / 2 - 0.06, low + 0.11))
        pad((seat, 0.24, 0.52), (x, -0.15, 0.58), 0.3)
    for _ in range(int(rng.integers(1, 4))):
        pillow = superellipsoid((0.2, 0.07, 0.2), paint.fabric(), "sofa", 0.45, 28)
        lean = rng.uniform(0.2, 0.4)
        R = np.array([[1, 0, 0], [0, np.cos(lean), -np.sin(lean)], [0, np.sin(lean), np.cos(lean)]])
        at = (rng.uniform(-w / 2 + arm + 0.2, w / 2 - arm - 0.2), -0.38, low + 0.40)
        parts.append(pillow.transformed(R, at))
    return parts


def chair(paint: Paint, rng: np.random.Generator) -> list[Part]:
    """Wooden chair with a cushion; its back is at y = 0."""
    w, d, h = 0.42, 0.44, 0.45
    wood = paint.wood()
    parts = _legs(rng, w, d, h, 0.035, wood, "chair")
    parts.append(board((-w / 2, -d, h), (w / 2, 0, h + 0.025), wood, "chair", _uv(rng)))
    cushion = superellipsoid((w / 2 - 0.01, d / 2 - 0.02, 0.025), paint.fabric(), "chair", 0.3)
    parts += moved([cushion], shift=(0, -d / 2, h + 0.045))
    for x in (-w / 2, w / 2 - 0.035):
        parts.append(board((x, -0.035, h), (x + 0.035, 0, 0.92), wood, "chair", _uv(rng)))
    for z in (0.60, 0.71, 0.82):
        parts.append(board((-w / 2, -0.028, z), (w / 2, -0.008, z + 0.06), wood, "chair", _uv(rng)))
    return parts


def table(paint: Paint, rng: np.random.Generator) -> list[Part]:
    """Dining table with things on it."""
    w, d, h = rng.uniform(1.1, 1.6), rng.uniform(0.7, 0.9), rng.uniform(0.72, 0.77)
    wood = paint.wood()
    parts = [board((-w / 2, -d, h - 0.035), (w / 2, 0, h), wood, "table", _uv(rng))]
    parts.append(board((-w / 2 + 0.06, -d + 0.06, h - 0.12), (w / 2 - 0.06, -0.06, h - 0.035), wood, "table", _uv(rng)))
    parts += moved(_legs(rng, w - 0.08, d - 0.08, h - 0.035, 0.06, wood, "table"), shift=(0, -0.04, 0))
    things = clutter(paint, rng, 0.85 * w, 0.8 * d, int(rng.integers(4, 7)))
    return parts + moved(things, shift=(0, -0.1 * d, h))


def coffee_table(paint: Paint, rng: np.random.Generator) -> list[Part]:
    """Low table, square or round."""
    h = rng.uniform(0.36, 0.46)
    wood = paint.wood()
    if rng.random() < 0.5:
        r = rng.uniform(0.35, 0.5)
        parts = moved(cylinder(r, h - 0.03, h, wood, "table", 40), shift=(0, -r, 0))
        parts += moved(cylinder(0.04, 0.02, h - 0.03, paint.metal(), "table"), shift=(0, -r, 0))
        parts += moved(cylinder(0.6 * r, 0, 0.02, wood, "table", 32), shift=(0, -r, 0))
        return parts + moved(clutter(paint, rng, 1.2 * r, 1.2 * r, 3), shift=(0, -0.4 * r, h))
    w, d = rng.uniform(0.8, 1.1), rng.uniform(0.5, 0.65)
    parts = [board((-w / 2, -d, h - 0.03), (w / 2, 0, h), wood, "table", _uv(rng))]
    parts.append(board((-w / 2 + 0.05, -d + 0.05, 0.12), (w / 2 - 0.05, -0.05, 0.14), wood, "table", _uv(rng)))
    parts += _legs(rng, w, d, h - 0.03, 0.05, wood, "table")
    return parts + moved(clutter(paint, rng, 0.85 * w, 0.85 * d, 3), shift=(0, -0.07 * d, h))


def desk(paint: Paint, rng: np.random.Generator) -> list[Part]:
    """Desk with a screen, drawers and things."""
    w, d, h = rng.uniform(1.1, 1.5), rng.uniform(0.58, 0.7), 0.74
    wood, dark = paint.wood(), paint.plain((0.10, 0.10, 0.11))
    parts = [board((-w / 2, -d, h - 0.03), (w / 2, 0, h), wood, "table", _uv(rng))]
    parts += _legs(rng, w, d, h - 0.03, 0.045, wood, "table")
    parts.append(board((w / 2 - 0.42, -d + 0.04, 0.3), (w / 2 - 0.05, -0.04, h - 0.03), wood, "table", _uv(rng)))
    sw, sh = 0.56, 0.33
    screen = paint.printed((sw - 0.02, sh - 0.02), prints.keys_and_screen, glow=0.25)
    monitor = [
        box((-sw / 2, -0.02, 0.12), (sw / 2, 0.02, 0.12 + sh), dark, "box"),
        box((-sw / 2 + 0.01, -0.022, 0.13), (sw / 2 - 0.01, -0.0205, 0.11 + sh), screen, "picture"),
        box((-0.03, 0.0, 0.01), (0.03, 0.03, 0.25), dark, "box"),
        box((-0.13, -0.08, 0), (0.13, 0.08, 0.012), dark, "box"),
        box((-0.22, -0.36, 0), (0.22, -0.22, 0.018), dark, "box"),
    ]
    parts += moved(monitor, rng.uniform(-0.25, 0.25), (rng.uniform(-0.15, 0.05), -0.2, h))
    for side in (-1, 1):
        things = clutter(paint, rng, 0.22, 0.5 * d, 2)
        parts += moved(things, shift=(side * (w / 2 - 0.16), -0.1, h))
    return parts


def floor_lamp(paint: Paint, rng: np.random.Generator) -> list[Part]:
    """Standing lamp with a shade."""
    h, r = rng.uniform(1.4, 1.7), rng.uniform(0.18, 0.24)
    metal, shade = paint.metal(), paint.fabric((0.85, 0.78, 0.62))
    parts = [*cylinder(0.15, 0, 0.025, metal, "lamp"), lathe([(0.014, 0.025), (0.014, h)], metal, "lamp", 12)]
    parts.append(lathe([(r, h - 0.28), (0.6 * r, h)], shade, "lamp"))
    return moved(parts, shift=(0, -r, 0))


def pouf(paint: Paint, rng: np.random.Generator) -> list[Part]:
    """Round upholstered stool."""
    r, h = rng.uniform(0.22, 0.3), rng.uniform(0.34, 0.44)
    cloth = paint.fabric()
    shape = superellipsoid((r, r, h / 2), cloth, "chair", 0.5, 36)
    return moved([shape], shift=(0, -r, h / 2))


def parcels(paint: Paint, rng: np.random.Generator) -> list[Part]:
    """Two or three cardboard boxes on top of each other."""
    parts, z = [], 0.0
    w, d = rng.uniform(0.4, 0.55), rng.uniform(0.35, 0.45)
    for _ in range(int(rng.integers(2, 4))):
        h = rng.uniform(0.22, 0.36)
        card = paint.printed((w, h), prints.parcel, 0.0025)
        parcel = [box((-w / 2, -d / 2, 0), (w / 2, d / 2, h), card, "box")]
        parts += moved(parcel, rng.uniform(-0.25, 0.25), (0, -d / 2 - 0.08, z))
        z, w, d = z + h, 0.88 * w, 0.88 * d
    return parts
