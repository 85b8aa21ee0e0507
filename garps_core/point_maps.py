# SPDX-License-Identifier: Apache-2.0
"""Point maps of a pair by a two-view network: a 3D point for every pixel of both pictures, in one camera's frame.

MASt3R and DUSt3R give them, and a newer network of this family fits in (`docs/two_view_models.md`).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import cv2
import numpy as np
import numpy.typing as npt

from garps_core.checks import Float32Array, Float64Array
from garps_core.errors import ConfigError, ModelError
from garps_core.geometry import Array
from garps_core.types import View

Picture = npt.NDArray[np.uint8]
Bool = npt.NDArray[np.bool_]


@dataclass(frozen=True, eq=False)
class PointMap:
    """The points that the pixels of one picture see.

    Args:
        points: hxwx3 float32, x right, y down, z forward in the frame of the order's first camera; metres if the
            network is metric; NaN = unknown.
        confidence: hxw float32, on the network's own scale; larger is surer.
        descriptors: hxwxC float32 unit vectors that are similar where two pixels see the same point, or None.
    Raises:
        ModelError: wrong shapes or types, or a confidence that is not finite.
    """

    points: Float32Array
    confidence: Float32Array
    descriptors: Float32Array | None = None

    def __post_init__(self) -> None:
        size = tuple(self.points.shape[:2])
        parts = [self.points, self.confidence] + ([] if self.descriptors is None else [self.descriptors])
        typed = all(isinstance(part, np.ndarray) and part.dtype == np.float32 for part in parts)
        layers = [tuple(part.shape[2:]) for part in parts]
        if not typed or layers[:2] != [(3,), ()] or any(tuple(part.shape[:2]) != size for part in parts):
            told = ", ".join(f"{'x'.join(map(str, part.shape))} {part.dtype}" for part in parts)
            raise ModelError(
                f"a point map has arrays of {told}: expected points hxwx3, confidence hxw, of one size, numpy float32"
            )
        if not np.isfinite(self.confidence).all():
            raise ModelError("the confidence of a point map is not finite: expected a number for every pixel")


@dataclass(frozen=True)
class Framing:
    """The part of an image that a network sees, and its size there.

    With coordinates counted from the corner of the first pixel: seen = image * scale - offset.

    Args:
        scale: (x, y), network pixels per image pixel.
        offset: (x, y) network pixels cut off on the left and at the top.
        size: (rows, columns) of what the network sees.
    """

    scale: tuple[float, float]
    offset: tuple[float, float]
    size: tuple[int, int]

    def intrinsics(self, K: Float64Array) -> Float64Array:
        """3x3 K of the image -> 3x3 of what the network sees; both with pixel centres at integers."""
        seen = np.array(K, np.float64)
        for axis in (0, 1):
            seen[axis, axis] = K[axis, axis] * self.scale[axis]
            seen[axis, 2] = (K[axis, 2] + 0.5) * self.scale[axis] - self.offset[axis] - 0.5
        return seen

    def to_image(self, px: Array) -> Array:
        """(n, 2) pixels x, y that the network sees -> pixels of the image; both with pixel centres at integers."""
        return np.asarray((px + 0.5 + self.offset) / self.scale - 0.5, np.float64)


@dataclass(frozen=True, eq=False)
class PairMaps:
    """Both orders of a pair.

    Args:
        source_first: point maps of source and target, both in the source camera's frame.
        target_first: point maps of target and source, both in the target camera's frame.
        framings: of source and target.
        metric: whether the network's unit is the metre.
        origin: the network's name.
    Raises:
        ModelError: a map of another size than its picture's framing.
    """

    source_first: tuple[PointMap, PointMap]
    target_first: tuple[PointMap, PointMap]
    framings: tuple[Framing, Framing]
    metric: bool
    origin: str

    def __post_init__(self) -> None:
        wanted = [framing.size for framing in self.framings]
        for order, sizes in ((self.source_first, wanted), (self.target_first, wanted[::-1])):
            found = [one.confidence.shape for one in order]
            if found != [tuple(size) for size in sizes]:
                raise ModelError(f"{self.origin} gives point maps of {found} pixels: expected {sizes}, its framings'")

    def trusted(self, least: float) -> tuple[Bool, Bool]:
        """Masks (h, w) of source and target: the confidence of either of a picture's two maps is above `least`."""
        of_source = np.maximum(self.source_first[0].confidence, self.target_first[1].confidence) > least
        of_target = np.maximum(self.target_first[0].confidence, self.source_first[1].confidence) > least
        return of_source, of_target

    def gives_metres(self, scale: str) -> bool:
        """Whether `start.scale` asks for the network's own metres. Raises ConfigError if the network is not metric."""
        if scale == "network" and not self.metric:
            raise ConfigError(f"start.scale is network, and {self.origin} has no metres: expected auto or depth")
        return self.metric and scale != "depth"


class TwoViewModel(Protocol):
    """Interface of a two-view network; see `PairMaps`."""

    def __call__(self, source: Picture, target: Picture) -> PairMaps:
        """Point maps of two pictures HxWx3 uint8 RGB, of any sizes, in both orders.

        Raises:
            ModelError: too little memory, or values that are not finite. InputError: a picture it cannot take.
        """


def own_depth(maps: PairMaps, source: View, target: View, min_confidence: float) -> tuple[Float32Array, Float32Array]:
    """Depth of both views from the maps in their own frames, HxW float32, in metres only if `maps.metric`.

    NaN outside of the framing, and where neither confidence is above `min_confidence`.
    """
    first = (maps.source_first[0], maps.target_first[0])
    of_source, of_target = map(_own_depth, (source, target), first, maps.trusted(min_confidence), maps.framings)
    return of_source, of_target


def _own_depth(view: View, one: PointMap, trusted: Bool, framing: Framing) -> Float32Array:
    z = one.points[..., 2]
    known = trusted & np.isfinite(one.points).all(-1) & (z > 0)
    height, width = view.rgb.shape[:2]
    u = (np.arange(width, dtype=np.float32) + 0.5) * framing.scale[0] - framing.offset[0] - 0.5
    v = (np.arange(height, dtype=np.float32) + 0.5) * framing.scale[1] - framing.offset[1] - 0.5
    columns, rows = np.meshgrid(u, v)
    z = np.where(known, z, np.float32(np.nan))
    moved = cv2.remap(z, columns, rows, cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT, borderValue=float("nan"))
    return np.asarray(moved, np.float32)
