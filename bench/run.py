# SPDX-License-Identifier: Apache-2.0
"""Every method on every pair: the evaluation bench.

    python -m bench.run                                            # all sets beside the repository, generated rooms
    python -m bench.run --data realestate10k=FOLDER --depth depth_anything_v2 --methods garps,mast3r,sift-pnp
    python -m bench.run --methods ablations --depth monocular,demo_net --starts disturbed --out out/ablations
    python -m bench.run --scheduler tcp://10.0.0.7:8786 --resume   # on a Dask cluster; goes on where it was stopped

Into --out go rows.jsonl as they come, then rows.csv, run.json (machine, versions, commit, seeds, settings), tables in
table.md, and pictures. Pairs are independent: any number of processes gives the same rows in the same order.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any

import typer
from rich.console import Console
from rich.progress import Progress

from bench.baselines import METHODS
from bench.datasets import Pair, disturbed_prior
from bench.evaluate import STARTS, evaluate_pair, run_garps
from bench.jobs import computed
from bench.report import write_report
from bench.rgbd import TABLE_WIDTH
from bench.runs import Key, RowLog
from bench.sources import DEPTHS, NAMES, config_of, pairs_of, sources_there, usable, with_depth_of
from bench.tables import Row, machine_facts
from bench.variants import GARPS, VARIANTS
from garps_core import Config, GarpsError
from garps_core.settings import changed_config, read_settings

GROUPS = {"ablations": list(VARIANTS), "peers": list(METHODS)}
"""Names that stand for several methods."""


@dataclass(frozen=True, eq=False)
class Job:
    """One pair from one start with one depth, and all that its rows depend on."""

    depth: str
    start: str
    pair: Pair
    config: Config
    methods: tuple[str, ...]
    seed: int

    @property
    def key(self) -> Key:
        """Of its rows."""
        return self.depth, self.pair.set, self.start, self.pair.id


def rows_of(job: Job) -> list[Row]:
    """The rows of a job. Raises WeightsError where the depth is a network's that is not installed."""
    pair = with_depth_of(job.pair, job.depth, job.seed)
    return [{"depth": job.depth} | row for row in evaluate_pair(job.config, pair, job.start, job.methods, job.seed)]


def planned(
    pairs: Sequence[Pair], depths: Sequence[str], starts: Sequence[str], methods: Sequence[str], configs: Any, seed: int
) -> tuple[list[Job], list[str]]:
    """The jobs in the order of the tables, and what cannot be run, in words."""
    jobs, left_out = [], []
    for depth in depths:
        there, without = usable(pairs, depth)
        for name in dict.fromkeys(pair.set for pair in without):
            count = sum(pair.set == name for pair in without)
            left_out.append(f"{name}, depth {depth}: {count} pairs come without depth of both views")
        for name in dict.fromkeys(pair.set for pair in there):
            chosen = [pair for pair in there if pair.set == name]
            jobs += [
                Job(depth, start, pair, configs[depth], tuple(methods), seed) for start in starts for pair in chosen
            ]
    return jobs, left_out


def methods_of(text: str) -> list[str]:
    """Names, groups among them opened, each once. Raises ValueError on another name."""
    names = [name for word in text.split(",") for name in GROUPS.get(word, [word])]
    unknown = [name for name in names if name not in (*VARIANTS, *METHODS)]
    if unknown:
        known = ", ".join((*GROUPS, *VARIANTS, *METHODS))
        raise ValueError(f"no method {', '.join(unknown)}: expected some of {known}")
    return list(dict.fromkeys(names))


def configs_of(depths: Sequence[str], settings: Path | None, change: Sequence[str]) -> dict[str, Config]:
    """Settings of GARPS for each depth: its preset, then the file, then single changes."""
    unknown = [name for name in depths if name not in DEPTHS]
    if unknown:
        raise ValueError(f"no depth {', '.join(unknown)}: expected some of {', '.join(DEPTHS)}")
    found = {}
    for depth in depths:
        config = config_of(depth)
        if settings is not None:
            config = read_settings(settings, config)
        found[depth] = changed_config(config, change)
    return found


