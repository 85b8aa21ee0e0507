# SPDX-License-Identifier: Apache-2.0
"""Pairs of generated rooms that the demonstration network has not seen, rich in texture to hardly anything to match.

    python -m bench.pairs.learned_rooms

Seeds are not those of the rooms to learn from (`bench.training.rooms`). Levels (`bench.rooms.LEVELS`: 5 deg and 0.1 m
to 35 deg and 1 m) and kinds take turns. Depth is the truth's here; `bench.pairs.depths.with_depth_of` puts a network's
in its place.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import Annotated

import numpy as np
import typer
from rich.console import Console
from rich.progress import Progress

from bench.machine.jobs import computed
from bench.pairs.bare_rooms import matches
from bench.pairs.pair import Pair, scene_points
from bench.rooms import LEVELS, make_pair
from bench.rooms.dark import in_the_dark
from garps_core import View

SET = "learned_rooms"
FOLDER = Path("out/learned_rooms")
KINDS = {"rich": 1.0, "medium": 0.4, "plain": 0.0, "dark": 0.0}
"""Texture of each; dark is plain, in dim light from a moving camera (`bench.rooms.dark.in_the_dark`)."""
SPLITS = {"tune": range(91_000, 91_060), "report": range(92_000, 92_200)}
VERSION = 1


def kind_of(seed: int) -> str:
    """Every level comes in every kind."""
    return list(KINDS)[seed // len(LEVELS) % len(KINDS)]


def level_of(seed: int) -> int:
    """Levels take turns."""
    return sorted(LEVELS)[seed % len(LEVELS)]


def load(split: str, folder: Path, console: Console, workers: int = 2, limit: int | None = None) -> list[Pair]:
    """Pairs of a split, the first `limit`, with true depth, `category` = kind; made where they are not yet there.

    Raises:
        ValueError: no such split.
    """
    if split not in SPLITS:
        raise ValueError(f"split is {split!r}: expected one of {', '.join(SPLITS)}")
    folder.mkdir(parents=True, exist_ok=True)
    seeds = list(SPLITS[split])[:limit]  # levels and kinds take turns, so that the first few hold all of them
    with Progress(console=console) as bars:
        paths = computed(partial(stored, folder=folder), seeds, workers)
        return [
            _read(seed, path)
            for seed, path in zip(seeds, bars.track(paths, len(seeds), description=f"{SET}, {split}"), strict=True)
        ]


def stored(seed: int, folder: Path) -> Path:
    """The file of one pair, made unless it is there."""
    path = folder / f"room{seed}_v{VERSION}.npz"
    if path.is_file():
        return path
    made = make_pair(seed, level_of(seed), KINDS[kind_of(seed)])
    rgbs = [made.rgb0, made.rgb1]
    if kind_of(seed) == "dark":
        rgbs = [in_the_dark(rgb, np.random.default_rng([seed, 501, k])) for k, rgb in enumerate(rgbs)]
    unfinished = path.with_suffix(".unfinished")
    with unfinished.open("wb") as file:
        np.savez_compressed(
            file,
            rgb=np.stack(rgbs),
            depth=np.stack([made.true_depth0, made.true_depth1]),
            labels=np.stack([made.labels0, made.labels1]).astype(np.uint8),
            K=np.stack([made.K0, made.K1]),
            T=made.T_1_0,
        )
    unfinished.replace(path)
    return path


def _read(seed: int, path: Path) -> Pair:
    with np.load(path, allow_pickle=False) as file:
        views = [View(*given) for given in zip(file["rgb"], file["K"], file["depth"], strict=True)]
        T, labels = file["T"], file["labels"].astype(np.int32)
    name = f"room{seed}_level{level_of(seed)}"
    return Pair(SET, name, kind_of(seed), views[0], views[1], T, scene_points(views[0]), labels=(labels[0], labels[1]))


def few_matches(pairs: Sequence[Pair], limit: int) -> int:
    """Number of pairs with fewer feature matches than the limit."""
    return sum(matches(pair) < limit for pair in pairs)


def main(
    splits: Annotated[str, typer.Option(help=f"comma-separated from {', '.join(SPLITS)}")] = ",".join(SPLITS),
    out: Annotated[Path, typer.Option(help="folder of the pairs")] = FOLDER,
    workers: Annotated[int, typer.Option(min=1, help="processes")] = 2,
) -> None:
    """Make the pairs that the demonstration network is measured on."""
    console = Console()
    for split in splits.split(","):
        pairs = load(split, out, console, workers)
        console.print(f"{split}: {len(pairs)} pairs, {few_matches(pairs, 30)} of them with fewer than 30 matches")


if __name__ == "__main__":
    typer.run(main)
