# SPDX-License-Identifier: Apache-2.0
"""Accuracy on real RGB-D pairs: GARPS against its start and against its peers, from the same starts, in one run.

    python -m bench.rgbd
    python -m bench.rgbd --monocular
    python -m bench.rgbd --sets hololens_lounge --starts disturbed --methods garps,small-gicp

Rows (one per pair, start and method) go to rows.csv and run.json, tables to table.md; `summarise` needs only rows.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import Annotated

import numpy as np
import typer
from rich.console import Console
from rich.progress import track

from bench.baselines import METHODS
from bench.datasets import DATA, Pair, available, disturbed_prior, load_pairs, truth_covariance, with_monocular_depth
from bench.tables import Row, machine_facts, print_tables, summarise, write
from garps_core import Config, GarpsError, PoseEstimate, Prior, Status, estimate_relative_pose, metrics
from garps_core.checks import Float64Array
from garps_core.settings import changed_config

GARPS, START = "garps", "(start)"
TABLE_WIDTH = 170
"""Columns of a table that goes to a file or a pipe."""
PEERS = ("open3d-gicp", "open3d-colored", "small-gicp", "sift-pnp")
STARTS = ("features", "disturbed", "identity")


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
        start: "features" (GARPS' own features + PnP), "disturbed" (truth off by 1 deg and 0.12 m, given as a prior)
            or "identity".
        methods: "garps" and names from `bench.baselines.METHODS`. GARPS always runs where the start comes from it.
        seed: of the disturbance.
        progress: wraps the pairs, for a progress bar.
    Returns: rows, per pair first "(start)", then the methods in order.
    """
    rows: list[Row] = []
    for pair in progress(pairs):
        rows += _evaluate_pair(config, pair, start, list(methods), seed)
    return rows


def _evaluate_pair(config: Config, pair: Pair, start: str, methods: list[str], seed: int) -> list[Row]:
    prior = disturbed_prior(pair, seed) if start == "disturbed" else None
    initial, estimate, seconds = prior, None, float("nan")
    if GARPS in methods or prior is None:
        estimate, seconds = run_garps(config, pair, start, prior)
        initial = estimate.initial if prior is None else prior
    T_start = None if initial is None else initial.T_target_source
    start_seconds = estimate.seconds.get("initialise", float("nan")) if estimate and prior is None else float("nan")
    start_reason = "" if initial is not None or estimate is None else estimate.reason
    rows = [_row(pair, start, START, T_start, start_seconds, start_reason, initial and initial.covariance)]
    for name in methods:
        if name == GARPS and estimate is not None:
            row = _row(pair, start, GARPS, estimate.T_target_source, seconds, estimate.reason, estimate.covariance) | {
                "status": estimate.status.value,
                "origin": "" if estimate.initial is None else estimate.initial.origin,
                "overlap": estimate.overlap,
                "iterations": estimate.iterations,
                "objective": estimate.objective,
                **{f"seconds_{stage}": value for stage, value in estimate.seconds.items()},
            }
            rows.append(row)
        elif name != GARPS:
            began = time.perf_counter()
            T, reason = METHODS[name](pair.source, pair.target, T_start)
            rows.append(_row(pair, start, name, T, time.perf_counter() - began, reason))
    return rows


def run_garps(config: Config, pair: Pair, start: str, prior: Prior | None) -> tuple[PoseEstimate, float]:
    """GARPS from one kind of start: the estimate and its wall time in s."""
    method = {"features": "features", "identity": "identity", "disturbed": "auto"}[start]
    config = config.replace({"start.method": method})
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


def _settings(preset: str | None, changes: Sequence[str], monocular: bool) -> Config:
    return changed_config(Config.preset(preset or ("monocular" if monocular else "sensor")), changes)


def main(
    sets: Annotated[str, typer.Option(help="comma-separated; default: all that are there")] = "",
    preset: Annotated[str | None, typer.Option(help="of GARPS; default: sensor, or monocular with --monocular")] = None,
    starts: Annotated[str, typer.Option(help="comma-separated from features, disturbed, identity")] = "",
    methods: Annotated[str, typer.Option(help=f"comma-separated from garps, {', '.join(METHODS)}")] = "",
    monocular: Annotated[bool, typer.Option(help="spoil the depth as a metric monocular network would")] = False,
    limit: Annotated[int | None, typer.Option(help="at most so many pairs of a set, spread evenly")] = None,
    full: Annotated[bool, typer.Option(help="all peers unless given")] = False,
    change: Annotated[list[str] | None, typer.Option(help='setting of GARPS, as "alignment.information=100"')] = None,
    data: Annotated[Path, typer.Option(help="folder that holds dev/<set>/pairs.json")] = DATA,
    out: Annotated[Path, typer.Option(help="where rows and tables go")] = Path("out/rgbd"),
    seed: Annotated[int, typer.Option(help="of disturbances and spoilt depth")] = 0,
) -> None:
    """Accuracy on real RGB-D pairs."""
    console = Console(width=None if sys.stdout.isatty() else TABLE_WIDTH)
    names = sets.split(",") if sets else available(data)
    if not names:
        console.print(f"no data under {data / 'dev'}: give its folder with --data")
        raise typer.Exit(2)
    default_methods = (GARPS, *METHODS) if full else (GARPS, *PEERS)
    config, rows = _settings(preset, change or [], monocular), []
    facts = {"depth": "monocular-like" if monocular else "sensor", "seed": seed, **machine_facts()}
    for name in names:
        pairs = load_pairs(name, data, limit)
        if monocular:
            pairs = [with_monocular_depth(pair, seed) for pair in pairs]
        for start in starts.split(",") if starts else STARTS:
            chosen = methods.split(",") if methods else list(default_methods)
            # Compiles, so that no pair's time holds it.
            run_garps(config, pairs[0], "disturbed", disturbed_prior(pairs[0]))
            bar = lambda part: track(part, f"{name}, {start}", console=console)  # noqa: B023, E731
            rows += evaluate(config, pairs, start, chosen, seed, bar)
            write(out, rows, facts | {"settings": config.settings()})
    print_tables(console, summarise(rows))
    console.print(f"rows and tables: {out}")


if __name__ == "__main__":
    typer.run(main)
