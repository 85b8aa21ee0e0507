# SPDX-License-Identifier: Apache-2.0
"""Rendered rooms as a depth network learns from them: cropped, mirrored and recoloured at random, in batches."""

from __future__ import annotations

from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt
import torch
import typer
from torch import Tensor

from bench.training.rooms import VERSION
from garps_core.models.demo_net import HEIGHT, WIDTH, demo_input

BATCH = 16
SMALLEST_CROP = 0.65
STRETCH = 0.15
"""A crop's sides are scaled apart by up to this (logarithm), as pictures of other shapes are."""
MAX_RELIEF = 0.03
"""Neighbouring depths that differ by more lie on two surfaces."""

Picture = npt.NDArray[np.uint8]


@dataclass(frozen=True, eq=False)
class Sample:
    """Input (5, 192, 256), logarithm of depth over focal length (96, 128), NaN where unknown, and that focal length."""

    seen: npt.NDArray[np.float32]
    wanted: npt.NDArray[np.float32]
    focal: float


class Pictures:
    """All pictures of a folder of rooms, in memory."""

    def __init__(self, folder: Path, seeds: range) -> None:
        paths = [path for seed in seeds if (path := folder / f"room{seed}_v{VERSION}.npz").is_file()]
        if not paths:
            raise typer.BadParameter(
                f"no rooms of seeds {seeds} in {folder}: run python -m bench.training.rooms --out {folder}"
            )
        first = _arrays(paths[0])
        self.rgb, self.depth, self.K = (np.empty((len(paths), *one.shape), one.dtype) for one in first)
        for i, path in enumerate(paths):
            self.rgb[i], self.depth[i], self.K[i] = _arrays(path)
        self.rgb, self.depth, self.K = (all_.reshape(-1, *all_.shape[2:]) for all_ in (self.rgb, self.depth, self.K))
        self.rooms = len(paths)

    def __len__(self) -> int:
        return len(self.rgb)

    def whole(self, index: int) -> Sample:
        """A picture as it is."""
        return _sample(self.rgb[index], self.depth[index], self.K[index])

    def drawn(self, index: int, rng: np.random.Generator) -> Sample:
        """A picture, changed at random."""
        rgb, depth, K = self.rgb[index], self.depth[index], self.K[index].copy()
        if rng.random() < 0.5:
            rgb, depth = rgb[:, ::-1], depth[:, ::-1]
            K[0, 2] = rgb.shape[1] - 1 - K[0, 2]
        size = rng.uniform(SMALLEST_CROP, 1.0) * np.exp(rng.uniform(-STRETCH, STRETCH, 2))
        rows, columns = (int(side * min(part, 1.0)) for side, part in zip(rgb.shape[:2], size, strict=True))
        top, left = (
            int(rng.integers(whole - part + 1)) for whole, part in zip(rgb.shape[:2], (rows, columns), strict=True)
        )
        K[:2, 2] -= left, top
        part = slice(top, top + rows), slice(left, left + columns)
        return _sample(recoloured(rgb[part], rng), depth[part], K)


def _arrays(path: Path) -> tuple[npt.NDArray[Any], ...]:
    with np.load(path, allow_pickle=False) as file:
        return tuple(file[name] for name in ("rgb", "depth", "K"))


def recoloured(rgb: Picture, rng: np.random.Generator) -> Picture:
    """Another exposure, contrast, white balance and a little noise."""
    curve = (np.arange(256) / 255) ** np.exp(rng.normal(0, 0.2))
    gains = np.exp(rng.normal(0, 0.15) + rng.normal(0, 0.05, 3))
    x = cv2.LUT(rgb, (curve[:, None] * gains).astype(np.float32)[None])
    if rng.random() < 0.3:
        x = cv2.GaussianBlur(x, (0, 0), float(rng.uniform(0.4, 1.2)))
    x = x + np.float32(rng.uniform(0, 0.02)) * rng.standard_normal(x.shape, np.float32)
    return np.clip(np.rint(255 * x), 0, 255).astype(np.uint8)


def _sample(rgb: Picture, depth_mm: npt.NDArray[np.uint16], K: npt.NDArray[np.float64]) -> Sample:
    seen, focal = demo_input(np.ascontiguousarray(rgb), K)
    return Sample(seen, np.log(shrunk(depth_mm) / np.float32(focal)), focal)


def shrunk(depth_mm: npt.NDArray[np.uint16]) -> npt.NDArray[np.float32]:
    """Depth in the size of the network's answer, m, NaN where unknown.

    Inverse depth, linear in the pixel on a plane, is interpolated; at edges the nearest pixel is taken.
    """
    size = WIDTH // 2, HEIGHT // 2
    with np.errstate(divide="ignore"):
        inverse = np.where(depth_mm > 0, np.float32(1000) / depth_mm, np.float32(np.nan))
    nearest = cv2.resize(inverse, size, interpolation=cv2.INTER_NEAREST_EXACT)
    between = cv2.resize(inverse, size, interpolation=cv2.INTER_LINEAR)
    on_a_surface = np.abs(between - nearest) < MAX_RELIEF * nearest
    return np.asarray(1 / np.where(on_a_surface, between, nearest), np.float32)


def batches(pictures: Pictures, first: int, steps: int, seed: int) -> Iterator[tuple[Tensor, Tensor]]:
    """Inputs and wanted outputs of every step from `first` on, drawn one step ahead in another thread."""

    def drawn(step: int) -> tuple[Tensor, Tensor]:
        rng = np.random.default_rng([seed, step])
        samples = [pictures.drawn(int(i), rng) for i in rng.integers(len(pictures), size=BATCH)]
        return (
            torch.from_numpy(np.stack([one.seen for one in samples])),
            torch.from_numpy(np.stack([one.wanted for one in samples])),
        )

    with ThreadPoolExecutor(1) as pool:
        ahead = pool.submit(drawn, first)
        for step in range(first, steps):
            ready, ahead = ahead.result(), pool.submit(drawn, step + 1)
            yield ready
