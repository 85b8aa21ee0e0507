# SPDX-License-Identifier: Apache-2.0
"""Two views with the true pose between them.

All depth is in metres along z, all poses are `T_target_source` (image 0 = source, image 1 = target).
"""

from __future__ import annotations

import zlib
from dataclasses import dataclass
from typing import TypeVar

import numpy as np

from garps_core.checks import Float64Array, IntArray
from garps_core.geometry import pixel_rays
from garps_core.types import View

Item = TypeVar("Item")


@dataclass(frozen=True, eq=False)
class Pair:
    """Two views and the truth.

    Args:
        set: name of the data set.
        id: name of the pair within it.
        category: "small" (at most 0.3 m and 15 deg) or "large".
        source, target: the two views.
        T_target_source: 4x4, m.
        points: Nx3 m, true scene points in the source frame; they stay true when the views' depth is spoilt.
        scale: where the unit of the translation comes from: "metres" (measured), "raw" (the set's own arbitrary unit)
            or "sfm-depth x1.234" (that unit times a factor found from a network's depth).
        points_from: whose points those are: "truth", or the network's whose depth gave them.
        labels: HxW class of every pixel of source and target, where the truth has them.
    """

    set: str
    id: str
    category: str
    source: View
    target: View
    T_target_source: Float64Array
    points: Float64Array
    scale: str = "metres"
    points_from: str = "truth"
    labels: tuple[IntArray, IntArray] | None = None


def rng_of(name: str, seed: int = 0) -> np.random.Generator:
    """A generator that depends on nothing but a name and a seed (Python's own hash changes from run to run)."""
    return np.random.default_rng([zlib.crc32(name.encode()), seed])


def spread(items: list[Item], limit: int | None) -> list[Item]:
    """Take at most `limit` items, spread evenly."""
    if limit is None or limit >= len(items):
        return items
    return [items[i] for i in np.linspace(0, len(items) - 1, limit).round().astype(int)]


def scene_points(view: View, stride: int = 4) -> Float64Array:
    """Every stride-th pixel that has depth, as Nx3 m in the view's frame."""
    if view.depth is None:
        raise ValueError("the view has no depth: expected an RGB-D view")
    z = view.depth[::stride, ::stride].astype(np.float64)
    v, u = np.mgrid[: view.depth.shape[0] : stride, : view.depth.shape[1] : stride].astype(np.float64)
    return (pixel_rays(view.K, u, v) * z[..., None])[np.isfinite(z)]
