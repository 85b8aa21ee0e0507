# SPDX-License-Identifier: Apache-2.0
"""GARPS on depth that a network has learned: the demonstration network, on generated rooms it has not seen.

    python -m bench.learned                      # 200 pairs, three kinds of start, all methods; --resume goes on
    python -m bench.learned --split tune --methods garps
    python -m bench.learned_photos               # the same network on real photographs, and its time

Every method gets the same depth maps. Into --out go the rows as they come, rows.csv, run.json and table.md.
"""

from __future__ import annotations

import sys
from collections.abc import Iterator, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Annotated

import numpy as np
import typer
from rich.console import Console
from rich.progress import Progress

from bench import learned_rooms
from bench.acceptance import Bar, markdown_bars, print_bars
from bench.bare import MAX_MATCHES
from bench.baselines import METHODS
from bench.datasets import Pair, disturbed_prior
from bench.depth_errors import depth_table
from bench.evaluate import START, STARTS, evaluate_pair, run_garps
from bench.intervals import Difference, paired_difference
from bench.jobs import computed
from bench.learned_rooms import SPLITS, few_matches, load, with_learned_depth
from bench.run import TABLE_WIDTH
from bench.runs import RowLog, key_of
from bench.tables import GARPS, Row, machine_facts, print_tables, write
from bench.variants import GARPS_NO_FEATURES, VARIANTS
from garps_core import Config
from garps_core.errors import GarpsError
from garps_core.models import demo_net
from garps_core.models.loaded import depth_network_of
from garps_core.settings import changed_config

DEPTH = "demo_net"
REGISTRATION = ["open3d-gicp", "open3d-colored", "small-gicp"]
METHODS_OF = {
    "features": [GARPS, "small-gicp", "sift-pnp"],
    "disturbed": [GARPS, GARPS_NO_FEATURES, *REGISTRATION, "rgbd-intensity", "sift-pnp"],
    "none": [GARPS, *REGISTRATION, "sift-pnp", "sift-pnp+small-gicp", "kiss-matcher+gicp"],
}
"""What is run from each start by default."""


def differences(rows: Sequence[Row], start: str, method: str = GARPS, other: str = START) -> dict[str, Difference]:
    """Median and mean of E_3D (m) of a method minus those of another, over the pairs for which the other has a pose.

    Where the method itself has none, the other's pose is what its user is left with, and so counts.
    """
    of = {
        name: {row["pair"]: row for row in rows if (row["start"], row["method"]) == (start, name)}
        for name in (method, other)
    }
    pairs = [pair for pair, row in of[other].items() if row["found"]]
    theirs = np.array([of[other][pair]["e_3d_m"] for pair in pairs])
    ours = np.array([of[method][pair]["e_3d_m"] for pair in pairs])
    ours = np.where(np.isfinite(ours), ours, theirs)
    return {
        "median": paired_difference(ours, theirs, np.median),
        "mean": paired_difference(ours, theirs, np.mean),
    }


def bars(rows: Sequence[Row]) -> Iterator[Bar]:
    """What is asked of GARPS on learned depth: better than a disturbed start for sure, not worse than its PnP start."""
    for start, asked in (("disturbed", "lower"), ("features", "not_higher")):
        if not any(row["start"] == start and row["method"] == GARPS for row in rows):
            continue
        for name, found in differences(rows, start).items():
            words = "surely lower" if asked == "lower" else "not surely higher"
            yield Bar(f"{start}: {name} E_3D {words} than the start's", f"{found} m, 95 %", getattr(found, asked))


def evaluated(pair: Pair, config: Config, methods: Mapping[str, Sequence[str]], seed: int) -> list[list[Row]]:
    """Rows of one pair with the network's depth, per start."""
    learned = with_learned_depth(pair, _network(config))
    given = config.replace({"reconstruction.method": "rgbd"})
    return [
        [{"depth": DEPTH} | row for row in evaluate_pair(given, learned, start, of_start, seed)]
        for start, of_start in methods.items()
    ]


def _network(config: Config) -> demo_net.DemoNet:
    network = depth_network_of(config.reconstruction)
    assert isinstance(network, demo_net.DemoNet)
    return network


def main(
    split: Annotated[str, typer.Option(help=f"one of {', '.join(SPLITS)}")] = "report",
    starts: Annotated[str, typer.Option(help=f"comma-separated from {', '.join(STARTS)}")] = ",".join(METHODS_OF),
    methods: Annotated[
        str, typer.Option(help=f"comma-separated from {', '.join((*VARIANTS, *METHODS))}; default: by start")
    ] = "",
    change: Annotated[list[str] | None, typer.Option(help='setting of GARPS, as "alignment.information=100"')] = None,
    workers: Annotated[int, typer.Option(min=1, help="processes")] = 2,
    resume: Annotated[bool, typer.Option(help="go on with the run in --out")] = False,
    rooms: Annotated[Path, typer.Option(help="folder of the pairs")] = learned_rooms.FOLDER,
    out: Annotated[Path, typer.Option(help="where rows and tables go")] = Path("out/learned"),
    seed: Annotated[int, typer.Option(help="of disturbances")] = 0,
) -> None:
    """Accuracy with learned depth."""
    console = Console(width=None if sys.stdout.isatty() else TABLE_WIDTH)
    try:
        named = methods.split(",") if methods else []
        unknown = [name for name in named if name not in (*VARIANTS, *METHODS)]
        unknown += [name for name in starts.split(",") if name not in STARTS]
        if unknown:
            raise ValueError(f"no method or start {', '.join(unknown)}: expected some of --help")
        config = changed_config(Config.preset("demo_net"), change or [])
        chosen = {start: named or METHODS_OF.get(start, METHODS_OF["none"]) for start in starts.split(",")}
        options = {"split": split, "methods": chosen, "settings": config.settings(), "seed": seed}
        log = RowLog(out, options, resume)
        pairs = load(split, rooms, console, workers)
    except (ValueError, GarpsError) as error:
        console.print(str(error), soft_wrap=True)
        raise typer.Exit(2) from None
    facts: Row = {"depth": DEPTH, "split": split, "seed": seed, **machine_facts()} | {"settings": config.settings()}
    _run(pairs, config, chosen, seed, log, workers, console)
    print_tables(console, log.rows, facts)
    found = list(bars(log.rows))
    print_bars(console, found)
    text = depth_table(pairs, _network(config))
    text += f"\n{few_matches(pairs, MAX_MATCHES)} of {len(pairs)} pairs have fewer than {MAX_MATCHES} matches.\n"
    console.print(text)
    write(out, log.rows, facts, markdown_bars(found) + "\n### Depth\n\n" + text)
    console.print(f"rows and tables: {out}")


def _run(
    pairs: Sequence[Pair],
    config: Config,
    methods: Mapping[str, Sequence[str]],
    seed: int,
    log: RowLog,
    workers: int,
    console: Console,
) -> None:
    """Rows of the pairs that the log does not have yet."""
    missing = [pair for pair in pairs if (DEPTH, pair.set, list(methods)[-1], pair.id) not in log.done]
    if not missing:
        return
    run_garps(config, missing[0], "disturbed", disturbed_prior(missing[0]))  # compiles, once for all processes
    work = partial(evaluated, config=config, methods=methods, seed=seed)
    with Progress(console=console) as bar:
        found = computed(work, missing, workers)
        for rows in (rows for of_starts in bar.track(found, len(missing), description="pairs") for rows in of_starts):
            if key_of(rows[0]) not in log.done:
                log.add(rows)


if __name__ == "__main__":
    typer.run(main)
