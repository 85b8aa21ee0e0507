# SPDX-License-Identifier: Apache-2.0
"""Maximum a posteriori alignment: Levenberg-Marquardt steps over an annealing ladder.

    maximise  weight * L(T) - r' Lambda_0 r / 2,     r = log(T T_0^-1) as a left twist

L is the mean of the objective seen from the source and from the target, so swapping the views gives the inverse
pose. Lambda_0 is the inverse covariance of the start T_0, converted to the left twist. The weight is the number of
effective measurements (`data_weight`).
"""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import Executor
from dataclasses import dataclass, replace

import numpy as np

from garps_core.config import Rung
from garps_core.geometry import Array, displacement, se3_inverse, se3_log, skew
from garps_core.objective.packed import unpack
from garps_core.objective.pairs import DeviceMixture, pair_up, thin, visible
from garps_core.objective.shape import Evaluation, Pairs
from garps_core.objective.state import State, WeightedStart
from garps_core.objective.with_depth_errors import corrected, evaluate_at, two_sided
from garps_core.solver.problem import Problem

MIN_ROWS = 50
"""Fewest components that both cameras see, per view, on which a pose may rest."""
SMALLEST_CURVATURE = 0.1
"""Lower bound on observed / Gauss-Newton curvature; a step is at most 10 times a Gauss-Newton step."""
FINAL_ROWS, FINAL_NEIGHBOURS, FINAL_DENSITY = 800, 50, 2.0
"""Size of the pairs on which covariance and verdict rest; with few or sparse partners, cut-off kernels look like
information."""
FOOTPRINT_M = 3.2e-3
"""Typical sigma of a component across its ray (m); it makes a blur comparable with a covariance scale."""
ENTRY_WIDTH = 0.7
"""A rung is skipped if the kernels of the next one are wider than this many sigmas of the start."""
FIRST_DAMPING, SMALLEST_DAMPING = 1e-3, 1e-6
"""Levenberg-Marquardt damping, as a share of the curvature's diagonal."""
GROWTH, DECAY = 10, 0.2
"""Factors on the damping after a rejected and after an accepted step."""


@dataclass(frozen=True)
class Posterior:
    """Log posterior at a state with gradient and curvature over the state's step, and the data term alone."""

    value: float
    gradient: Array
    information: Array
    data: Evaluation


@dataclass(frozen=True)
class Solution:
    """A state at which a solver stopped."""

    at: State
    posterior: Posterior
    iterations: int
    converged: bool
    weight: float
    """Factor on the data term: the effective number of independent measurements on the last rung."""
    data: Evaluation
    """The data term at T, for the covariance and the verdict."""
    pairs: tuple[Pairs, Pairs] | None = None
    """Pairs on which `data` was evaluated: source rows to target partners, and target rows to source partners."""
    fixed_steps: bool = False
    """The method takes a fixed number of steps and has no test of convergence."""

    @property
    def T(self) -> Array:
        """4x4 pose."""
        return self.at.T


def two_way(forward: Pairs, backward: Pairs, at: State, pool: Executor) -> Evaluation:
    """Mean of the "log" objective of source rows moved by T and of target rows moved by T^-1, over the state's step."""
    other = pool.submit(evaluate_at, backward, at, True)
    return two_sided(evaluate_at(forward, at), other.result(), at.T)


BERNOULLI = (1 / 12, -1 / 720, 1 / 30240, -1 / 1209600, 1 / 47900160)
"""Coefficients of ad^2, ad^4 ... in x / (e^x - 1) + x / 2 - 1; the error is below 1e-5 up to 2 rad."""


def inverse_left_jacobian(twist: Array) -> Array:
    """6x6 d log(exp(x) exp(twist)) / dx at x = 0, by its Bernoulli series in the twist's adjoint."""
    ad = np.zeros((6, 6))
    ad[:3, :3] = ad[3:, 3:] = skew(twist[3:])
    ad[:3, 3:] = skew(twist[:3])
    square, power = ad @ ad, np.eye(6)
    J = np.eye(6) - 0.5 * ad
    for coefficient in BERNOULLI:
        power = power @ square
        J += coefficient * power
    return np.asarray(J)


