# SPDX-License-Identifier: Apache-2.0
"""Growth of the cost with the number of components and of neighbours, all components used."""

from __future__ import annotations

import itertools
import time
from collections.abc import Callable
from typing import TypeVar

import numpy as np
from rich.progress import track

from bench.report.checks import Check, Row, Section
from bench.speed.fresh import STEPS, all_used
from bench.speed.parts import Inputs, lifted, threads
from garps_core import Mixture, align_mixtures
from garps_core.config import Rung
from garps_core.objective.pairs import pair_up, to_device
from garps_core.objective.shape import evaluate

Found = TypeVar("Found")
COMPONENTS = (1000, 3000, 10_000, 30_000, 100_000)
NEIGHBOURS = (10, 20, 40)
BAR = 1.2
"""Largest slope that is called linear; n log n has about 1.1 over these sizes."""
STAGES = ("evaluate", "pairing", "align")
ROUNDS, EVALUATIONS = 3, 5
LARGEST = 3
"""Slopes are fitted over this many of the largest sizes: among small ones fixed costs would pass for slow growth."""


def growth_section(
    inputs: Inputs, components: tuple[int, ...] = COMPONENTS, neighbours: tuple[int, ...] = NEIGHBOURS
) -> Section:
    """Seconds of one evaluation, of one pairing and of a whole alignment for every size, and the fitted slopes."""
    full = fine_mixtures(inputs)
    sizes = list(itertools.product(components, neighbours))
    measure(full, *sizes[0], inputs)  # warm-up
    rounds = min(ROUNDS, inputs.runs)
    turns = track(sizes * rounds, "growth", console=inputs.console)  # all sizes in turn: a busy spell hits all alike
    measured = [measure(full, n, k, inputs) for n, k in turns]
    rows = [_median_row(measured[i :: len(sizes)]) for i in range(len(sizes))]
    checks = []
    for stage in STAGES:
        by_components, by_neighbours = slopes(rows, stage)
        checks.append(Check(f"{stage}: growth with components, 1 = linear", by_components, BAR))
        checks.append(Check(f"{stage}: growth with neighbours, 1 = linear", by_neighbours, BAR))
    notes = [
        f"log time = a + p log components + q log neighbours, fitted over the {LARGEST} largest numbers of components",
        f"medians of {rounds} rounds through all sizes; evaluate and pairing: one way, n rows with k of n partners",
        f"align: both ways, every rung with all components, {STEPS} steps each",
    ]
    return Section("Growth of the cost, s", checks, rows, notes)


def fine_mixtures(inputs: Inputs) -> tuple[Mixture, Mixture]:
    """The first pair with one component a pixel, to have enough of them."""
    return lifted(inputs.pairs[0], inputs.config.replace({"lifting.stride": 1}))


def subset(mixture: Mixture, n: int) -> Mixture:
    """An even subsample of exactly n. Raises ValueError when there are fewer."""
    if len(mixture) < n:
        raise ValueError(f"the mixture has {len(mixture)} components, {n} are wanted: give larger images")
    return mixture.subset(np.arange(n) * len(mixture) // n)


def measure(full: tuple[Mixture, Mixture], n: int, k: int, inputs: Inputs) -> Row:
    """Seconds of the three stages with n components and k neighbours, once each (evaluation: the median of a few)."""
    source, target = (subset(mixture, n) for mixture in full)
    config, T = all_used(inputs.config, n, k), inputs.prior.T_target_source
    x, y = (to_device(mixture, config) for mixture in (source, target))
    rung = Rung(covariance_scale=config.alignment.ladder[-1].covariance_scale, components=n, neighbours=k)
    row: Row = {"components": n, "neighbours": k}
    with threads(1):
        row["pairing"], pairs = timed(lambda: pair_up(x, y, T, rung, config.alignment))
        row["evaluate"] = float(np.median([timed(lambda: evaluate(pairs, T, "log"))[0] for _ in range(EVALUATIONS)]))
    row["align"], estimate = timed(lambda: align_mixtures(source, target, inputs.prior, config))
    return row | {"steps": estimate.iterations}


def timed(call: Callable[[], Found]) -> tuple[float, Found]:
    """Seconds that a call took, and what it gave."""
    began = time.perf_counter()
    found = call()
    return time.perf_counter() - began, found


def slopes(rows: list[Row], stage: str) -> tuple[float, float]:
    """Exponents (p, q) of time ~ components^p neighbours^q, fitted over the largest sizes."""
    largest = sorted({row["components"] for row in rows})[-LARGEST:]
    used = [row for row in rows if row["components"] in largest]
    terms = [[1.0, np.log(row["components"]), np.log(row["neighbours"])] for row in used]
    fit = np.linalg.lstsq(np.array(terms), np.log([row[stage] for row in used]), rcond=None)[0]
    return float(fit[1]), float(fit[2])


def _median_row(rows: list[Row]) -> Row:
    """One row of a size's rounds."""
    row = {name: rows[0][name] for name in ("components", "neighbours", "steps")}
    row |= {stage: float(np.median([r[stage] for r in rows])) for stage in STAGES}
    return row | {"evaluate ns a pair": row["evaluate"] / (row["components"] * row["neighbours"]) * 1e9}
