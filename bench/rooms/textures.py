# SPDX-License-Identifier: Apache-2.0
"""Procedural surface textures as canvases of known size in metres, with mip levels.

A canvas is drawn as float sRGB 0..1 and then pulled towards its mean colour by `Paint.strength`: 1 keeps it rich,
0 leaves a surface that is almost plain. Drawing consumes the same random numbers whatever the strength, so the
room's shape does not depend on it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
import numpy.typing as npt

Image = npt.NDArray[np.float32]
ByteImage = npt.NDArray[np.uint8]
Colour = Sequence[float]

MIP_LEVELS = 5
PLAIN_CONTRAST = 0.02  # what is left of a texture at strength 0

WOODS = ((0.62, 0.44, 0.27), (0.45, 0.29, 0.17), (0.75, 0.59, 0.41), (0.33, 0.22, 0.15), (0.80, 0.70, 0.56))
WALLS = ((0.86, 0.83, 0.77), (0.80, 0.84, 0.84), (0.88, 0.85, 0.80), (0.72, 0.78, 0.73), (0.83, 0.75, 0.68))
CLOTHS = (
    (0.36, 0.42, 0.50), (0.55, 0.35, 0.28), (0.42, 0.47, 0.36), (0.62, 0.56, 0.47), (0.28, 0.31, 0.36),
    (0.66, 0.47, 0.25), (0.50, 0.28, 0.32),
)  # fmt: skip
VIVID = (
    (0.70, 0.20, 0.17), (0.16, 0.32, 0.55), (0.20, 0.42, 0.28), (0.85, 0.62, 0.20), (0.45, 0.20, 0.36),
    (0.90, 0.86, 0.76), (0.13, 0.14, 0.17), (0.80, 0.45, 0.25), (0.35, 0.60, 0.63), (0.60, 0.60, 0.58),
)  # fmt: skip


@dataclass(frozen=True, eq=False)
class Texture:
    """A canvas that repeats in both directions.

    Args:
        levels: sRGB HxWx3 uint8, each half the size of the one before.
        size_m: (width, height) of the canvas in metres.
        glow: radiance it gives off by itself, relative to a white surface in full light.
    """

    levels: tuple[ByteImage, ...]
    size_m: tuple[float, float]
    glow: float = 0.0

    @property
    def texel_m(self) -> float:
        """Edge length of one texel of the finest level, m."""
        return self.size_m[0] / self.levels[0].shape[1]

    def sample(self, uv: npt.NDArray[np.float32], level: int) -> ByteImage:
        """Bilinear sRGB Nx3 uint8 at Nx2 metres on one mip level."""
        image = self.levels[level]
        height, width = image.shape[:2]
        columns = 1024
        count = -(-len(uv) // columns) * columns
        xy = np.zeros((count, 2), np.float32)
        for axis, (size, pixels) in enumerate(zip(self.size_m, (width, height), strict=True)):
            t = uv[:, axis] * np.float32(1 / size)
            xy[: len(uv), axis] = (t - np.floor(t)) * np.float32(pixels) - np.float32(0.5)
        out = cv2.remap(image, xy.reshape(-1, columns, 2), None, cv2.INTER_LINEAR, borderMode=cv2.BORDER_WRAP)
        return np.asarray(out.reshape(-1, 3)[: len(uv)], np.uint8)


def make_texture(canvas: Image, texel_m: float, strength: float, glow: float = 0.0) -> Texture:
    """Fade a float sRGB canvas towards its mean and build its mip levels."""
    contrast = PLAIN_CONTRAST + (1 - PLAIN_CONTRAST) * strength
    mean = canvas.mean(axis=(0, 1), keepdims=True)
    faded = np.clip(mean + contrast * (canvas - mean), 0, 1)
    level = np.round(faded * 255).astype(np.uint8)
    levels = [level]
    while len(levels) < MIP_LEVELS and min(level.shape[:2]) >= 4:
        half = (max(level.shape[1] // 2, 1), max(level.shape[0] // 2, 1))
        level = cv2.resize(level, half, interpolation=cv2.INTER_AREA)
        levels.append(level)
    height, width = canvas.shape[:2]
    return Texture(tuple(levels), (width * texel_m, height * texel_m), glow)


def noise(
    rng: np.random.Generator, shape: tuple[int, int], cell: tuple[float, float], octaves: int = 4, gain: float = 0.55
) -> Image:
    """Value noise that repeats at the borders, about -1..1.

    Args:
        rng: source of the lattice values.
        shape: (height, width) in texels.
        cell: (vertical, horizontal) size in texels of the coarsest lattice; halved per octave.
        octaves: how many lattices are summed.
        gain: amplitude ratio between an octave and the one before.
    """
    height, width = shape
    total, weight = np.zeros(shape, np.float32), 0.0
    for octave in range(octaves):
        rows = max(round(height / cell[0] * 2**octave), 1)
        cols = max(round(width / cell[1] * 2**octave), 1)
        if rows > height or cols > width:
            rows, cols = min(rows, height), min(cols, width)
        lattice = rng.uniform(-1, 1, (rows, cols)).astype(np.float32)
        smooth = max(height / rows, width / cols) > 5
        total += gain**octave * _stretch(lattice, shape, cv2.INTER_CUBIC if smooth else cv2.INTER_LINEAR)
        weight += gain ** (2 * octave)
    return (total / np.float32(np.sqrt(weight))).astype(np.float32)


def _stretch(lattice: Image, shape: tuple[int, int], kernel: int) -> Image:
    """Resize a repeating lattice."""
    height, width = shape
    padded = np.pad(lattice, 2, mode="wrap")
    rows, cols = lattice.shape
    M = np.array([[cols / width, 0, 1.5 + 0.5 * cols / width], [0, rows / height, 1.5 + 0.5 * rows / height]])
    flags = kernel | cv2.WARP_INVERSE_MAP
    return np.asarray(cv2.warpAffine(padded, M, (width, height), flags=flags, borderMode=cv2.BORDER_REPLICATE))


def tint(colour: Colour, brightness: Image, warmth: Image | float = 0.0) -> Image:
    """Base colour times (1 + brightness), shifted a little between blue and red by `warmth`."""
    base = np.asarray(colour, np.float32)
    lit = base * (1 + brightness[..., None])
    lit[..., 0] += 0.5 * warmth
    lit[..., 2] -= 0.5 * warmth
    return np.asarray(lit, np.float32)


def pick(rng: np.random.Generator, colours: Sequence[Colour], spread: float = 0.04) -> Colour:
    """One of the colours, varied a little."""
    base = np.asarray(colours[int(rng.integers(len(colours)))])
    return tuple(np.clip(base + rng.normal(0, spread, 3) * 0.5 + rng.normal(0, spread), 0.03, 0.95))


def texels(size_m: Sequence[float], texel_m: float) -> tuple[int, int]:
    """(height, width) in texels of a (width, height) in metres."""
    return max(round(size_m[1] / texel_m), 8), max(round(size_m[0] / texel_m), 8)


def plaster(rng: np.random.Generator, shape: tuple[int, int], texel_m: float, colour: Colour) -> Image:
    """Painted wall: cloudy, with roller grain, scuffs and small dents."""
    cloud = noise(rng, shape, (0.9 / texel_m, 0.9 / texel_m), 3)
    grain = noise(rng, shape, (0.06 / texel_m, 0.06 / texel_m), 4, 0.8)
    image = tint(colour, 0.025 * cloud + 0.06 * grain, 0.01 * cloud)
    _speckle(rng, image, texel_m, density=14, size_m=(0.006, 0.03), depth=0.22)
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
        pores = pores - 1.2 * np.exp(-2.5 * r2)
    rings = np.sin(phase + 0.6 * np.sin(2 * phase))
    return tint(colour, ((0.045 + 0.03 * bend) * rings + 0.11 * pores + 0.06 * bend).astype(np.float32), 0.02 * bend)


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
    tone = tint(colour, (0.09 * cloud - 0.30 * veins + 0.05 * grain).astype(np.float32), 0.03 * cloud)
    grout = tint((0.45, 0.43, 0.40), 0.08 * grain)
    side = float(rng.uniform(0.28, 0.42)) / texel_m
    return _courses(rng, tone, grout, (side, side), max(0.006 / texel_m, 1.2), 0.07)


def carpet(rng: np.random.Generator, shape: tuple[int, int], texel_m: float, colour: Colour) -> Image:
    """Short pile, worn here and there."""
    pile = noise(rng, shape, (0.03 / texel_m, 0.03 / texel_m), 3, 0.9)
    worn = noise(rng, shape, (0.6 / texel_m, 0.6 / texel_m), 3)
    return tint(colour, 0.16 * pile + 0.08 * worn, 0.02 * worn)


def fabric(rng: np.random.Generator, shape: tuple[int, int], texel_m: float, colour: Colour) -> Image:
    """Woven cloth: plain, striped or checked, always with slubs and folds."""
    slub = noise(rng, shape, (0.004 / texel_m, 0.05 / texel_m), 2) + noise(rng, shape, (0.05 / texel_m, 0.004 / texel_m), 2)
    fold = noise(rng, shape, (0.25 / texel_m, 0.25 / texel_m), 3)
    image = tint(colour, 0.11 * slub + 0.09 * fold)
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
