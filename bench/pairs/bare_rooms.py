# SPDX-License-Identifier: Apache-2.0
"""Generated pairs with hardly anything to match: plain rooms in the dark, seen by a robot that moves.

    python -m bench.pairs.bare_rooms --out out/bare_rooms

A room of texture 0 (`bench.rooms`) still has lamps, edges and shadows. What a camera on a moving robot makes of them in
a dim room is simulated from linear light on: less light, motion blur along one direction, shot and read noise
(`in_the_dark`). Kept are the pairs with fewer than 30 mutual RootSIFT matches that pass the ratio test, a fixed number
of each level. Everything follows from the seed; the splits share no seed.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import numpy.typing as npt
import typer
from rich.console import Console
from rich.progress import Progress

from bench.pairs.pair import Pair, scene_points
from bench.rooms import RoomPair, make_pair
from bench.rooms.dark import BLUR_PX, EXPOSURE, GAMMA, READ_ELECTRONS, WHITE_ELECTRONS, in_the_dark
from garps_core import Config, View
from garps_core.start.features import match_features

SET = "bare_rooms"
FOLDER = Path("out/bare_rooms")
MAX_MATCHES = 30
LEVELS = (1, 2, 3, 4)
VERSION = 1
VIEW_ARRAYS = ("rgb", "K", "depth")


@dataclass(frozen=True)
class Split:
    """Seeds that a split may take, and the number of pairs of each level that it keeps."""

    seeds: range
    per_level: int

    @property
    def size(self) -> int:
        """Pairs in all."""
        return self.per_level * len(LEVELS)


SPLITS = {"tune": Split(range(100), 4), "report": Split(range(2000, 2400), 12)}


def candidates(split: Split) -> Iterator[tuple[int, int]]:
    """(seed, level) in the order in which they are tried: levels take turns, a seed is used once."""
    return ((seed, LEVELS[seed % len(LEVELS)]) for seed in split.seeds)


def room_pair(seed: int, level: int, width: int = 640, height: int = 480) -> Pair:
    """One candidate: plain, dark, with monocular-like depth; `points` are true."""
    made = make_pair(seed, level, 0.0, width, height, depth_noise="monocular")
    views = [(made.rgb0, made.K0, made.depth0), (made.rgb1, made.K1, made.depth1)]
    source, target = (
        View(in_the_dark(rgb, np.random.default_rng([seed, level, 301, k])), K, depth)
        for k, (rgb, K, depth) in enumerate(views)
    )
    return _pair(seed, level, source, target, made.T_1_0, _true_points(made))


def _true_points(made: RoomPair) -> npt.NDArray[np.float64]:
    return scene_points(View(made.rgb0, made.K0, made.true_depth0))


def _pair(seed: int, level: int, source: View, target: View, T: Any, points: Any) -> Pair:
    return Pair(SET, f"room{seed:04d}_level{level}", "small" if level <= 2 else "large", source, target, T, points)


def matches(pair: Pair) -> int:
    """Mutual RootSIFT matches that pass the ratio test, as GARPS' own start finds them by default."""
    return len(match_features(pair.source, pair.target, Config().start))


@dataclass(frozen=True)
class BareRooms:
    """Pairs of one split, and how many candidates were looked at for them."""

    pairs: list[Pair]
    candidates: int

    @property
    def rejected(self) -> int:
        """Candidates with too many matches."""
        return self.candidates - len(self.pairs)

    def __str__(self) -> str:
        return (
            f"{SET}: {len(self.pairs)} pairs kept, {self.rejected} of {self.candidates} candidates rejected "
            f"({MAX_MATCHES} matches or more)"
        )


