# SPDX-License-Identifier: Apache-2.0
"""Sources of the pairs of a run, with the depths and starts that each is run with by default."""

from __future__ import annotations

import json
import os
from pathlib import Path

from rich.console import Console

from bench.pairs import bare_rooms, learned_rooms
from bench.pairs.depths import DEMO_NET, MONOCULAR, SENSOR
from bench.pairs.pair import Pair, spread
from bench.pairs.readers import READERS, load
from bench.pairs.readers.pairs_json import DATA, HALVES, read_pairs

PAIRS, ROOMS, BARE = "pairs", "rooms", "bare"
NAMES = (PAIRS, ROOMS, BARE, *READERS)
"""`pairs`: a folder with a pairs.json; `rooms`, `bare`: generated; the others: `bench.pairs.readers`."""
NOTHING_GIVEN = ("none", "disturbed")
BY_DEFAULT: dict[str, tuple[tuple[str, ...], tuple[str, ...]]] = {
    PAIRS: ((SENSOR, MONOCULAR, DEMO_NET), ("features", "disturbed", "identity")),
    BARE: ((MONOCULAR,), NOTHING_GIVEN),
    ROOMS: ((DEMO_NET,), ("features", "disturbed", "none")),
}
"""Depths and starts of a source where nothing else is asked; of public sets their own depth and `NOTHING_GIVEN`."""


def sources_there(data: Path = DATA) -> list[str]:
    """Sources of a run by default: every set beside the repository with depth in its pairs.json, generated rooms."""
    found = sorted(path for path in (data / "dev").glob("*/pairs.json") if _have_depth(path))
    return [
        *(f"{PAIRS}={os.path.relpath(path.parent)}" for path in found),
        f"{BARE}={bare_rooms.FOLDER}",
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
        limit: largest number of pairs, spread evenly; of learned rooms the first.
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
        return spread(bare_rooms.load_with_bar(split, path, console).pairs, limit)
    skipped: list[str] = []
    found = load(name, path, limit, skipped)
    for text in skipped:
        console.print(f"left out: {text}", soft_wrap=True)
    return found
