# SPDX-License-Identifier: Apache-2.0
"""MASt3R and DUSt3R as two-view models: pictures -> framed inputs -> point maps in both orders."""

from __future__ import annotations

import hashlib
import threading
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TypeVar

import numpy as np
import torch
from torch import Tensor

from garps_core.checks import Float32Array
from garps_core.errors import ConfigError, InputError, ModelError
from garps_core.models.depth_anything import DTYPES, checked_image
from garps_core.models.dpt import Grid
from garps_core.models.resampling import bicubic, lanczos
from garps_core.models.two_view import TwoView
from garps_core.models.two_view_heads import PATCH, ViewMaps
from garps_core.point_maps import Framing, PairMaps, Picture, PointMap

LONG_SIDE = 512
"""Pixels of the longer side of a resized picture."""
SQUARE_SIDE = {"linear-224": 224}
"""Side, in pixels, of the square that a variant sees (`manifest.Weights.variant`); the others see most of a picture."""
MOST_ELONGATED = 8
"""Largest ratio of a picture's sides."""
KEPT = 4
"""Pictures whose encoding is kept, for the next pairs that they are part of."""

Part = TypeVar("Part")
Found = TypeVar("Found")


def cropped_input(rgb: Picture, long_side: int = LONG_SIDE) -> tuple[Tensor, Framing]:
    """HxWx3 uint8 RGB -> the network's input (3, h, w), float32 in -1..1, and which part of the picture it is.

    The middle of the resized picture, h and w multiples of 16; of a square picture three quarters of the height.
    Raises InputError for a picture smaller than a patch, or more elongated than 8 to 1.
    """
    resized = _resized(rgb, long_side)
    rows, columns = resized.shape[:2]
    if rows == columns:
        rows = 3 * rows // 4
    return _cut(rgb, resized, (rows // PATCH * PATCH, columns // PATCH * PATCH))


def square_input(rgb: Picture, side: int) -> tuple[Tensor, Framing]:
    """The input of a network that sees the middle square, side x side pixels."""
    height, width = rgb.shape[:2]
    resized = _resized(rgb, round(side * max(height, width) / max(min(height, width), 1)))
    return _cut(rgb, resized, (side, side))


def _resized(rgb: Picture, long_side: int) -> Picture:
    height, width = rgb.shape[:2]
    longest, shortest = max(height, width), min(height, width)
    if shortest < PATCH or longest > MOST_ELONGATED * shortest:
        raise InputError(
            f"image of {width}x{height} pixels: expected at least {PATCH}x{PATCH}, and at most {MOST_ELONGATED} to 1. "
            "Crop the image"
        )
    rows, columns = (round(side * long_side / longest) for side in (height, width))
    return (lanczos if longest > long_side else bicubic)(rgb, rows, columns)


def _cut(rgb: Picture, resized: Picture, size: Grid) -> tuple[Tensor, Framing]:
    """The middle of a resized picture, as the network's input."""
    (height, width), (whole_rows, whole_columns), (rows, columns) = rgb.shape[:2], resized.shape[:2], size
    top, left = whole_rows // 2 - rows // 2, whole_columns // 2 - columns // 2
    seen = resized[top : top + rows, left : left + columns].transpose(2, 0, 1)
    framing = Framing((whole_columns / width, whole_rows / height), (left, top), size)
    return torch.from_numpy(np.ascontiguousarray((seen / 255 - 0.5) / 0.5, np.float32)), framing


@dataclass(frozen=True, eq=False)
class _Encoded:
    """One picture: tokens (1, N, D), and what the network sees of it."""

    tokens: Tensor
    framing: Framing

    @property
    def grid(self) -> Grid:
        rows, columns = self.framing.size
        return rows // PATCH, columns // PATCH


class NaverModel:
    """A `TwoViewModel`: every picture is encoded once, and both orders are decoded.

    Both pictures and both orders share one pass where possible, which changes results by rounding only. Threads take
    turns.

    Args:
        network: of any device; it may be moved between calls.
        variant: as in `manifest.Weights.variant`; "linear-224" sees a small square.
        dtype: of the layers that autocast may compute in less than float32; the heads never do.
        long_side: pixels of a resized picture's longer side; the networks are trained for 512.
    """

    def __init__(
        self, network: TwoView, variant: str = "", dtype: torch.dtype = torch.float32, long_side: int = LONG_SIDE
    ) -> None:
        if dtype not in DTYPES:
            raise ConfigError(f"dtype {dtype}: expected one of {', '.join(sorted(map(str, DTYPES)))}")
        self.network = network
        self.dtype = dtype
        self.metric = network.architecture.descriptors > 0
        self.origin = "mast3r" if self.metric else "dust3r"
        self._square_side = SQUARE_SIDE.get(variant)
        self._long_side = long_side
        self._kept: dict[tuple[bytes, torch.device], _Encoded] = {}
        self._turn = threading.Lock()

    def __call__(self, source: Picture, target: Picture) -> PairMaps:
        """See `TwoViewModel`."""
        pictures = checked_image(source), checked_image(target)
        device = self._device
        with (
            self._turn,
            torch.inference_mode(),
            torch.autocast(device.type, self.dtype, enabled=self.dtype != torch.float32),
        ):
            one, two = self._encoded(pictures)
            alike = one.framing.size == two.framing.size
            source_first, target_first = self._each(self._decode, [(one, two), (two, one)], alike)
        return PairMaps(source_first, target_first, (one.framing, two.framing), self.metric, self.origin)

    @property
    def _device(self) -> torch.device:
        return next(self.network.parameters()).device

    def _encoded(self, pictures: Sequence[Picture]) -> list[_Encoded]:
        """Encode both pictures; the network runs on those that are not kept from before."""
        keys = [(digest(picture), self._device) for picture in pictures]
        new = {key: self._input(rgb) for key, rgb in zip(keys, pictures, strict=True) if key not in self._kept}
        inputs = [seen for seen, _ in new.values()]
        tokens = self._each(self._encode, inputs, alike=len({seen.shape for seen in inputs}) == 1)
        known = self._kept | {
            key: _Encoded(found, framing) for (key, (_, framing)), found in zip(new.items(), tokens, strict=True)
        }
        others = [(key, found) for key, found in known.items() if key not in keys]
        self._kept = dict([*others, *((key, known[key]) for key in keys)][-KEPT:])
        return [known[key] for key in keys]

    def _input(self, rgb: Picture) -> tuple[Tensor, Framing]:
        return (
            cropped_input(rgb, self._long_side) if self._square_side is None else square_input(rgb, self._square_side)
        )

    def _encode(self, inputs: list[Tensor]) -> list[Tensor]:
        """Tokens (1, N, D) of each input (3, h, w), all of one size."""
        tokens = self.network.encode(torch.stack(inputs).to(self._device))
        return [tokens[i : i + 1] for i in range(len(tokens))]

    def _decode(self, orders: list[tuple[_Encoded, _Encoded]]) -> list[tuple[PointMap, PointMap]]:
        """Decode both views of each order; the first views have one size, the second ones too."""
        first, second = (torch.cat([order[i].tokens for order in orders]) for i in (0, 1))
        seen = self.network.decode(first, orders[0][0].grid, second, orders[0][1].grid)
        one, two = (self._point_maps(maps) for maps in seen)
        return list(zip(one, two, strict=True))

    def _point_maps(self, maps: ViewMaps) -> list[PointMap]:
        """Point maps, one per view of the batch. Raises ModelError for values that are not finite."""
        parts = [part for part in (maps.points, maps.confidence, maps.descriptors) if part is not None]
        if not all(bool(part.isfinite().all()) for part in parts):
            raise ModelError(
                f"the network returned NaN or infinity in {self.dtype}: expected points. Are the weights damaged, or "
                "is float32 needed?"
            )
        return [PointMap(*views) for views in zip(*map(_arrays, parts), strict=True)]

    def _each(self, run: Callable[[list[Part]], list[Found]], parts: list[Part], alike: bool) -> list[Found]:
        """All parts at once where they are alike, or one by one; also where memory suffices for one only."""
        together = [parts] if alike else [[part] for part in parts]
        try:
            return [found for some in together for found in run(some)]
        except torch.cuda.OutOfMemoryError:
            torch.cuda.empty_cache()
        try:
            return [found for part in parts for found in run([part])]
        except torch.cuda.OutOfMemoryError as error:
            raise ModelError(
                f"out of memory on {self._device} with one pair of pictures: expected it to fit. Free memory, choose "
                f"float16, or run on the CPU ({error})"
            ) from None


def digest(picture: Picture) -> bytes:
    """Key of a picture in the cache; two pictures share it only if they are equal."""
    return hashlib.blake2b(np.ascontiguousarray(picture).data, key=str(picture.shape).encode()).digest()


def _arrays(batch: Tensor) -> list[Float32Array]:
    return [np.ascontiguousarray(one) for one in batch.cpu().numpy()]
