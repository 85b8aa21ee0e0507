# SPDX-License-Identifier: Apache-2.0
"""Where the pairs of a run come from, whose depth they get, and from which starts they are run by default."""

from __future__ import annotations

import json
import os
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from rich.console import Console

from bench.pairs import bare, learned_rooms
from bench.pairs.datasets import DATA, HALVES, Pair, read_pairs, scene_points, spread, with_monocular_depth
from bench.pairs.readers import READERS, load
from bench.pairs.readers.pair_list import RAW
from garps_core import Config, GarpsError
from garps_core.align import NETWORKS
from garps_core.mixtures.reconstruct import with_depth
from garps_core.models.depth_networks import presets

PAIRS, ROOMS, BARE = "pairs", "rooms", "bare"
NAMES = (PAIRS, ROOMS, BARE, *READERS)
"""`pairs`: a folder with a pairs.json; `rooms`, `bare`: generated; the others: `bench.pairs.readers`."""
SENSOR, MONOCULAR, DEMO_NET = "sensor", "monocular", "demo_net"
DEPTHS = {SENSOR: "sensor", MONOCULAR: "monocular", **presets()}
"""Whose depth: the set's own, the same spoilt as a network would, or a network's; and the preset that goes with it."""
NOTHING_GIVEN = ("none", "disturbed")
BY_DEFAULT: dict[str, tuple[tuple[str, ...], tuple[str, ...]]] = {
    PAIRS: ((SENSOR, MONOCULAR, DEMO_NET), ("features", "disturbed", "identity")),
    BARE: ((MONOCULAR,), NOTHING_GIVEN),
    ROOMS: ((DEMO_NET,), ("features", "disturbed", "none")),
}
"""Depths and starts of a source where nothing else is asked; of public sets their own depth and `NOTHING_GIVEN`."""


def sources_there(data: Path = DATA) -> list[str]:
    """What a run takes by default: every set beside the repository with depth in its pairs.json, generated rooms."""
    found = sorted(path for path in (data / "dev").glob("*/pairs.json") if _have_depth(path))
    return [
        *(f"{PAIRS}={os.path.relpath(path.parent)}" for path in found),
        f"{BARE}={bare.FOLDER}",
        f"{ROOMS}={learned_rooms.FOLDER}",
    ]


def _have_depth(path: Path) -> bool:
    return all("depth0" in record and "depth1" in record for record in json.loads(path.read_text())["pairs"])


def named(source: str) -> tuple[str, Path]:
    """NAME=FOLDER in two. Raises ValueError on another form or name."""
    name, equals, folder = source.partition("=")
    if not equals or name not in NAMES:
        raise ValueError(f"--data is {source!r}: expected NAME=FOLDER, NAME one of {', '.join(NAMES)}")
    return name, Path(folder)


def defaults_of(source: str) -> tuple[tuple[str, ...], tuple[str, ...]]:
    """Depths and starts that a source is run with where nothing else is asked."""
    return BY_DEFAULT.get(named(source)[0], ((SENSOR,), NOTHING_GIVEN))


def pairs_of(source: str, limit: int | None, workers: int, console: Console, half: str = "all") -> list[Pair]:
    """The pairs of NAME=FOLDER; of a public set those whose files are all there, the others are printed.

    Args:
        source: NAME=FOLDER.
        limit: at most so many, spread evenly; of learned rooms the first.
        workers: processes that make rooms.
        console: for bars, and what is left out.
        half: of a folder with a pairs.json; of generated rooms "dev" takes those to tune on, else those to report.
    Raises:
        ValueError: no such name or half, not of that form, or files that are not what they should be.
        FileNotFoundError: no pairs.json, or an image in it that is not there.
    """
    if half not in HALVES:
        raise ValueError(f"half is {half!r}: expected one of {', '.join(HALVES)}")
    name, path = named(source)
    split = "tune" if half == "dev" else "report"
    if name == PAIRS:
        return read_pairs(path.resolve().name, path, limit, half)
    if name == ROOMS:
        return learned_rooms.load(split, path, console, workers, limit)
    if name == BARE:
        return spread(bare.load_with_bar(split, path, console).pairs, limit)
    skipped: list[str] = []
    found = load(name, path, limit, skipped)
    for text in skipped:
        console.print(f"left out: {text}", soft_wrap=True)
    return found


def usable(pair: Pair, depth: str) -> bool:
    """Whether a pair has what a depth of `DEPTHS` needs. Bare rooms come with monocular-like depth, and no other."""
    if depth not in (SENSOR, MONOCULAR):
        return True
    return pair.source.depth is not None and pair.target.depth is not None and (depth, pair.set) != (SENSOR, bare.SET)


def config_of(depth: str) -> Config:
    """The preset that goes with a depth of `DEPTHS`, for views that have it already."""
    return Config.preset(DEPTHS[depth]).replace({"reconstruction.method": "rgbd"})


def with_depth_of(pair: Pair, depth: str, seed: int = 0) -> Pair:
    """The pair with a depth of `DEPTHS`.

    Where no true points are known, E_3D is of those that this depth gives the source, unless the truth has no metres.

    Raises:
        WeightsError: the network's weights are not installed.
    """
    if depth == SENSOR or (depth, pair.set) == (MONOCULAR, bare.SET):
        return pair
    if depth == MONOCULAR:
        return with_monocular_depth(pair, seed)
    config = Config.preset(DEPTHS[depth]).replace({"reconstruction.method": depth})
    source, target = with_depth([pair.source, pair.target], config, NETWORKS)
    pair = replace(pair, source=source, target=target)
    if len(pair.points) or pair.scale == RAW:  # metres and the set's own unit do not mix
        return pair
    return replace(pair, points=scene_points(source), points_from=depth)


def why_not(depth: str) -> str:
    """Why a network of `DEPTHS` cannot run here, or nothing."""
    if depth in (SENSOR, MONOCULAR):
        return ""
    try:
        NETWORKS.depth_network(Config.preset(DEPTHS[depth]).replace({"reconstruction.method": depth}))
    except GarpsError as error:
        return str(error)
    return ""


def overlap_of(pair: Pair) -> float | None:
    """Share of the pixels whose surface the other camera sees, 0..1, from the pair's own depth; None without any."""
    from bench.rooms.pair import mutual_overlap

    if not usable(pair, SENSOR):
        return None
    (a, b), T = (pair.source, pair.target), pair.T_target_source
    return mutual_overlap(a.depth, b.depth, a.K, b.K, T)


def without_depth(pairs: Sequence[Pair], depth: str) -> list[str]:
    """What cannot be run with a depth, in words."""
    lacking = [pair for pair in pairs if not usable(pair, depth)]
    counts = {name: sum(pair.set == name for pair in lacking) for name in dict.fromkeys(pair.set for pair in lacking)}
    return [f"{name}, depth {depth}: {n} pairs come without it for both views" for name, n in counts.items()]