def curvature(data: Evaluation, smallest: float = SMALLEST_CURVATURE, open_below: float = -np.inf) -> Array:
    """Observed information, clipped per direction to between `smallest` and 1 times the Gauss-Newton information.

    Gauss-Newton holds the assignment of partners fixed (expectation maximisation), so its steps are too short. The
    observed information includes the change of partners, but may be indefinite far from the optimum.
    A direction whose share is less than `open_below` gets `smallest`.
    """
    values, half, scale = _shares(data)
    half = half * np.sqrt(np.where(values < open_below, smallest, np.clip(values, smallest, 1.0)))
    return np.asarray((half @ half.T) / np.outer(scale, scale))


def _shares(data: Evaluation) -> tuple[Array, Array, Array]:
    """Eigenvalues of the observed in units of the Gauss-Newton information, their directions, and the scaling used."""
    scale = 1.0 / np.sqrt(np.maximum(np.diag(data.information), 1e-12))
    floor = (1e-9 if len(scale) == 6 else 1e-6) * np.eye(len(scale))  # depth errors and pose are nearly collinear
    L = np.linalg.cholesky(data.information * np.outer(scale, scale) + floor)
    inner = np.linalg.solve(L, np.linalg.solve(L, data.observed * np.outer(scale, scale)).T)
    values, vectors = np.linalg.eigh(0.5 * (inner + inner.T))
    return values, L @ vectors, scale


def posterior(data: Evaluation, at: State, start: WeightedStart, weight: float) -> Posterior:
    """`weight` times the data term plus the Gaussian log prior of the start."""
    r = np.concatenate([se3_log(at.T @ se3_inverse(start.T)), at.errors])
    J, precision = np.eye(len(r)), start.joint()
    J[:6, :6] = inverse_left_jacobian(r[:6])
    return Posterior(
        weight * data.value - 0.5 * float(r @ precision @ r),
        weight * data.gradient - J.T @ precision @ r,
        weight * curvature(data) + J.T @ precision @ J,
        data,
    )


@dataclass(frozen=True)
class Ascent:
    """End of one Levenberg-Marquardt ascent."""

    at: State
    posterior: Posterior
    iterations: int
    converged: bool


def ascend(function: Callable[[State], Posterior], at: State, steps: int, tolerance: float) -> Ascent:
    """Levenberg-Marquardt ascent: at most `steps` evaluations after the first; a step that loses value is rejected.

    It has converged when the undamped Newton step is shorter than `tolerance` in the metric of the curvature,
    sqrt(step' H step): its length in sigmas.
    """
    here = function(at)
    floor = 1e-12 * np.eye(len(here.gradient))
    damping, used = FIRST_DAMPING, 0
    while not (converged := _squared_step(here, floor) < tolerance**2) and used < steps:
        H = here.information
        step = np.linalg.solve(H + damping * np.diag(np.diag(H)) + floor, here.gradient)
        candidate = at.moved(np.asarray(step, np.float64))
        there = function(candidate)
        used += 1
        if there.value >= here.value:
            at, here, damping = candidate, there, max(damping * DECAY, SMALLEST_DAMPING)
        else:
            damping = max(damping, FIRST_DAMPING) * GROWTH
    return Ascent(at, here, used, converged)


def _squared_step(here: Posterior, floor: Array) -> float:
    """Squared length of the undamped Newton step in the metric of the curvature, in sigmas squared."""
    return float(here.gradient @ np.linalg.solve(here.information + floor, here.gradient))


def rung_pairs(problem: Problem, T: Array, rung: Rung, density: float) -> tuple[Pairs, Pairs] | None:
    """Pairs in both directions among the components that both cameras see under T; None when too few are left.

    Rows are thinned to the rung's components. Partners are thinned to the rung's resolution only: a covariance scaled
    by s covers s components, and `density` partners are kept for each such kernel. If both mixtures were equally thin,
    a textureless wall would snap from grid to grid.
    """
    source, target, settings, back = problem.source, problem.target, problem.settings, se3_inverse(T)
    x, y = _at_resolution(source, rung, density), _at_resolution(target, rung, density)
    hidden_beyond = rung.occlusion_ratio or settings.occlusion_ratio
    x_seen = x.take(visible(x, T, target.frustum, hidden_beyond))
    y_seen = y.take(visible(y, back, source.frustum, hidden_beyond))
    x_rows = thin(x_seen, int(np.ceil(len(x_seen) * min(1.0, rung.components / len(x)))))
    y_rows = thin(y_seen, int(np.ceil(len(y_seen) * min(1.0, rung.components / len(y)))))
    if min(len(x_rows), len(y_rows)) < MIN_ROWS:
        return None
    other = problem.pool.submit(pair_up, y_rows, x_seen, back, rung, settings)
    return pair_up(x_rows, y_seen, T, rung, settings), other.result()


