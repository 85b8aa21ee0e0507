# SPDX-License-Identifier: Apache-2.0
"""Dense descriptors of two pictures -> matches: reciprocal nearest neighbours (Leroy et al. 2024, section 3.3)."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from garps_core.checks import Float32Array
from garps_core.config import Config
from garps_core.errors import InitialisationError
from garps_core.geometry import Array
from garps_core.point_maps import PairMaps, PointMap
from garps_core.start.features import Matches, points_at
from garps_core.types import View

STEP_PX = 8
"""Spacing of the pixels of the source from which the search sets out."""
ROUNDS = 10
"""There and back again, at most; a pixel that has not come home by then has no partner."""
BORDER_PX = 3
"""The descriptors of pixels so near to the border are not used."""
CHUNK = 256
"""Pixels that look for their neighbour at once: 200 MB of similarities at 512x384."""

Index = npt.NDArray[np.intp]


def match_descriptors(maps: PairMaps, source: View, target: View, config: Config) -> Matches:
    """Matches in pixels of the images; their points by the network's own maps, or by the depth of the views.

    Args:
        maps: with descriptors.
        source, target: their depth is used where `start.scale` asks for it, or where the network has no metres.
        config: `start` is used.
    Raises:
        InitialisationError: the network has no descriptors, or is sure of no match.
    """
    of_source, of_target = maps.source_first
    if of_source.descriptors is None or of_target.descriptors is None:
        raise InitialisationError(f"{maps.origin} has no descriptors to match: set start.pose_from to maps")
    seen_s, seen_t = _sure(*reciprocal(of_source.descriptors, of_target.descriptors), maps, config)
    px_s, px_t = (framing.to_image(px) for framing, px in zip(maps.framings, (seen_s, seen_t), strict=True))
    if maps.gives_metres(config.start.scale):
        points = _points(maps.source_first[0], seen_s), _points(maps.target_first[0], seen_t)
    else:
        points = points_at(source, px_s), points_at(target, px_t)
    return Matches(px_s, px_t, *points)


def _sure(px_s: Array, px_t: Array, maps: PairMaps, config: Config) -> tuple[Array, Array]:
    """The matches of pixels that the network is sure of on both sides."""
    sides = zip(maps.trusted(config.start.min_confidence), (px_s, px_t), strict=True)
    on_source, on_target = (trusted[tuple(px.astype(int).T[::-1])] for trusted, px in sides)
    sure = on_source & on_target
    if not sure.any():
        raise InitialisationError(
            f"{maps.origin}: of {len(sure)} matches none is surer than {config.start.min_confidence:g} on both sides. "
            "Do the pictures share anything, are the weights trained?"
        )
    return px_s[sure], px_t[sure]


def reciprocal(a: Float32Array, b: Float32Array) -> tuple[Array, Array]:
    """Pixels (n, 2) x, y of two maps hxwxC of unit vectors that are each other's nearest, from a grid in the first."""
    grid = np.zeros(a.shape[:2], bool)
    grid[STEP_PX // 2 :: STEP_PX, STEP_PX // 2 :: STEP_PX] = True
    start = np.flatnonzero(grid & _inside(a))
    flat_a, flat_b = a.reshape(-1, a.shape[-1]), b.reshape(-1, b.shape[-1])
    among_a, among_b = np.flatnonzero(_inside(a)), np.flatnonzero(_inside(b))
    here, found = start, []
    for _ in range(ROUNDS):
        there = _nearest(flat_a[here], flat_b, among_b)
        back = _nearest(flat_b[there], flat_a, among_a)
        home = back == here
        found.append(np.stack([here[home], there[home]], axis=1))
        here = np.unique(back[~home])
        if not len(here):
            break
    pairs = np.unique(np.concatenate(found), axis=0)
    return _pixels(pairs[:, 0], a.shape[1]), _pixels(pairs[:, 1], b.shape[1])


def _inside(descriptors: Float32Array) -> npt.NDArray[np.bool_]:
    inside = np.zeros(descriptors.shape[:2], bool)
    inside[BORDER_PX:-BORDER_PX, BORDER_PX:-BORDER_PX] = True
    return inside


def _nearest(asking: Float32Array, everything: Float32Array, among: Index) -> Index:
    """For each row of `asking` which of the rows `among` of `everything` is most alike."""
    candidates = np.ascontiguousarray(everything[among].T)
    parts = [(asking[i : i + CHUNK] @ candidates).argmax(1) for i in range(0, len(asking), CHUNK)]
    return among[np.concatenate(parts)] if parts else np.zeros(0, np.intp)


def _pixels(flat: Index, width: int) -> Array:
    return np.stack([flat % width, flat // width], axis=1).astype(np.float64)


def _points(one: PointMap, px: Array) -> Array:
    column, row = px.astype(int).T
    return np.asarray(one.points[row, column], np.float64)
