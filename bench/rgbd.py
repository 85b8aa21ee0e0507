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
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Annotated

import numpy as np
import typer
from rich.console import Console
from rich.progress import track

from bench import acceptance, bare
from bench.acceptance import START
from bench.baselines import METHODS
from bench.datasets import DATA, HALVES, Pair, disturbed_prior, truth_covariance
from bench.plan import STARTS, Part, pairs_of, parts
from bench.runs import Key, RowLog, reusable_rows
from bench.tables import GARPS, Row, machine_facts, print_tables, write
from garps_core import Config, GarpsError, PoseEstimate, Prior, Status, estimate_relative_pose, metrics
from garps_core.checks import Float64Array
from garps_core.initialise import identity
from garps_core.settings import changed_config

GARPS_NO_FEATURES = "garps-no-features"
"""GARPS with `start.features` off: run only where the setting exists, and where the start is not its own features."""
VARIANTS = (GARPS, GARPS_NO_FEATURES)
TABLE_WIDTH = 200
"""Columns of a table that goes to a file or a pipe."""
PEERS = ("open3d-gicp", "open3d-colored", "small-gicp", "sift-pnp")


def evaluate(
    config: Config,
    pairs: Sequence[Pair],
    start: str = "disturbed",
    methods: Iterable[str] = (GARPS,),
    seed: int = 0,
    progress: Callable[[Sequence[Pair]], Iterable[Pair]] = iter,
) -> list[Row]:
    """Run GARPS and peers on pairs from one kind of start.

    Args:
        config: settings of GARPS; its `start.method` is set here.
        pairs: what `load_pairs` gave; keep the list to evaluate many configurations.
        start: "features" (GARPS' own features + PnP), "disturbed" (truth off by 1 deg and 0.12 m, given as a prior),
            "identity", or "none" (GARPS starts as it sees fit, peers that need a start from identity).
        methods: "garps", "garps-no-features" and names from `bench.baselines.METHODS`. GARPS always runs where the
            start comes from it.
        seed: of the disturbance.
        progress: wraps the pairs, for a progress bar.
    Returns: rows, per pair first "(start)", then the methods in order.
    """
    chosen = list(methods)
    return [row for pair in progress(pairs) for row in evaluate_pair(config, pair, start, chosen, seed)]


def evaluate_pair(
    config: Config,
    pair: Pair,
    start: str,
    methods: Sequence[str],
    seed: int = 0,
    known: Mapping[str, Row] | None = None,
) -> list[Row]:
    """`evaluate` on one pair; peers in `known` are not run, their rows are taken from there."""
    prior = {
        "disturbed": lambda: disturbed_prior(pair, seed),
        "identity": lambda: identity(config, "a guess"),
    }.get(start, lambda: None)()
    initial, estimate, seconds = prior, None, float("nan")
    if GARPS in methods or prior is None:
        estimate, seconds = run_garps(config, pair, start, prior)
        initial = estimate.initial if prior is None else prior
    rows = [_start_row(pair, start, initial, estimate if prior is None else None)]
    T_start = None if initial is None else initial.T_target_source
    for name in methods:
        if name == GARPS and estimate is not None:
            rows.append(_garps_row(pair, start, GARPS, estimate, seconds))
        elif name == GARPS_NO_FEATURES:
            if prior is not None:
                without = run_garps(config.replace({"start.features": False}), pair, start, prior)
                rows.append(_garps_row(pair, start, name, *without))
        elif known and name in known:
            rows.append(known[name])
        else:
            began = time.perf_counter()
            T, reason = METHODS[name](pair.source, pair.target, np.eye(4) if start == "none" else T_start)
            rows.append(_row(pair, start, name, T, time.perf_counter() - began, reason))
    return rows


def _start_row(pair: Pair, start: str, initial: Prior | None, own: PoseEstimate | None) -> Row:
    """The pose before the alignment; `own` = GARPS' estimate where it chose the pose itself."""
    seconds = float("nan") if own is None else own.seconds.get("initialise", float("nan"))
    if initial is None:
        return _row(pair, start, START, None, seconds, "" if own is None else own.reason)
    return _row(pair, start, START, initial.T_target_source, seconds, "", initial.covariance)


def _garps_row(pair: Pair, start: str, name: str, estimate: PoseEstimate, seconds: float) -> Row:
    row = _row(pair, start, name, estimate.T_target_source, seconds, estimate.reason, estimate.covariance)
    return row | {
        "status": estimate.status.value,
        "origin": "" if estimate.initial is None else estimate.initial.origin,
        "overlap": estimate.overlap,
        "quality": estimate.quality,
        "iterations": estimate.iterations,
        "objective": estimate.objective,
        **{f"seconds_{stage}": value for stage, value in estimate.seconds.items()},
    }


def run_garps(config: Config, pair: Pair, start: str, prior: Prior | None) -> tuple[PoseEstimate, float]:
    """GARPS from one kind of start: the estimate and its wall time in s."""
    config = config.replace({"start.method": "features" if start == "features" else "auto"})
    began = time.perf_counter()
    try:
        estimate = estimate_relative_pose(pair.source, pair.target, config, prior)
    except GarpsError as error:  # an answer about this pair, not about the others
        estimate = PoseEstimate(Status.NO_INITIAL_POSE, f"{type(error).__name__}: {error}", initial=prior)
    return estimate, time.perf_counter() - began


def _row(
    pair: Pair,
    start: str,
    method: str,
    T: Float64Array | None,
    seconds: float,
    reason: str,
    covariance: Float64Array | None = None,
) -> Row:
    row: Row = {"set": pair.set, "pair": pair.id, "category": pair.category, "start": start, "method": method}
    row |= {"found": T is not None, "seconds": seconds, "reason": reason}
    if T is None:
        return row | dict.fromkeys(("e_trans_m", "e_rot_deg", "e_3d_m"), float("inf"))
    truth = pair.T_target_source
    row |= {
        "e_trans_m": metrics.translation_error_m(T, truth),
        "e_rot_deg": metrics.rotation_error_deg(T, truth),
        "e_3d_m": metrics.error_3d_m(T, truth, pair.points),
        "e_dir_deg": metrics.direction_error_deg(T, truth),
        "scale_ratio": metrics.scale_ratio(T, truth),
        "T": T[:3].ravel().tolist(),
    }
    if covariance is not None:
        row |= {
            "nees": metrics.nees(T, covariance + truth_covariance(pair), truth),
            "covariance": np.asarray(covariance).ravel().tolist(),
        }
    return row


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
        chosen = _split(methods) or ([*VARIANTS, *METHODS] if full else [GARPS, *PEERS])
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
