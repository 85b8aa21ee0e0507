# SPDX-License-Identifier: Apache-2.0
"""Every method on every pair: the evaluation bench.

    python -m bench.run --limit 120                                # every accuracy table of docs/BENCHMARK.md
    python -m bench.run --resume                                   # goes on with one that was stopped
    python -m bench.run --data realestate10k=FOLDER --depth depth_anything_v2 --methods garps,mast3r,sift-pnp
    python -m bench.run --methods ablations --depth monocular,demo_net --starts disturbed --out out/ablations
    python -m bench.run --scheduler tcp://10.0.0.7:8786 --resume   # on a Dask cluster

Into --out go rows.jsonl as they come, then rows.csv, run.json (machine, versions, commit, seeds, settings), tables in
table.md, plots and pictures. Pairs are independent: any number of processes gives the same rows in the same order.
"""

from __future__ import annotations

import contextlib
import os
import sys
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Annotated

import typer
from rich.console import Console
from rich.progress import Progress

from bench.machine.facts import machine_facts
from bench.machine.jobs import computed
from bench.pairs.depths import DEPTHS, SENSOR, config_of, overlap_of, usable, why_not, with_depth_of, without_depth
from bench.pairs.pair import Pair
from bench.pairs.readers.pairs_json import HALVES
from bench.pairs.sources import NAMES, defaults_of, named, pairs_of, sources_there
from bench.pairs.starts import disturbed_prior
from bench.peers.methods import METHODS, NEED_NO_START
from bench.report.write import write_report
from bench.rows.depth_errors import errors_of_pair
from bench.rows.pair_rows import STARTS, failed_rows, rows_of_pair, run_garps
from bench.rows.row import Row
from bench.rows.row_log import Key, RowLog, reusable_rows, reuse_note
from bench.rows.variants import GARPS, GARPS_NO_FEATURES, GARPS_PAPER, VARIANTS
from garps_core import Config, GarpsError
from garps_core.config.text import changed_config, read_settings

GROUPS = {"ablations": list(VARIANTS), "peers": list(METHODS)}
"""Names that stand for several methods."""
BY_DEFAULT = f"{GARPS},{GARPS_NO_FEATURES},{GARPS_PAPER},peers"
TABLE_WIDTH = 200
"""Columns of a table that goes to a file or a pipe."""


@dataclass(frozen=True, eq=False)
class Job:
    """One pair with one depth from some starts, and all that its rows depend on."""

    depth: str
    starts: tuple[str, ...]
    pair: Pair
    config: Config
    methods: tuple[str, ...]
    seed: int
    known: Mapping[str, Mapping[str, Row]] = field(default_factory=dict)
    """Rows that are not made anew, by start and method."""

    @property
    def keys(self) -> list[Key]:
        """Keys of its rows."""
        return [(self.depth, self.pair.set, start, self.pair.id) for start in self.starts]


def job_rows(job: Job) -> list[list[Row]]:
    """The rows of a job, start by start; methods that need no start run once. Without depth all are failures."""
    same: Row = {"depth": job.depth, "true_overlap": overlap_of(job.pair)}
    try:
        pair = with_depth_of(job.pair, job.depth, job.seed)
    except GarpsError as error:  # of this pair: networks that cannot run at all are left out beforehand
        reason = f"no depth: {error}"
        rows = [failed_rows(job.config, job.pair, start, job.methods, reason) for start in job.starts]
        return [[same | row for row in of_start] for of_start in rows]
    if job.depth != SENSOR:
        same["depth_errors"] = errors_of_pair(pair, job.pair)
    made: list[list[Row]] = []
    shared: dict[str, Row] = {}
    for start in job.starts:
        known = {name: row | {"start": start} for name, row in shared.items()} | dict(job.known.get(start, {}))
        rows = rows_of_pair(job.config, pair, start, job.methods, job.seed, known)
        made.append([same | row for row in rows])
        shared = {row["method"]: row for row in rows if row["method"] in NEED_NO_START}
    return made


