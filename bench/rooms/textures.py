# SPDX-License-Identifier: Apache-2.0
"""Procedural surface textures as canvases of known size in metres, with mip levels.

A canvas is drawn as float sRGB 0..1 and then pulled towards its mean colour by `Paint.strength`: 1 keeps it rich,
0 leaves a surface that is almost plain. Drawing consumes the same random numbers whatever the strength, so the
room's shape does not depend on it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt

Image = npt.NDArray[np.float32]
ByteImage = npt.NDArray[np.uint8]
Colour = Sequence[float] | npt.NDArray[np.floating[Any]]

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
    quarter = (max(height // 4, 1), max(width // 4, 1))
    coarse, fine, weight = np.zeros(quarter, np.float32), np.zeros(shape, np.float32), 0.0
    for octave in range(octaves):
        rows = min(max(round(height / cell[0] * 2**octave), 1), height)
        cols = min(max(round(width / cell[1] * 2**octave), 1), width)
        lattice = rng.uniform(-1, 1, (rows, cols)).astype(np.float32)
        if min(height / rows, width / cols) > 16:  # smooth enough to be drawn small and enlarged
            coarse += gain**octave * _stretch(lattice, quarter, cv2.INTER_CUBIC)
        else:
            smooth = max(height / rows, width / cols) > 5
            fine += gain**octave * _stretch(lattice, shape, cv2.INTER_CUBIC if smooth else cv2.INTER_LINEAR)
        weight += gain ** (2 * octave)
    if coarse.any():
        fine += cv2.resize(coarse, (width, height), interpolation=cv2.INTER_LINEAR)
    return (fine * np.float32(1 / np.sqrt(weight))).astype(np.float32)


def _stretch(lattice: Image, shape: tuple[int, int], kernel: int) -> Image:
    """Resize a repeating lattice."""
    height, width = shape
    padded = np.pad(lattice, 2, mode="wrap")
    rows, cols = lattice.shape
    M = np.array([[cols / width, 0, 1.5 + 0.5 * cols / width], [0, rows / height, 1.5 + 0.5 * rows / height]])
    flags = kernel | cv2.WARP_INVERSE_MAP
    return np.asarray(cv2.warpAffine(padded, M, (width, height), flags=flags, borderMode=cv2.BORDER_REPLICATE))


def tint(colour: Colour, brightness: npt.NDArray[np.floating[Any]], warmth: Image | float = 0.0) -> Image:
    """Base colour times (1 + brightness), shifted a little between blue and red by `warmth`."""
    base = np.asarray(colour, np.float32)
    lit = (base * (1 + brightness[..., None])).astype(np.float32)
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
