# SPDX-License-Identifier: Apache-2.0
"""Where the pairs of a run come from, and whose depth they get."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from rich.console import Console

from bench import bare, learned_rooms
from bench.datasets import DATA, Pair, read_pairs, spread, with_monocular_depth
from bench.readers import READERS, load
from garps_core import Config
from garps_core.reconstruct import with_depth

PAIRS, ROOMS, BARE = "pairs", "rooms", "bare"
NAMES = (PAIRS, ROOMS, BARE, *READERS)
"""`pairs`: a folder with a pairs.json; `rooms`, `bare`: generated, into the folder; the others: `bench.readers`."""
DEPTHS = {
    "given": "sensor",
    "monocular": "monocular",
    "demo_net": "demo_net",
    "depth_anything_v2": "monocular",
}
"""Whose depth: the set's own, the same spoilt as a network would, or a network's; and the preset that goes with it."""


def sources_there(data: Path = DATA) -> list[str]:
    """What a run takes by default: every set with a pairs.json beside the repository, and generated rooms."""
    found = sorted(path.parent for path in (data / "dev").glob("*/pairs.json"))
    return [*(f"{PAIRS}={folder}" for folder in found), f"{ROOMS}={learned_rooms.FOLDER}"]


def pairs_of(source: str, limit: int | None, workers: int, console: Console) -> list[Pair]:
    """The pairs of NAME=FOLDER; of a public set those whose files are all there, the others are printed.

    Raises:
        ValueError: no such name, not of that form, or files that are not what they should be.
        FileNotFoundError: no pairs.json, or an image in it that is not there.
    """
    name, equals, folder = source.partition("=")
    if not equals or name not in NAMES:
        raise ValueError(f"--data is {source!r}: expected NAME=FOLDER, NAME one of {', '.join(NAMES)}")
    path = Path(folder)
    if name == PAIRS:
        return read_pairs(path.resolve().name, path, limit)
    if name == ROOMS:
        return learned_rooms.load("report", path, console, workers, limit)
    if name == BARE:
        return spread(bare.load_with_bar("report", path, console).pairs, limit)
    skipped: list[str] = []
    found = load(name, path, limit, skipped)
    for text in skipped:
        console.print(f"left out: {text}", soft_wrap=True)
    return found


def usable(pairs: Sequence[Pair], depth: str) -> tuple[list[Pair], list[Pair]]:
    """Those that have what a depth of `DEPTHS` needs, and those that have not."""
    from_set = depth in ("given", "monocular")
    whole = [not from_set or (pair.source.depth is not None and pair.target.depth is not None) for pair in pairs]
    return [p for p, has in zip(pairs, whole, strict=True) if has], [
        p for p, has in zip(pairs, whole, strict=True) if not has
    ]


def config_of(depth: str) -> Config:
    """The preset that goes with a depth of `DEPTHS`, for views that have it already."""
    return Config.preset(DEPTHS[depth]).replace({"reconstruction.method": "rgbd"})


def with_depth_of(pair: Pair, depth: str, seed: int = 0) -> Pair:
    """The pair with a depth of `DEPTHS`. Raises WeightsError where the network's weights are not installed."""
    if depth == "given":
        return pair
    if depth == "monocular":
        return with_monocular_depth(pair, seed)
    config = Config.preset(DEPTHS[depth]).replace({"reconstruction.method": depth})
    source, target = with_depth([pair.source, pair.target], config)
    return replace(pair, source=source, target=target)