def methods_of(text: str) -> list[str]:
    """Names, groups among them opened, each once. Raises ValueError on another name."""
    names = [name for word in text.split(",") for name in GROUPS.get(word, [word])]
    return _known("method", list(dict.fromkeys(names)), (*GROUPS, *VARIANTS, *METHODS))


def _known(what: str, names: list[str], known: Sequence[str]) -> list[str]:
    if unknown := [name for name in names if name not in known]:
        raise ValueError(f"no {what} {', '.join(unknown)}: expected some of {', '.join(known)}")
    return names


def config_for(depth: str, settings: Path | None, change: Sequence[str]) -> Config:
    """Settings of GARPS for a depth: its preset, then the file, then single changes."""
    config = config_of(depth)
    return changed_config(config if settings is None else read_settings(settings, config, DEPTHS[depth]), change)


def main(
    data: Annotated[
        list[str] | None, typer.Option(help=f"NAME=FOLDER; NAME one of {', '.join(NAMES)}; repeat at will")
    ] = None,
    depth: Annotated[str, typer.Option(help=f"comma-separated from {', '.join(DEPTHS)}; default: by the set")] = "",
    starts: Annotated[str, typer.Option(help=f"comma-separated from {', '.join(STARTS)}; default: by the set")] = "",
    methods: Annotated[str, typer.Option(help="comma-separated; see --list")] = BY_DEFAULT,
    settings: Annotated[Path | None, typer.Option(help="YAML of settings, as bench.tune writes")] = None,
    change: Annotated[
        list[str] | None, typer.Option(help='setting of GARPS, as "alignment.effective_measurements=100"')
    ] = None,
    limit: Annotated[
        int | None, typer.Option(help="largest number of pairs of a set: spread evenly, of learned rooms the first")
    ] = None,
    half: Annotated[
        str, typer.Option(help=f"of each pairs.json: {', '.join(HALVES)}; dev takes generated rooms to tune on")
    ] = "all",
    workers: Annotated[int, typer.Option(min=1, help="processes")] = 2,
    scheduler: Annotated[str, typer.Option(help="address of a Dask scheduler, instead of processes here")] = "",
    resume: Annotated[bool, typer.Option(help="go on with the run in --out: finished pairs are skipped")] = False,
    reuse_peers: Annotated[Path | None, typer.Option(help="run.json to take the peers' rows from")] = None,
    out: Annotated[Path, typer.Option(help="folder of rows, tables and pictures")] = Path("out/run"),
    seed: Annotated[int, typer.Option(help="of disturbances and spoilt depth")] = 0,
    list_: Annotated[bool, typer.Option("--list", help="print the names of methods and stop")] = False,
) -> None:
    """Every method on every pair."""
    console = Console(width=None if sys.stdout.isatty() else TABLE_WIDTH)
    if list_:
        console.print("\n".join(_names()))
        return
    try:
        if reuse_peers and reuse_peers.resolve().parent == out.resolve():
            raise ValueError(f"{reuse_peers} lies in --out and would be overwritten: choose another --out")
        RowLog.check(out, resume)
        chosen, sources = methods_of(methods), data or sources_there()
        plan = [(source, *_asked(source, depth, starts)) for source in sources]
        depths = list(dict.fromkeys(name for _, names, _ in plan for name in names))
        configs = {name: config_for(name, settings, change or []) for name in depths}
        known = reusable_rows(reuse_peers, seed) if reuse_peers else {}
        of_config = {name: config.settings() for name, config in configs.items()}
        options = {"plan": plan, "methods": chosen, "limit": limit, "half": half, "seed": seed}
        options |= {"settings": of_config, "reuse_peers": str(reuse_peers or "")}
        pairs, jobs, left_out = _planned(plan, configs, chosen, limit, half, workers, seed, console)
        log = RowLog(out, options, resume)  # last: it begins the file anew
        missing = [_lent(_rest_of(job, log), known) for job in jobs]
        _run([job for job in missing if job.starts], log, workers, scheduler, console)
    except (OSError, ValueError, GarpsError) as error:
        console.print(str(error), soft_wrap=True, markup=False)
        raise typer.Exit(2) from None
    facts: Row = {"seed": seed, **machine_facts()} | {"settings": of_config, "data": [_shown(s) for s in sources]}
    if reuse_peers:
        facts["reused_peers"] = reuse_note(log.rows, reuse_peers)
    write_report(out, log.rows, facts, pairs, configs, left_out, console)


