# SPDX-License-Identifier: Apache-2.0
"""Which tables a run of `bench.rgbd` makes, and the pairs of each."""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache
from pathlib import Path
from typing import NamedTuple

from rich.console import Console

from bench import bare
from bench.datasets import HALVES, RGBD_SETS, Pair, available, load_pairs, spread, with_monocular_depth

SENSOR, MONOCULAR = "sensor", "monocular"
STARTS = ("features", "disturbed", "identity")
BARE_STARTS = ("none", "disturbed")


class Part(NamedTuple):
    """One table."""

    depth: str
    set: str
    start: str


def parts(full: bool, monocular: bool, sets: Sequence[str], starts: Sequence[str], half: str, data: Path) -> list[Part]:
    """The tables of a run, in order.

    Args:
        full: both depths and the bare rooms; otherwise one depth, and bare rooms (always monocular) only where named.
        monocular: which depth, unless full.
        sets: names, none = all that there are.
        starts: names, none = all that a set is run with.
        half: of each set.
        data: folder of the recorded sets.
    Raises:
        ValueError: unknown names, options that exclude each other, or nothing to run.
    """
    if full and monocular:
        raise ValueError("--full runs both depths: leave out --monocular")
    if half not in HALVES:
        raise ValueError(f"half is {half!r}: expected one of {', '.join(HALVES)}")
    unknown = [name for name in sets if name not in (*RGBD_SETS, bare.SET)]
    unknown += [name for name in starts if name not in (*STARTS, *BARE_STARTS)]
    if unknown:
        names = ", ".join(dict.fromkeys((*RGBD_SETS, bare.SET, *STARTS, *BARE_STARTS)))
        raise ValueError(f"no set or start {', '.join(unknown)}: expected some of {names}")
    there = available(data)
    if not there and bare.SET not in sets:
        raise ValueError(f"no data under {data / 'dev'}: give its folder with --data")
    recorded = [name for name in sets or there if name != bare.SET]
    depths = (SENSOR, MONOCULAR) if full else (MONOCULAR if monocular else SENSOR,)
    found = [
        Part(depth, name, start)
        for depth in depths
        for name in recorded
        for start in starts or STARTS
        if start in STARTS
    ]
    if bare.SET in sets or (full and not sets):
        found += [Part(MONOCULAR, bare.SET, start) for start in starts or BARE_STARTS if start in BARE_STARTS]
    if not found:
        raise ValueError(f"nothing to run: sets {', '.join(sets)} have no start {', '.join(starts)}")
    return found


def pairs_of(
    part: Part, data: Path, bare_rooms: Path, half: str, limit: int | None, seed: int, console: Console
) -> list[Pair]:
    """The pairs of one table.

    Generated rooms have two splits of their own: the one to tune on for the half "dev", else the one to report.
    """
    if part.set == bare.SET:
        return spread(_generated("tune" if half == "dev" else "report", bare_rooms, console), limit)
    return _recorded(part.depth, part.set, data, half, limit, seed)


@lru_cache(maxsize=4)
def _recorded(depth: str, name: str, data: Path, half: str, limit: int | None, seed: int) -> list[Pair]:
    pairs = load_pairs(name, data, limit, half)
    return [with_monocular_depth(pair, seed) for pair in pairs] if depth == MONOCULAR else pairs


@lru_cache(maxsize=4)
def _generated(split: str, folder: Path, console: Console) -> list[Pair]:
    return bare.load_with_bar(split, folder, console).pairs
