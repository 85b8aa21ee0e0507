# SPDX-License-Identifier: Apache-2.0
"""Wall time of a whole pair from its images, against peers on the same images."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from bench.pairs.pair import Pair
from bench.pairs.starts import disturbed_prior
from bench.peers.methods import METHODS
from bench.report.checks import Check, Row, Section
from bench.speed.parts import Inputs, interleaved, medians
from garps_core import Config, PoseEstimate, Prior, estimate_relative_pose, metrics
from garps_core.checks import Float64Array

GARPS, GARPS_PRIOR, CHAIN = "garps", "garps, start given", "sift-pnp+small-gicp"
PEERS = ("open3d-colored", "open3d-colored-fast", "small-gicp", "sift-pnp", CHAIN)
BAR = 1.0
Call = Callable[[], Float64Array | None]


def pairs_section(inputs: Inputs) -> Section:
    """Every method on every pair, from the images: lifting, features, clouds, voxels and normals inside."""
    checks, rows, notes, raw = [], [], [], []
    for pair in inputs.pairs:
        measured = measure(pair, inputs.config, inputs.runs, inputs)
        median = {row["method"]: float(np.median(row["times"])) for row in measured}
        checks.append(
            Check(f"{pair.set}: GARPS from images / SIFT + PnP, then GICP", median[GARPS] / median[CHAIN], BAR)
        )
        rows += [_line(row, median) for row in measured]
        notes += [_stages(row) for row in measured if row["stages"]]
        raw += measured
    return Section(f"From two images, {inputs.runs} runs", checks, rows, notes, raw)


def measure(pair: Pair, config: Config, runs: int, inputs: Inputs) -> list[Row]:
    """Time every method on one pair, interleaved: rows with the times of all runs (s) and the last pose's error."""
    prior = disturbed_prior(pair)
    last: dict[str, Float64Array | None] = {}
    estimates: dict[str, list[PoseEstimate]] = {GARPS: [], GARPS_PRIOR: []}
    calls = _calls(pair, config, prior, estimates)

    def keeping(name: str) -> Callable[[], None]:
        return lambda: last.__setitem__(name, calls[name]())

    times = interleaved({name: keeping(name) for name in calls}, runs, pair.set, inputs.console)
    rows: list[Row] = []
    for name in calls:
        timed = estimates.get(name, [])[1:]  # the first was the warm-up
        stages = {stage: [e.seconds[stage] for e in timed] for stage in (timed[0].seconds if timed else ())}
        rows.append({"pair": pair.id, "set": pair.set, "method": name, "times": times[name], "stages": stages})
        rows[-1]["e_3d_m"] = _error(last[name], pair)
    return rows


def _calls(pair: Pair, config: Config, prior: Prior, estimates: dict[str, list[PoseEstimate]]) -> dict[str, Call]:
    def garps(name: str, given: Prior | None) -> Call:
        def call() -> Float64Array | None:
            estimates[name].append(estimate_relative_pose(pair.source, pair.target, config, given))
            return estimates[name][-1].T_target_source

        return call

    def peer(name: str) -> Call:
        return lambda: METHODS[name](pair.source, pair.target, prior.T_target_source).T

    calls = {GARPS: garps(GARPS, None), GARPS_PRIOR: garps(GARPS_PRIOR, prior)}
    return calls | {name: peer(name) for name in PEERS}


def _error(T: Float64Array | None, pair: Pair) -> float:
    return float("inf") if T is None else metrics.error_3d_m(T, pair.T_target_source, pair.points)


def _line(row: Row, median: dict[str, float]) -> Row:
    own = median[row["method"]]
    line = {"method": row["method"], "set": row["set"], "median s": own, "best s": min(row["times"])}
    line |= {f"x {name}": own / median[name] for name in (GARPS, GARPS_PRIOR)}
    return line | {"E_3D m": row["e_3d_m"]}


def _stages(row: Row) -> str:
    stages = ", ".join(f"{stage} {seconds * 1e3:.0f} ms" for stage, seconds in medians(row["stages"]).items())
    return f"{row['set']}, {row['method']}: {stages}"
