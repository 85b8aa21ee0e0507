# SPDX-License-Identifier: Apache-2.0
"""Resizing of pictures as the training of published networks did it, without its library."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from garps_core.checks import Float64Array

LANCZOS_LOBES = 3

Index = npt.NDArray[np.intp]


def lanczos(picture: npt.NDArray[np.uint8], height: int, width: int) -> npt.NDArray[np.uint8]:
    """HxWxC uint8 -> height x width x C by Lanczos-3, whose support widens where the picture shrinks.

    Both sides go on their own scale, columns first; either pass is rounded and clipped to bytes.
    """
    narrowed = _resized_lines(picture.swapaxes(0, 1), width).swapaxes(0, 1)
    return np.ascontiguousarray(_resized_lines(narrowed, height))


def nearest_index(size: int, wanted: int) -> Index:
    """Which of `size` cells holds the centre of each of `wanted` cells of the same length in all."""
    return np.asarray((2 * np.arange(wanted) + 1) * size // (2 * wanted), np.intp)


def _resized_lines(lines: npt.NDArray[np.uint8], wanted: int) -> npt.NDArray[np.uint8]:
    """The first axis to `wanted` entries."""
    index, weights = _taps(len(lines), wanted)
    total = np.zeros((wanted, *lines.shape[1:]))
    for tap in range(index.shape[1]):
        total += weights[:, tap, None, None] * lines[index[:, tap]]
    return np.clip(np.floor(total + 0.5), 0, 255).astype(np.uint8)


def _taps(size: int, wanted: int) -> tuple[Index, Float64Array]:
    """For every wanted entry the entries it reads, and their weights with sum 1; both (wanted, taps)."""
    scale = size / wanted
    stretch = max(scale, 1.0)
    reach = LANCZOS_LOBES * stretch
    centre = (np.arange(wanted) + 0.5) * scale
    first = np.floor(centre - reach).astype(np.intp)
    index = first[:, None] + np.arange(int(np.ceil(2 * reach)) + 1)
    away = (index + 0.5 - centre[:, None]) / stretch
    inside = (index >= 0) & (index < size) & (np.abs(away) < LANCZOS_LOBES)
    weights = np.where(inside, np.sinc(away) * np.sinc(away / LANCZOS_LOBES), 0.0)
    return index.clip(0, size - 1), weights / weights.sum(axis=1, keepdims=True)
