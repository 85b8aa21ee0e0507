# SPDX-License-Identifier: Apache-2.0
"""The default solver against the published one: on this package's kernel, and as a plain autograd script."""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
import torch
from scipy.spatial.transform import Rotation
from torch import Tensor

from bench.peers.autograd import PlainObjective
from bench.report.checks import Check, Row, Section
from bench.speed.parts import Inputs, interleaved, medians, threads
from garps_core import Config, Mixture, PoseEstimate, Prior, align_mixtures, metrics
from garps_core.checks import Float64Array
from garps_core.config import Rung
from garps_core.objective.packed import unpack
from garps_core.objective.pairs import to_device
from garps_core.objective.shape import Pairs, evaluate
from garps_core.objective.state import State, WeightedStart
from garps_core.solver import ladder, paper
from garps_core.solver.problem import Problem

PAPER_BAR, AUTOGRAD_BAR = 40.0, 200.0
PLAIN_STEPS = 5
"""Steps of the autograd reference that are timed; the rest is extrapolated."""
DEFAULT, PAPER = "second order", "paper"
SAME = "second order, the paper's objective and pairs"
SAME_STEPS = 100


@dataclass(frozen=True)
class Contest:
    """Both solvers with equal components: only the weights are each preset's own (area seen; one per component)."""

    mixtures: dict[str, tuple[Mixture, Mixture]]
    configs: dict[str, Config]
    prior: Prior

    def align(self, name: str) -> PoseEstimate:
        """Run one solver. Raises RuntimeError when it finds no pose."""
        estimate = align_mixtures(*self.mixtures[name], self.prior, self.configs[name])
        if estimate.T_target_source is None:
            raise RuntimeError(f"the {name} solver found no pose on this pair ({estimate.reason}): give another pair")
        return estimate

    def paper_pairs(self) -> Pairs:
        """Pairs of the paper's solver. Raises RuntimeError when too few are left."""
        config = self.configs[PAPER]
        source, target = (to_device(mixture, config) for mixture in self.mixtures[PAPER])
        pairs = paper.paper_pairs(source, target, self.prior.T_target_source, config.paper)
        if pairs is None:
            raise RuntimeError("the paper's preset keeps fewer than 50 components of this pair: give a larger one")
        return pairs

    def same_problem(self) -> Float64Array:
        """End pose of the default solver's steps on what the paper's solver works on: its objective, its pairs."""
        pairs, start = self.paper_pairs(), State(self.prior.T_target_source)
        weak = WeightedStart(start.T, 1e-9 * np.eye(6))

        def function(at: State) -> ladder.Posterior:
            return ladder.posterior(evaluate(pairs, at.T, "sum"), at, weak, 1.0)

        return ladder.ascend(function, start, SAME_STEPS, 1e-3).at.T

    def published(self) -> Float64Array:
        """End pose of the paper's steps on the same, pairs chosen anew as above."""
        settings = self.configs[PAPER].paper
        return paper.adam_path(self.paper_pairs(), self.prior.T_target_source, settings, settings.steps)[-1]

    def rung_pairs(self, rung: Rung, T: Float64Array) -> tuple[Pairs, Pairs]:
        """Pairs of the default solver at pose T in one rung. Raises RuntimeError when too few are left."""
        config = self.configs[DEFAULT]
        source, target = (to_device(mixture, config) for mixture in self.mixtures[DEFAULT])
        with ThreadPoolExecutor(1) as pool:
            problem = Problem(source, target, WeightedStart(T, np.eye(6)), config, pool)
            pairs = ladder.rung_pairs(problem, T, rung, config.alignment.partner_density)
        if pairs is None:
            raise RuntimeError("fewer than 50 components are seen by both views: give another pair")
        return pairs


def contest(inputs: Inputs, steps: int | None = None) -> Contest:
    """Both solvers on the first pair; `steps` of Adam instead of the published 1000 (for a quick test)."""
    published = Config.preset("paper")
    if steps is not None:
        published = published.replace({"paper.steps": steps})
    lifted = inputs.mixtures
    equal = tuple(replace(mixture, weights=np.ones_like(mixture.weights)) for mixture in lifted)
    mixtures = {DEFAULT: lifted, PAPER: (equal[0], equal[1])}
    return Contest(mixtures, {DEFAULT: inputs.config, PAPER: published}, inputs.prior)


def paper_section(inputs: Inputs, steps: int | None = None) -> Section:
    """Times of both solvers on one kernel, and both objectives at both end poses."""
    held = contest(inputs, steps)
    ends: dict[str, PoseEstimate] = {name: held.align(name) for name in (DEFAULT, PAPER)}
    calls: dict[str, Callable[[], object]] = {name: partial(held.align, name) for name in ends}
    calls |= {SAME: held.same_problem, "the paper's steps alone": held.published}
    times = interleaved(calls, inputs.runs, "paper's solver", inputs.console)
    median = medians(times)
    same = evaluate(held.paper_pairs(), held.same_problem(), "sum").value
    values = objectives(held, ends)
    rows = [_row(name, ends[name], median[name], values[name], inputs) for name in ends]
    rows += [{"solver": name, "median s": median[name]} for name in calls if name not in ends]
    rows[2]["paper's log f"] = same
    alone = median["the paper's steps alone"] / median[SAME]
    gains = [values[DEFAULT][i] - values[PAPER][i] for i in (0, 1)]
    checks = [
        Check(
            "the paper's steps / the default solver's steps, same objective, pairs and kernel", alone, PAPER_BAR, True
        ),
        Check("gain of the default solver's steps in that objective", same - values[PAPER][0], 0.0, True),
        Check("preset paper / preset sensor, whole alignment", median[PAPER] / median[DEFAULT], PAPER_BAR, True),
        Check("gain of the default in the paper's log f, at the paper's pairs", gains[0], 0.0, True),
        Check("gain of the default in its own objective, at its last rung's pairs", gains[1], 0.0, True),
    ]
    return Section("The paper's solver on the same kernel", checks, rows, _sizes(held, ends), times)


