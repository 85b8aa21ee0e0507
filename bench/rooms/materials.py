# SPDX-License-Identifier: Apache-2.0
"""Materials: plaster, wallpaper, bricks, wood, tiles, carpet and cloth.

All take the random stream, the canvas as (height, width) in texels, the size of a texel in metres and a base
colour, and return an HxWx3 float sRGB canvas.
"""

from __future__ import annotations

import cv2
import numpy as np
import numpy.typing as npt

from bench.rooms.textures import CLOTHS, VIVID, Colour, Image, noise, pick, tint


def plaster(rng: np.random.Generator, shape: tuple[int, int], texel_m: float, colour: Colour) -> Image:
    """Painted wall: cloudy, with roller grain, scuffs and small dents."""
    cloud = noise(rng, shape, (0.9 / texel_m, 0.9 / texel_m), 3)
    grain = noise(rng, shape, (0.06 / texel_m, 0.06 / texel_m), 4, 0.8)
    image = tint(colour, 0.02 * cloud + 0.07 * grain, 0.01 * cloud)
    _speckle(rng, image, texel_m, density=30, size_m=(0.006, 0.03), depth=0.22)
    return image


def _speckle(
    rng: np.random.Generator, image: Image, texel_m: float, density: float, size_m: tuple[float, float], depth: float
) -> None:
    """Scatter `density` soft-edged marks per square metre, darker or lighter by up to `depth`."""
    height, width = image.shape[:2]
    layer = np.zeros((height, width), np.float32)
    for _ in range(int(density * height * width * texel_m**2)):
        centre = (int(rng.integers(width)), int(rng.integers(height)))
        axes = (max(int(rng.uniform(*size_m) / texel_m), 1), max(int(rng.uniform(*size_m) / texel_m / 2), 1))
        cv2.ellipse(layer, centre, axes, float(rng.uniform(0, 180)), 0, 360, float(rng.uniform(-1, 0.5)), -1)
    image *= 1 + depth * cv2.GaussianBlur(layer, (0, 0), 0.8)[..., None]


