# SPDX-License-Identifier: Apache-2.0
"""Depth for a pair: the set's own, the same spoilt, or a network's."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

from bench.pairs import bare_rooms
from bench.pairs.pair import Pair, rng_of, scene_points
from bench.pairs.readers.pair_list import RAW
from bench.rooms import monocular_depth, mutual_overlap
from garps_core import Config, GarpsError
from garps_core.align import NETWORKS
from garps_core.mixtures.reconstruct import with_depth
from garps_core.models.depth_networks import presets
from garps_core.types import View

SENSOR, MONOCULAR, DEMO_NET = "sensor", "monocular", "demo_net"
DEPTHS = {SENSOR: "sensor", MONOCULAR: "monocular", **presets()}
"""Kinds of depth and their presets: the set's own, the same spoilt as by a network, or a network's."""


def usable(pair: Pair, depth: str) -> bool:
    """Whether a pair has what a depth of `DEPTHS` needs. Bare rooms come with monocular-like depth, and no other."""
    if depth not in (SENSOR, MONOCULAR):
        return True
    return (
        pair.source.depth is not None
        and pair.target.depth is not None
        and (depth, pair.set) != (SENSOR, bare_rooms.SET)
    )


def config_of(depth: str) -> Config:
    """The preset that goes with a depth of `DEPTHS`, for views that have it already."""
    return Config.preset(DEPTHS[depth]).replace({"reconstruction.method": "rgbd"})


def with_depth_of(pair: Pair, depth: str, seed: int = 0) -> Pair:
    """The pair with a depth of `DEPTHS`.

    Where no true points are known, E_3D is of those that this depth gives the source, unless the truth has no metres.

    Raises:
        WeightsError: the network's weights are not installed.
    """
    if depth == SENSOR or (depth, pair.set) == (MONOCULAR, bare_rooms.SET):
        return pair
    if depth == MONOCULAR:
        return with_monocular_depth(pair, seed)
    config = Config.preset(DEPTHS[depth]).replace({"reconstruction.method": depth})
    source, target = with_depth([pair.source, pair.target], config, NETWORKS)
    pair = replace(pair, source=source, target=target)
    if len(pair.points) or pair.scale == RAW:  # metres and the set's own unit do not mix
        return pair
    return replace(pair, points=scene_points(source), points_from=depth)


def with_monocular_depth(pair: Pair, seed: int = 0) -> Pair:
    """The pair with depth spoilt as a metric monocular network would, each view on its own; `points` stay true."""

    def spoilt(view: View, which: str) -> View:
        return replace(view, depth=monocular_depth(view.depth, rng_of(pair.id + which, seed)))

    return replace(pair, source=spoilt(pair.source, "/source"), target=spoilt(pair.target, "/target"))


def why_not(depth: str) -> str:
    """The reason that a network of `DEPTHS` cannot run here, or "" where it can."""
    if depth in (SENSOR, MONOCULAR):
        return ""
    try:
        NETWORKS.depth_network(Config.preset(DEPTHS[depth]).replace({"reconstruction.method": depth}))
    except GarpsError as error:
        return str(error)
    return ""


def overlap_of(pair: Pair) -> float | None:
    """Share of the pixels whose surface the other camera sees, 0..1, from the pair's own depth; None without any."""
    if not usable(pair, SENSOR):
        return None
    (a, b), T = (pair.source, pair.target), pair.T_target_source
    return mutual_overlap(a.depth, b.depth, a.K, b.K, T)


def without_depth(pairs: Sequence[Pair], depth: str) -> list[str]:
    """Sets that cannot be run with a depth, in words."""
    lacking = [pair for pair in pairs if not usable(pair, depth)]
    counts = {name: sum(pair.set == name for pair in lacking) for name in dict.fromkeys(pair.set for pair in lacking)}
    return [f"{name}, depth {depth}: {n} pairs come without it for both views" for name, n in counts.items()]
