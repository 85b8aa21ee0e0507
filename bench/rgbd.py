# SPDX-License-Identifier: Apache-2.0
"""Accuracy on RGB-D pairs: GARPS against its start and against its peers, from the same starts, in one run.

    python -m bench.rgbd --full                 # every accuracy figure: both depths, all sets, starts and methods
    python -m bench.rgbd --full --resume        # goes on with one that was stopped
    python -m bench.rgbd
    python -m bench.rgbd --monocular
    python -m bench.rgbd --sets hololens_lounge --starts disturbed --methods garps,small-gicp

Rows (one per pair, start and method) go to rows.jsonl as they come, and to rows.csv and run.json, tables to table.md.
"""

from __future__ import annotations

import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Annotated

import typer
from rich.console import Console
from rich.progress import track

from bench import acceptance, bare
from bench.baselines import METHODS
from bench.datasets import DATA, HALVES, Pair, disturbed_prior
from bench.evaluate import evaluate_pair, run_garps
from bench.plan import STARTS, Part, pairs_of, parts
from bench.runs import Key, RowLog, reusable_rows
from bench.tables import GARPS, Row, machine_facts, print_tables, write
from bench.variants import GARPS_NO_FEATURES, VARIANTS
from garps_core import Config, GarpsError
from garps_core.settings import changed_config

TABLE_WIDTH = 200
"""Columns of a table that goes to a file or a pipe."""
PEERS = ("open3d-gicp", "open3d-colored", "small-gicp", "sift-pnp")


def main(
    sets: Annotated[str, typer.Option(help="comma-separated; default: all that are there")] = "",
    preset: Annotated[str | None, typer.Option(help="of GARPS; default: sensor or monocular, by the depth")] = None,
    starts: Annotated[str, typer.Option(help=f"comma-separated from {', '.join(STARTS)}, none")] = "",
    methods: Annotated[str, typer.Option(help=f"comma-separated from {', '.join((*VARIANTS, *METHODS))}")] = "",
    monocular: Annotated[bool, typer.Option(help="spoil the depth as a metric monocular network would")] = False,
    limit: Annotated[int | None, typer.Option(help="at most so many pairs of a set, spread evenly")] = None,
    full: Annotated[
        bool, typer.Option(help="both depths, the bare rooms, all methods, and the acceptance table")
    ] = False,
    half: Annotated[
        str, typer.Option(help=f"of each set: {', '.join(HALVES)}; dev takes bare rooms to tune on")
    ] = "all",
    resume: Annotated[bool, typer.Option(help="go on with the run in --out")] = False,
    reuse_peers: Annotated[Path | None, typer.Option(help="run.json to take the peers' rows from")] = None,
    change: Annotated[list[str] | None, typer.Option(help='setting of GARPS, as "alignment.information=100"')] = None,
    data: Annotated[Path, typer.Option(help="folder that holds dev/<set>/pairs.json")] = DATA,
    bare_rooms: Annotated[Path, typer.Option(help="folder of the generated bare rooms")] = bare.FOLDER,
    out: Annotated[Path, typer.Option(help="where rows and tables go")] = Path("out/rgbd"),
    seed: Annotated[int, typer.Option(help="of disturbances and spoilt depth")] = 0,
) -> None:
    """Accuracy on RGB-D pairs."""
    console = Console(width=None if sys.stdout.isatty() else TABLE_WIDTH)
    try:
        planned = parts(full, monocular, _split(sets), _split(starts), half, data)
        chosen = _split(methods) or ([GARPS, GARPS_NO_FEATURES, *METHODS] if full else [GARPS, *PEERS])
        _check_methods(chosen)
        if full and preset:
            raise ValueError("--full takes the preset of each depth: leave out --preset")
        if reuse_peers and reuse_peers.resolve().parent == out.resolve():
            raise ValueError(f"{reuse_peers} lies in --out and would be overwritten: choose another --out")
        presets = dict.fromkeys(part.depth for part in planned)
        configs = {depth: changed_config(Config.preset(preset or depth), change or []) for depth in presets}
        settings = {depth: config.settings() for depth, config in configs.items()}
        known = reusable_rows(reuse_peers, seed) if reuse_peers else {}
        options = {"parts": [part._asdict() for part in planned], "methods": chosen, "settings": settings, "seed": seed}
        options |= {"limit": limit, "half": half, "reuse_peers": str(reuse_peers or "")}
        log = RowLog(out, options, resume)
    except (ValueError, GarpsError) as error:
        console.print(str(error), soft_wrap=True)
        raise typer.Exit(2) from None
    facts: Row = {"depth": ", ".join(configs), "half": half, "seed": seed, **machine_facts()} | {"settings": settings}

    for part in planned:
        pairs = pairs_of(part, data, bare_rooms, half, limit, seed, console)
        _run_part(configs[part.depth], part, pairs, chosen, seed, known, log, console)
        if reuse_peers:
            facts["reused_peers"] = _reuse_note(log.rows, reuse_peers)
        write(out, log.rows, facts)
    print_tables(console, log.rows, facts)
    if full:
        found = acceptance.bars(log.rows)
        acceptance.print_bars(console, found)
        write(out, log.rows, facts, acceptance.markdown_bars(found))
    console.print(f"rows and tables: {out}")


def _split(text: str) -> list[str]:
    return text.split(",") if text else []


def _check_methods(chosen: Sequence[str]) -> None:
    unknown = [name for name in chosen if name not in (*VARIANTS, *METHODS)]
    if unknown:
        raise ValueError(f"no method {', '.join(unknown)}: expected some of {', '.join((*VARIANTS, *METHODS))}")


def _run_part(
    config: Config,
    part: Part,
    pairs: Sequence[Pair],
    methods: Sequence[str],
    seed: int,
    known: Mapping[Key, Mapping[str, Row]],
    log: RowLog,
    console: Console,
) -> None:
    """Rows of the pairs of one table that the log does not have yet."""
    keys = [(part.depth, part.set, part.start, pair.id) for pair in pairs]
    missing = [(key, pair) for key, pair in zip(keys, pairs, strict=True) if key not in log.done]
    if not missing:
        return
    # Compiles, so that no pair's time holds it.
    run_garps(config, pairs[0], "disturbed", disturbed_prior(pairs[0]))
    for key, pair in track(missing, f"{part.depth}, {part.set}, {part.start}", console=console):
        made = evaluate_pair(config, pair, part.start, methods, seed, known.get(key))
        log.add([{"depth": part.depth} | row for row in made])


def _reuse_note(rows: Sequence[Row], path: Path) -> str:
    peers = [row for row in rows if row["method"] in METHODS]
    commits = [row["reused"] for row in peers if "reused" in row]
    origin = f"{path} (commit {', '.join(dict.fromkeys(commits)) or 'none'})"
    return f"{len(commits)} of {len(peers)} rows of peers, times included, were not run anew but taken from {origin}."


if __name__ == "__main__":
    typer.run(main)