def wallpaper(rng: np.random.Generator, shape: tuple[int, int], texel_m: float, colour: Colour) -> Image:
    """Repeating printed motif over plaster, each print a little different in strength."""
    image = plaster(rng, shape, texel_m, colour)
    height, width = shape
    step = int(rng.uniform(0.16, 0.26) / texel_m)
    motif = _motif(rng, step)
    fade = 0.6 + 0.4 * noise(rng, shape, (0.35 / texel_m, 0.35 / texel_m), 3)
    rows, cols = height // step + 2, width // step + 2
    sheet = np.concatenate([np.roll(np.tile(motif, (1, cols)), (r % 2) * step // 2, axis=1) for r in range(rows)])
    ink = np.asarray(pick(rng, CLOTHS), np.float32)
    alpha = (0.42 * np.clip(fade, 0.1, 1) * sheet[:height, :width])[..., None]
    return np.asarray(image * (1 - alpha) + ink * alpha, np.float32)


def _motif(rng: np.random.Generator, size: int) -> Image:
    """Mirror-symmetric blossom of a few ellipses, HxW 0..1."""
    motif = np.zeros((size, size), np.float32)
    for _ in range(int(rng.integers(4, 8))):
        centre = (int(rng.uniform(0.5, 0.8) * size), int(rng.uniform(0.15, 0.85) * size))
        axes = (max(int(rng.uniform(0.02, 0.12) * size), 1), max(int(rng.uniform(0.04, 0.2) * size), 1))
        cv2.ellipse(motif, centre, axes, float(rng.uniform(0, 180)), 0, 360, float(rng.uniform(0.5, 1)), -1)
    return np.maximum(cv2.GaussianBlur(motif, (0, 0), 0.7), cv2.GaussianBlur(motif[:, ::-1], (0, 0), 0.7))


def bricks(rng: np.random.Generator, shape: tuple[int, int], texel_m: float, colour: Colour) -> Image:
    """Bond of bricks, each with its own tone, in lighter mortar."""
    tone = tint(colour, 0.20 * noise(rng, shape, (0.05 / texel_m, 0.08 / texel_m), 4, 0.7))
    mortar = tint((0.70, 0.68, 0.64), 0.12 * noise(rng, shape, (0.02 / texel_m, 0.02 / texel_m), 3, 0.8))
    return _courses(rng, tone, mortar, (0.24 / texel_m, 0.075 / texel_m), max(0.010 / texel_m, 1.5), 0.16)


def _courses(
    rng: np.random.Generator, tone: Image, joint: Image, unit: tuple[float, float], gap: float, spread: float
) -> Image:
    """Cut `tone` into staggered units of (width, height) texels with `gap` texels of `joint` between them."""
    height, width = tone.shape[:2]
    rows = max(round(height / unit[1]), 1)
    cols = max(round(width / unit[0]), 1)
    y = np.arange(height, dtype=np.float32)[:, None] * rows / height
    row = y.astype(np.int64)
    shift = rng.uniform(0, 1, rows).astype(np.float32)[row] if unit[0] > 3 * unit[1] else 0.5 * (row % 2)
    x = (np.arange(width, dtype=np.float32)[None, :] * cols / width + shift) % cols
    own = 1 + rng.normal(0, spread, (rows, cols, 1)).astype(np.float32) + rng.normal(0, 0.02, (rows, cols, 3))
    image = tone * own.astype(np.float32)[row, x.astype(np.int64)]
    edge_x = np.minimum(x % 1, 1 - x % 1) * unit[0]
    edge_y = np.minimum(y % 1, 1 - y % 1) * unit[1]
    alpha = np.clip(np.minimum(edge_x, edge_y) - gap / 2 + 0.5, 0, 1).astype(np.float32)[..., None]
    return np.asarray(image * alpha + joint * (1 - alpha), np.float32)


def wood(rng: np.random.Generator, shape: tuple[int, int], texel_m: float, colour: Colour) -> Image:
    """Grain along u: growth rings bent by noise, pores and a knot here and there."""
    height, width = shape
    bend = noise(rng, shape, (0.15 / texel_m, 0.7 / texel_m), 3)
    pores = noise(rng, shape, (0.006 / texel_m, 0.12 / texel_m), 3, 0.7)
    v = np.arange(height, dtype=np.float32)[:, None]
    periods = max(round(height * texel_m / 0.028), 1)
    phase = 2 * np.pi * periods * v / height + 5 * bend
    u = np.arange(width, dtype=np.float32)[None, :]
    for _ in range(max(int(1.5 * height * width * texel_m**2), 1)):
        cx, cy = rng.uniform(0, width), rng.uniform(0, height)
        r2 = ((u - cx) * texel_m / 0.05) ** 2 + ((v - cy) * texel_m / 0.018) ** 2
        phase = phase + 7 * np.exp(-r2)
        pores -= (1.2 * np.exp(-2.5 * r2)).astype(np.float32)
    rings = np.sin(phase + 0.6 * np.sin(2 * phase))
    return tint(colour, ((0.045 + 0.03 * bend) * rings + 0.15 * pores + 0.06 * bend).astype(np.float32), 0.02 * bend)


def planks(rng: np.random.Generator, shape: tuple[int, int], texel_m: float, colour: Colour) -> Image:
    """Wooden floor boards."""
    tone = wood(rng, shape, texel_m, colour)
    joint = np.broadcast_to(0.35 * np.asarray(colour, np.float32), tone.shape)
    unit = (float(rng.uniform(0.9, 1.4)) / texel_m, float(rng.uniform(0.10, 0.16)) / texel_m)
    return _courses(rng, tone, joint.astype(np.float32), unit, max(0.003 / texel_m, 1.0), 0.11)


def tiles(rng: np.random.Generator, shape: tuple[int, int], texel_m: float, colour: Colour) -> Image:
    """Stone floor tiles with veins and grout."""
    cloud = noise(rng, shape, (0.5 / texel_m, 0.5 / texel_m), 5)
    veins = np.exp(-40 * np.abs(noise(rng, shape, (0.35 / texel_m, 0.35 / texel_m), 5) * 0.5))
    grain = noise(rng, shape, (0.015 / texel_m, 0.015 / texel_m), 2, 0.8)
    tone = tint(colour, (0.09 * cloud - 0.38 * veins + 0.10 * grain).astype(np.float32), 0.03 * cloud)
    grout = tint((0.45, 0.43, 0.40), 0.08 * grain)
    side = float(rng.uniform(0.28, 0.42)) / texel_m
    return _courses(rng, tone, grout, (side, side), max(0.006 / texel_m, 1.2), 0.07)


def carpet(rng: np.random.Generator, shape: tuple[int, int], texel_m: float, colour: Colour) -> Image:
    """Short pile, worn here and there."""
    pile = noise(rng, shape, (0.03 / texel_m, 0.03 / texel_m), 3, 0.9)
    worn = noise(rng, shape, (0.6 / texel_m, 0.6 / texel_m), 3)
    return tint(colour, 0.22 * pile + 0.08 * worn, 0.02 * worn)


def fabric(rng: np.random.Generator, shape: tuple[int, int], texel_m: float, colour: Colour) -> Image:
    """Woven cloth: plain, striped or checked, always with slubs and folds."""
    fine, coarse = 0.004 / texel_m, 0.05 / texel_m
    slub = noise(rng, shape, (fine, coarse), 2) + noise(rng, shape, (coarse, fine), 2)
    fold = noise(rng, shape, (0.25 / texel_m, 0.25 / texel_m), 3)
    image = tint(colour, 0.15 * slub + 0.09 * fold)
    kind = int(rng.integers(4))
    other = np.asarray(pick(rng, VIVID), np.float32)
    bands = [_bands(rng, n, texel_m) for n in shape]
    if kind == 1:
        image = _mix(image, other, 0.6 * bands[1][None, :] * np.ones((shape[0], 1), np.float32))
    elif kind == 2:
        image = _mix(image, other, 0.35 * bands[1][None, :] + 0.35 * bands[0][:, None])
    elif kind == 3:
        blot = noise(rng, shape, (0.09 / texel_m, 0.09 / texel_m), 2)
        image = _mix(image, other, 0.6 * np.clip(6 * (blot - 0.35), 0, 1))
    return image


def _mix(image: Image, colour: npt.NDArray[np.float32], alpha: Image) -> Image:
    a = alpha[..., None].astype(np.float32)
    return np.asarray(image * (1 - a) + colour * (0.85 + 0.3 * image.mean(axis=2, keepdims=True)) * a, np.float32)


def _bands(rng: np.random.Generator, n: int, texel_m: float) -> npt.NDArray[np.float32]:
    """Stripes along one direction, N values 0..1, of uneven width."""
    out = np.zeros(n, np.float32)
    at = 0
    while at < n:
        width, pause = (max(int(rng.uniform(*r) / texel_m), 1) for r in ((0.006, 0.05), (0.02, 0.12)))
        out[at : at + width] = rng.uniform(0.5, 1)
        at += width + pause
    return out