def objectives(held: Contest, ends: dict[str, PoseEstimate]) -> dict[str, tuple[float, float]]:
    """By solver: the paper's log f (pairs chosen at the start), and the default's two-way objective, at its end pose.

    The second is taken on the pairs of the default's last rung, chosen at the default's end pose, for both.
    """
    one_way = held.paper_pairs()
    both_ways = held.rung_pairs(held.configs[DEFAULT].alignment.ladder[-1], pose_of(ends[DEFAULT]))
    with ThreadPoolExecutor(1) as pool:
        return {
            name: (
                evaluate(one_way, pose_of(end), "sum").value,
                ladder.two_way(*both_ways, State(pose_of(end)), pool).value,
            )
            for name, end in ends.items()
        }


def pose_of(end: PoseEstimate) -> Float64Array:
    """The pose of an estimate that has one. Raises ValueError otherwise."""
    if end.T_target_source is None:
        raise ValueError("the estimate has no pose: expected one that converged")
    return end.T_target_source


def _row(name: str, end: PoseEstimate, seconds: float, values: tuple[float, float], inputs: Inputs) -> Row:
    pair = inputs.pairs[0]
    row = {"solver": name, "median s": seconds, "steps": end.iterations, "paper's log f": values[0]}
    row |= {"two-way objective": values[1], "status": end.status.value}
    return row | {"E_3D m": metrics.error_3d_m(pose_of(end), pair.T_target_source, pair.points)}


def _sizes(held: Contest, ends: dict[str, PoseEstimate]) -> list[str]:
    """Components and pairs that each solver uses, as its preset says."""
    one_way, ladder = held.paper_pairs(), held.configs[DEFAULT].alignment.ladder
    notes = [f"mixtures: {' and '.join(str(len(m)) for m in held.mixtures[DEFAULT])} components, the same for both"]
    notes.append(f"paper: {len(one_way.means)} rows, {one_way.count} pairs, one way")
    for rung in ladder:
        pairs = held.rung_pairs(rung, pose_of(ends[DEFAULT]))
        rows = " + ".join(str(len(part.means)) for part in pairs)
        count = sum(part.count for part in pairs)
        notes.append(f"second order, covariances x {rung.covariance_scale:g}: {rows} rows, {count} pairs, both ways")
    return [*notes, "rungs with kernels far wider than the start's uncertainty are skipped"]


def autograd_section(inputs: Inputs, steps: int | None = None) -> Section:
    """The default solver against the plain script, which gets the number of threads that serves it best."""
    held = contest(inputs, steps)
    wanted = held.configs[PAPER].paper.steps
    objective = plain(held.paper_pairs())
    q, t = start_of(held.prior, objective.means.dtype)

    def plain_steps(count: int) -> None:
        with threads(count):
            objective.path(q, t, PLAIN_STEPS)

    counts = sorted({1, torch.get_num_threads()})
    calls: dict[str, Callable[[], object]] = {f"autograd, {n} threads": partial(plain_steps, n) for n in counts}
    calls[DEFAULT] = partial(held.align, DEFAULT)
    times = interleaved(calls, inputs.runs, "autograd", inputs.console)
    median = medians(times)
    each = {name: median[name] / PLAIN_STEPS for name in calls if name != DEFAULT}
    rows: list[Row] = [{"what": name, "s a step": step, "median s": step * wanted} for name, step in each.items()]
    rows.append({"what": DEFAULT, "median s": median[DEFAULT]})
    ratio = min(each.values()) * wanted / median[DEFAULT]
    checks = [
        Check("plain autograd script of the paper's solver / the default solver, time", ratio, AUTOGRAD_BAR, True)
    ]
    notes = [f"autograd: {len(objective)} pairs, {PLAIN_STEPS} steps timed and extrapolated to {wanted}"]
    return Section("A plain autograd script of the paper's solver", checks, rows, notes, times)


def plain(pairs: Pairs) -> PlainObjective:
    """Candidate pairs gathered one by one, for the reference."""
    k, n = pairs.log_weights.shape
    weights = (pairs.log_weights.exp() * pairs.weights).reshape(k * n)
    kept = weights > 0

    def flat(planes: Tensor) -> Tensor:
        return planes.reshape(len(planes), k * n).T[kept]

    return PlainObjective(
        pairs.means.repeat(k, 1)[kept],
        unpack(pairs.covariances).repeat(k, 1, 1)[kept],
        flat(pairs.partner_means).contiguous(),
        unpack(flat(pairs.partner_covariances)),
        weights[kept],
    )


def start_of(prior: Prior, dtype: torch.dtype) -> tuple[Tensor, Tensor]:
    """Quaternion (w, x, y, z) and translation (m) of the start."""
    T = prior.T_target_source
    q = np.roll(Rotation.from_matrix(T[:3, :3]).as_quat(), 1)
    return torch.as_tensor(q, dtype=dtype), torch.as_tensor(T[:3, 3].copy(), dtype=dtype)