def main(
    data: Annotated[
        list[str] | None, typer.Option(help=f"NAME=FOLDER; NAME one of {', '.join(NAMES)}; repeat at will")
    ] = None,
    depth: Annotated[str, typer.Option(help=f"comma-separated from {', '.join(DEPTHS)}")] = "given,monocular,demo_net",
    starts: Annotated[str, typer.Option(help=f"comma-separated from {', '.join(STARTS)}")] = "none,disturbed",
    methods: Annotated[str, typer.Option(help="comma-separated; see --list")] = f"{GARPS},peers",
    settings: Annotated[Path | None, typer.Option(help="YAML of settings, as bench.tune writes")] = None,
    change: Annotated[list[str] | None, typer.Option(help='setting of GARPS, as "alignment.information=100"')] = None,
    limit: Annotated[int | None, typer.Option(help="at most so many pairs of a set, spread evenly")] = None,
    workers: Annotated[int, typer.Option(min=1, help="processes")] = 2,
    scheduler: Annotated[str, typer.Option(help="address of a Dask scheduler, instead of processes here")] = "",
    resume: Annotated[bool, typer.Option(help="go on with the run in --out: finished pairs are skipped")] = False,
    out: Annotated[Path, typer.Option(help="folder of rows, tables and pictures")] = Path("out/run"),
    seed: Annotated[int, typer.Option(help="of disturbances and spoilt depth")] = 0,
    list_: Annotated[bool, typer.Option("--list", help="print the names of methods and stop")] = False,
) -> None:
    """Every method on every pair."""
    console = Console(width=None if sys.stdout.isatty() else TABLE_WIDTH)
    if list_:
        lines = [f"{name}: {variant.what}" for name, variant in VARIANTS.items()]
        lines += [f"{name}: {(method.__doc__ or '').splitlines()[0]}" for name, method in METHODS.items()]
        console.print("\n".join([*lines, *(f"{group}: all of {', '.join(names)}" for group, names in GROUPS.items())]))
        return
    try:
        depths, chosen = depth.split(","), methods_of(methods)
        wrong = [name for name in starts.split(",") if name not in STARTS]
        if wrong:
            raise ValueError(f"no start {', '.join(wrong)}: expected some of {', '.join(STARTS)}")
        configs = configs_of(depths, settings, change or [])
        sources = data or sources_there()
        options = {"data": sources, "depths": depths, "starts": starts, "methods": chosen, "limit": limit, "seed": seed}
        options |= {"settings": {name: config.settings() for name, config in configs.items()}}
        log = RowLog(out, options, resume)
        pairs = [pair for source in sources for pair in pairs_of(source, limit, workers, console)]
        jobs, left_out = planned(pairs, depths, starts.split(","), chosen, configs, seed)
        for text in left_out:
            console.print(f"left out: {text}", soft_wrap=True)
        _run([job for job in jobs if job.key not in log.done], log, workers, scheduler, console)
    except (OSError, ValueError, GarpsError) as error:
        console.print(str(error), soft_wrap=True)
        raise typer.Exit(2) from None
    facts: Row = {"seed": seed, **machine_facts()} | {"settings": options["settings"], "data": sources}
    write_report(out, log.rows, facts, pairs, left_out, console)


def _run(jobs: Sequence[Job], log: RowLog, workers: int, scheduler: str, console: Console) -> None:
    if not jobs:
        return
    first = replace(jobs[0], pair=with_depth_of(jobs[0].pair, jobs[0].depth)).pair
    run_garps(jobs[0].config, first, "disturbed", disturbed_prior(first))  # compiles, once for all processes
    with Progress(console=console) as bars:
        for rows in bars.track(computed(rows_of, jobs, workers, scheduler), len(jobs), description="pairs"):
            log.add(rows)


if __name__ == "__main__":
    typer.run(main)
