# SPDX-License-Identifier: Apache-2.0
"""Resizing of pictures as the training of published networks did it, without its library."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import numpy.typing as npt

from garps_core.checks import Float64Array

LANCZOS_LOBES = 3
CUBIC_STEEPNESS = -0.5
"""Slope of the cubic kernel one pixel away from its centre."""
FRACTION_BITS = 22
"""Fractional bits of the weights, which are rounded so that their sums agree on every machine."""

Bytes = npt.NDArray[np.uint8]
Index = npt.NDArray[np.intp]
Weights = npt.NDArray[np.int32]
Kernel = Callable[[Float64Array], Float64Array]


def lanczos(picture: Bytes, height: int, width: int) -> Bytes:
    """HxWxC uint8 -> height x width x C by Lanczos-3, whose support widens where the picture shrinks.

    Both sides go on their own scale, columns first; either pass is rounded and clipped to bytes.
    """
    return _resized(picture, height, width, _windowed_sinc, LANCZOS_LOBES)


def bicubic(picture: Bytes, height: int, width: int) -> Bytes:
    """Resize by the cubic kernel of Catmull and Rom."""
    return _resized(picture, height, width, _cubic, 2)


def nearest_index(size: int, wanted: int) -> Index:
    """Index of the one of `size` cells that holds the centre of each of `wanted` cells; both rows are equally long."""
    return np.asarray((2 * np.arange(wanted) + 1) * size // (2 * wanted), np.intp)


def _windowed_sinc(away: Float64Array) -> Float64Array:
    return np.asarray(np.sinc(away) * np.sinc(away / LANCZOS_LOBES), np.float64)


def _cubic(away: Float64Array) -> Float64Array:
    a, x = CUBIC_STEEPNESS, np.abs(away)
    near, far = ((a + 2) * x - (a + 3)) * x**2 + 1, a * (((x - 5) * x + 8) * x - 4)
    return np.asarray(np.where(x < 1, near, far), np.float64)


def _resized(picture: Bytes, height: int, width: int, kernel: Kernel, reach: int) -> Bytes:
    narrowed = _resized_lines(picture.swapaxes(0, 1), *_taps(picture.shape[1], width, kernel, reach)).swapaxes(0, 1)
    return np.ascontiguousarray(_resized_lines(narrowed, *_taps(len(narrowed), height, kernel, reach)))


def _resized_lines(lines: Bytes, index: Index, weights: Weights) -> Bytes:
    """The first axis to as many entries as there are of index and weights."""
    total = np.full((len(index), *lines.shape[1:]), 1 << (FRACTION_BITS - 1), np.int32)
    for tap in range(index.shape[1]):
        total += weights[:, tap, None, None] * lines[index[:, tap]]
    return np.asarray((total >> FRACTION_BITS).clip(0, 255), np.uint8)


def _taps(size: int, wanted: int, kernel: Kernel, reach: int) -> tuple[Index, Weights]:
    """Entries that each wanted entry reads, and their weights with sum 2**FRACTION_BITS; both (wanted, taps)."""
    scale = size / wanted
    stretch = max(scale, 1.0)
    centre = (np.arange(wanted) + 0.5) * scale
    first = np.floor(centre - reach * stretch).astype(np.intp)
    index = first[:, None] + np.arange(int(np.ceil(2 * reach * stretch)) + 1)
    away = (index + 0.5 - centre[:, None]) / stretch
    inside = (index >= 0) & (index < size) & (np.abs(away) < reach)
    weights = np.where(inside, kernel(away), 0.0)
    weights *= (1 << FRACTION_BITS) / weights.sum(axis=1, keepdims=True)
    return index.clip(0, size - 1), (np.sign(weights) * np.floor(np.abs(weights) + 0.5)).astype(np.int32)