def load(
    split: str,
    folder: Path = FOLDER,
    progress: Callable[[int, int], None] = lambda kept, wanted: None,
    width: int = 640,
    height: int = 480,
) -> BareRooms:
    """Pairs of a split, made where they are not yet in the folder; an interrupted call goes on where it stopped.

    Args:
        split: one of `SPLITS`.
        folder: holds one file per candidate.
        progress: called with pairs kept and pairs wanted after each candidate.
        width: px.
        height: px.
    Raises:
        ValueError: no such split, its seeds are used up, or a file in the folder was made by another recipe.
    """
    if split not in SPLITS:
        raise ValueError(f"split is {split!r}: expected one of {', '.join(SPLITS)}")
    wanted, found = SPLITS[split], BareRooms([], 0)
    room_left = dict.fromkeys(LEVELS, wanted.per_level)
    for seed, level in candidates(wanted):
        if room_left[level] == 0:
            continue
        pair = _cached(folder, seed, level, width, height)
        if pair is not None:
            room_left[level] -= 1
        found = BareRooms([*found.pairs, *([pair] if pair else [])], found.candidates + 1)
        progress(len(found.pairs), wanted.size)
        if not any(room_left.values()):
            return found
    raise ValueError(f"{SET}: seeds {wanted.seeds} gave {len(found.pairs)} pairs of {wanted.size}: give it more seeds")


def _recipe(width: int, height: int) -> str:
    """All that decides about a pair besides its seed and level; change `VERSION` with the rooms themselves."""
    settings = (VERSION, MAX_MATCHES, EXPOSURE, BLUR_PX, WHITE_ELECTRONS, READ_ELECTRONS, GAMMA, width, height)
    return " ".join(map(str, settings))


def _cached(folder: Path, seed: int, level: int, width: int, height: int) -> Pair | None:
    """The candidate, or None where it has too many matches; made and stored unless it is there."""
    path, recipe = folder / f"room{seed:04d}_level{level}.npz", _recipe(width, height)
    if path.is_file():
        with np.load(path, allow_pickle=False) as file:
            return _read(path, file, seed, level, recipe)
    pair = room_pair(seed, level, width, height)
    count = matches(pair)
    stored: dict[str, Any] = {"recipe": np.array(recipe), "matches": np.array(count)}
    if count < MAX_MATCHES:
        stored |= {name: np.asarray(getattr(pair.source, name)) for name in VIEW_ARRAYS}
        stored |= {f"target_{name}": np.asarray(getattr(pair.target, name)) for name in VIEW_ARRAYS}
        stored |= {"T_target_source": pair.T_target_source, "points": pair.points}
    folder.mkdir(parents=True, exist_ok=True)
    unfinished = path.with_suffix(".unfinished")
    with unfinished.open("wb") as file:
        np.savez_compressed(file, **stored)
    unfinished.replace(path)
    return pair if count < MAX_MATCHES else None


def _read(path: Path, file: Any, seed: int, level: int, recipe: str) -> Pair | None:
    if str(file["recipe"]) != recipe:
        raise ValueError(f"{path} was made by recipe {file['recipe']!s}, not {recipe}: choose or empty the folder")
    if file["matches"] >= MAX_MATCHES:
        return None
    source, target = (View(**{name: file[prefix + name] for name in VIEW_ARRAYS}) for prefix in ("", "target_"))
    return _pair(seed, level, source, target, file["T_target_source"], file["points"])


def load_with_bar(split: str, folder: Path, console: Console) -> BareRooms:
    """`load` with a progress bar; prints how many candidates were rejected."""
    with Progress(console=console) as bars:
        bar = bars.add_task(f"{SET}, {split}", total=SPLITS[split].size)
        found = load(split, folder, lambda kept, wanted: bars.update(bar, completed=kept, total=wanted))
    console.print(f"{split}: {found}")
    return found


def main(
    splits: Annotated[str, typer.Option(help="comma-separated from tune, report")] = "tune,report",
    out: Annotated[Path, typer.Option(help="folder of the pairs")] = FOLDER,
) -> None:
    """Make the pairs with hardly anything to match."""
    for split in splits.split(","):
        load_with_bar(split, out, Console())


if __name__ == "__main__":
    typer.run(main)