def _names() -> list[str]:
    lines = [f"{name}: {variant.what}" for name, variant in VARIANTS.items()]
    lines += [f"{name}: {(method.__doc__ or '').splitlines()[0]}" for name, method in METHODS.items()]
    return [*lines, *(f"{group}: all of {', '.join(names)}" for group, names in GROUPS.items())]


def _asked(source: str, depth: str, starts: str) -> tuple[tuple[str, ...], tuple[str, ...]]:
    """Depths and starts of a source: those that were asked for, else its own."""
    depths, its_starts = defaults_of(source)
    return (
        tuple(dict.fromkeys(_known("depth", depth.split(","), tuple(DEPTHS)))) if depth else depths,
        tuple(dict.fromkeys(_known("start", starts.split(","), STARTS))) if starts else its_starts,
    )


def _planned(
    plan: Sequence[tuple[str, tuple[str, ...], tuple[str, ...]]],
    configs: Mapping[str, Config],
    methods: Sequence[str],
    limit: int | None,
    half: str,
    workers: int,
    seed: int,
    console: Console,
) -> tuple[list[Pair], list[Job], list[str]]:
    """All pairs, the jobs in the order of the tables, and what cannot be run, in words (printed too).

    Raises:
        ValueError: two pairs of one set and name, or nothing that can be run.
    """
    pairs, jobs = [], []
    missing = {depth: reason for depth in configs if (reason := why_not(depth))}
    left_out = [f"depth {depth}: {reason}" for depth, reason in missing.items()]
    for source, depths, starts in plan:
        found = pairs_of(source, limit, workers, console, half)
        pairs += found
        for depth in (depth for depth in depths if depth not in missing):
            having = [pair for pair in found if usable(pair, depth)]
            jobs += [Job(depth, starts, pair, configs[depth], tuple(methods), seed) for pair in having]
            left_out += without_depth(found, depth)
    for text in left_out:
        console.print(f"left out: {text}", soft_wrap=True, markup=False)
    if twice := [name for name, n in Counter((pair.set, pair.id) for pair in pairs).items() if n > 1]:
        raise ValueError(
            f"{len(twice)} pairs are there twice, as {' '.join(twice[0])}: give each set once, by one name"
        )
    if not jobs:
        raise ValueError("nothing to run: no set has pairs with the depth that was asked for")
    return pairs, jobs, left_out


def _rest_of(job: Job, log: RowLog) -> Job:
    return replace(job, starts=tuple(key[2] for key in job.keys if key not in log.done))


def _shown(source: str) -> str:
    """NAME=FOLDER with the folder seen from here: what is written names no place of this machine."""
    name, folder = named(source)
    return f"{name}={os.path.relpath(folder)}"


def _lent(job: Job, known: Mapping[Key, Mapping[str, Row]]) -> Job:
    return replace(job, known={key[2]: known[key] for key in job.keys if key in known})


def _run(jobs: Sequence[Job], log: RowLog, workers: int, scheduler: str, console: Console) -> None:
    if not jobs:
        return
    with contextlib.suppress(GarpsError):  # compiles, once for all processes
        first = with_depth_of(jobs[0].pair, jobs[0].depth)
        run_garps(jobs[0].config, first, "disturbed", disturbed_prior(first))
    with Progress(console=console) as bars:
        for made in bars.track(computed(job_rows, jobs, workers, scheduler), len(jobs), description="pairs"):
            log.add([row for rows in made for row in rows])


if __name__ == "__main__":
    typer.run(main)