def _at_resolution(mixture: DeviceMixture, rung: Rung, density: float) -> DeviceMixture:
    return thin(mixture, max(rung.components, int(density * len(mixture) / max(rung.covariance_scale, 1.0))))


def entry(source: DeviceMixture, T: Array, covariance: Array, ladder: tuple[Rung, ...]) -> int:
    """Index of the first rung to run: a precise start needs no wide kernels.

    `covariance` (6, 6) is the start's, over the left twist. Its effect on the source points is compared with the
    widths of the rungs' kernels.
    """
    few = thin(source, 200)
    points = few.means.double().cpu().numpy() @ T[:3, :3].T + T[:3, 3]
    uncertainty = float(np.sqrt(np.median(np.trace(displacement(points, covariance), axis1=1, axis2=2)) / 3))
    spread = np.linalg.eigvalsh(unpack(few.covariances).double().cpu().numpy())
    width = float(np.sqrt(np.median(spread[:, 1])))  # the footprint, neither the thin normal nor the long ray
    first = 0
    while first + 1 < len(ladder) and ladder[first + 1].covariance_scale ** 0.5 * width > ENTRY_WIDTH * uncertainty:
        first += 1
    return first


def anneal(problem: Problem) -> list[Solution]:
    """Run the ladder from the start: one solution, or none when a rung finds too few visible components."""
    start, ladder = problem.start, problem.settings.ladder
    covariance = np.asarray(np.linalg.inv(start.precision), np.float64)
    rungs = ladder[entry(problem.source, start.T, covariance, ladder) :]
    solution = run_ladder(problem, problem.state(start.T), rungs)
    return [] if solution is None else [with_final_pairs(solution, problem)]


def run_ladder(problem: Problem, at: State, rungs: tuple[Rung, ...]) -> Solution | None:
    """One ascent per rung, each on pairs chosen at the end of the last one; None when too few components are seen."""
    settings = problem.settings
    used, solution = 0, None
    for rung in rungs:
        pairs = pairs_at(problem, at, rung, settings.partner_density)
        if pairs is None:
            return None
        weight = settings.effective_measurements * data_weight(rung)

        def function(
            there: State, pairs: tuple[Pairs, Pairs] = pairs, weight: float = weight, base: State = at
        ) -> Posterior:
            data = two_way(*pairs, relative_to(there, base), problem.pool)
            return posterior(data, there, problem.start, weight)

        end = ascend(function, at, rung.steps, settings.tolerance)
        at, used = end.at, used + end.iterations
        solution = Solution(at, end.posterior, used, end.converged, weight, end.posterior.data)
    return solution


def relative_to(at: State, base: State) -> State:
    """The state relative to pairs that are already corrected by the errors of `base`."""
    return State(at.T, at.errors - base.errors)


def data_weight(rung: Rung) -> float:
    """Factor that keeps the weight of the data against the prior the same on a wide rung as on a narrow one."""
    return max(rung.covariance_scale, (0.5 * rung.blur_m / FOOTPRINT_M) ** 2)


def pairs_at(problem: Problem, at: State, rung: Rung, density: float) -> tuple[Pairs, Pairs] | None:
    """`rung_pairs` of the mixtures after the state's depth errors are corrected."""
    half = len(at.errors) // 2
    x, y = corrected(problem.source, at.errors[:half]), corrected(problem.target, at.errors[half:])
    return rung_pairs(replace(problem, source=x, target=y), at.T, rung, density)


def with_final_pairs(solution: Solution, problem: Problem) -> Solution:
    """The solution with the data term of the last rung evaluated anew at its pose, with many partners per row."""
    pairs = final_pairs(solution.at, problem)
    if pairs is None:
        return solution
    data = two_way(*pairs, relative_to(solution.at, solution.at), problem.pool)
    weight = problem.settings.effective_measurements * data_weight(problem.settings.ladder[-1])
    return replace(solution, pairs=pairs, data=data, weight=weight)


def final_pairs(at: State, problem: Problem) -> tuple[Pairs, Pairs] | None:
    """Pairs of the last rung at a state, with many partners per row; None when too few components are seen."""
    rung = replace(problem.settings.ladder[-1], components=FINAL_ROWS, neighbours=FINAL_NEIGHBOURS)
    return pairs_at(problem, at, rung, FINAL_DENSITY)
