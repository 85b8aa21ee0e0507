# SPDX-License-Identifier: Apache-2.0
"""Maximum a posteriori alignment by damped second-order steps over an annealing ladder.

    maximise  information * L(T) - r' Lambda_0 r / 2,     r = log(T T_0^-1) as a left twist

L is the mean of the objective seen from the source and from the target, so swapping the views gives the inverse
pose. Lambda_0 is the inverse covariance of the initial pose, converted to the left twist.
"""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace

import numpy as np

from garps_core.config import Alignment, Rung
from garps_core.geometry import Array, displacement, se3_inverse, se3_log, skew
from garps_core.objective.packed import unpack
from garps_core.objective.pairs import DeviceMixture, pair_up, thin, visible
from garps_core.objective.shape import Evaluation, Pairs
from garps_core.objective.state import State, WeightedStart
from garps_core.objective.with_depth_errors import corrected, evaluate_at, two_sided

_SECOND_DIRECTION = ThreadPoolExecutor(1, thread_name_prefix="second_direction")
"""Compiled loops release the interpreter: target to source is computed beside source to target."""
MIN_ROWS = 50
SMALLEST_CURVATURE = 0.1
"""Steps are at most this much (its inverse) longer than Gauss-Newton's: further, the curvature is not to be trusted."""
FINAL_ROWS, FINAL_NEIGHBOURS, FINAL_DENSITY = 800, 50, 2.0
"""Pairs on which covariance and verdict rest: with few or sparse partners, cut-off kernels look like information."""
FOOTPRINT_M = 3.2e-3
"""Typical sigma of a component across its ray: compares a blur, in metres, with a scale."""
ENTRY_WIDTH = 0.7
"""A rung is skipped when the next one's kernels are still wider than this many times the start's uncertainty."""


@dataclass(frozen=True)
class Posterior:
    """Log posterior at a pose with its derivatives over a left twist, and the data term alone."""

    value: float
    gradient: Array
    information: Array
    data: Evaluation


@dataclass(frozen=True)
class Solution:
    """Where the solver stopped."""

    at: State
    posterior: Posterior
    iterations: int
    converged: bool
    weight: float
    """What the data term was multiplied with: effective number of independent measurements of the last rung."""
    data: Evaluation
    """The data term at T, for the covariance and the verdict."""
    pairs: tuple[Pairs, Pairs] | None = None
    """What `data` was evaluated on: source rows to target partners, and target rows to source partners."""

    @property
    def T(self) -> Array:
        """4x4 pose."""
        return self.at.T


def two_way(forward: Pairs, backward: Pairs, at: State) -> Evaluation:
    """Mean of the "log" objective of source rows moved by T and of target rows moved by T^-1, over the state's step."""
    other = _SECOND_DIRECTION.submit(evaluate_at, backward, at, True)
    return two_sided(evaluate_at(forward, at), other.result(), at.T)


BERNOULLI = (1 / 12, -1 / 720, 1 / 30240, -1 / 1209600, 1 / 47900160)
"""Coefficients of ad^2, ad^4 ... in x / (e^x - 1) + x / 2 - 1; with these the error is below 1e-5 up to 2 rad."""


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
    """Observed information, kept between `smallest` and 1 times the Gauss-Newton information per direction.

    Gauss-Newton holds the assignment of partners fixed and so takes steps that are too short (expectation
    maximisation); the observed information knows that partners change, but may be indefinite far from the optimum.
    Directions that keep less than the share `open_below` are given `smallest`.
    """
    values, half, scale = _shares(data)
    half = half * np.sqrt(np.where(values < open_below, smallest, np.clip(values, smallest, 1.0)))
    return np.asarray((half @ half.T) / np.outer(scale, scale))


def _shares(data: Evaluation) -> tuple[Array, Array, Array]:
    """Eigenvalues of the observed in units of the Gauss-Newton information, their directions, and the scaling used."""
    scale = 1.0 / np.sqrt(np.maximum(np.diag(data.information), 1e-12))
    floor = (1e-9 if len(scale) == 6 else 1e-6) * np.eye(len(scale))  # depth errors and pose are hardly told apart
    L = np.linalg.cholesky(data.information * np.outer(scale, scale) + floor)
    inner = np.linalg.solve(L, np.linalg.solve(L, data.observed * np.outer(scale, scale)).T)
    values, vectors = np.linalg.eigh(0.5 * (inner + inner.T))
    return values, L @ vectors, scale


def posterior(data: Evaluation, at: State, known: WeightedStart, weight: float) -> Posterior:
    """Add the prior to `weight` times the data term."""
    r = np.concatenate([se3_log(at.T @ se3_inverse(known.T)), at.errors])
    J, precision = np.eye(len(r)), known.joint()
    J[:6, :6] = inverse_left_jacobian(r[:6])
    return Posterior(
        weight * data.value - 0.5 * float(r @ precision @ r),
        weight * data.gradient - J.T @ precision @ r,
        weight * curvature(data) + J.T @ precision @ J,
        data,
    )


@dataclass(frozen=True)
class Ascent:
    """Where one rung ended."""

    at: State
    posterior: Posterior
    iterations: int
    converged: bool


def ascend(function: Callable[[State], Posterior], at: State, steps: int, tolerance: float) -> Ascent:
    """Levenberg-damped ascent: at most `steps` evaluations after the first, never downhill.

    Stops when the undamped step is shorter than `tolerance` in its own metric, sqrt(step' H step): its size in sigmas.
    """
    here = function(at)
    floor = 1e-12 * np.eye(len(here.gradient))
    damping, used = 1e-3, 0
    while used < steps:
        H = here.information
        if float(here.gradient @ np.linalg.solve(H + floor, here.gradient)) < tolerance**2:
            return Ascent(at, here, used, True)
        step = np.linalg.solve(H + damping * np.diag(np.diag(H)) + floor, here.gradient)
        candidate = at.moved(np.asarray(step, np.float64))
        there = function(candidate)
        used += 1
        if there.value >= here.value:
            at, here, damping = candidate, there, max(damping * 0.2, 1e-6)
        else:
            damping = max(damping, 1e-3) * 10
    return Ascent(at, here, used, False)


def rung_pairs(
    source: DeviceMixture, target: DeviceMixture, T: Array, rung: Rung, settings: Alignment, density: float
) -> tuple[Pairs, Pairs] | None:
    """Pairs in both directions among the components that both cameras see under T; None when too few are left.

    Rows are thinned to the rung's components, partners only to the rung's resolution: a covariance scaled by s covers
    s components, and `density` partners are kept for each such kernel. Two equally thin mixtures would be two grids,
    and a textureless wall would snap from grid to grid.
    """
    back = se3_inverse(T)
    x, y = _at_resolution(source, rung, density), _at_resolution(target, rung, density)
    hidden_beyond = rung.occlusion_ratio or settings.occlusion_ratio
    x_seen = x.take(visible(x, T, target.frustum, hidden_beyond))
    y_seen = y.take(visible(y, back, source.frustum, hidden_beyond))
    x_rows = thin(x_seen, int(np.ceil(len(x_seen) * min(1.0, rung.components / len(x)))))
    y_rows = thin(y_seen, int(np.ceil(len(y_seen) * min(1.0, rung.components / len(y)))))
    if min(len(x_rows), len(y_rows)) < MIN_ROWS:
        return None
    other = _SECOND_DIRECTION.submit(pair_up, y_rows, x_seen, back, rung, settings)
    return pair_up(x_rows, y_seen, T, rung, settings), other.result()


def _at_resolution(cloud: DeviceMixture, rung: Rung, density: float) -> DeviceMixture:
    return thin(cloud, max(rung.components, int(density * len(cloud) / max(rung.covariance_scale, 1.0))))


def entry(source: DeviceMixture, T: Array, covariance: Array, ladder: tuple[Rung, ...]) -> int:
    """Index of the first rung worth running: a precise start needs no wide kernels.

    covariance is the start's, over the left twist. Its effect on the source points is compared with the rungs' widths.
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


def anneal(source: DeviceMixture, target: DeviceMixture, known: WeightedStart, settings: Alignment) -> list[Solution]:
    """Run the ladder from what is known beforehand: one solution, none when a rung finds too few visible components."""
    covariance = np.asarray(np.linalg.inv(known.precision), np.float64)
    at = State(known.T, np.zeros(len(known.error_precision)))
    rungs = settings.ladder[entry(source, known.T, covariance, settings.ladder) :]
    solution = run_ladder(source, target, at, known, rungs, settings)
    return [] if solution is None else [with_final_pairs(solution, source, target, settings)]


def run_ladder(
    source: DeviceMixture,
    target: DeviceMixture,
    at: State,
    known: WeightedStart,
    rungs: tuple[Rung, ...],
    settings: Alignment,
) -> Solution | None:
    """Ascent on one rung after the other, each on pairs chosen where the last one ended."""
    used, solution = 0, None
    for rung in rungs:
        pairs = pairs_at(source, target, at, rung, settings, settings.partner_density)
        if pairs is None:
            return None
        weight = settings.effective_measurements * data_weight(rung)

        def function(
            there: State, pairs: tuple[Pairs, Pairs] = pairs, weight: float = weight, base: State = at
        ) -> Posterior:
            return posterior(two_way(*pairs, relative_to(there, base)), there, known, weight)

        end = ascend(function, at, rung.steps, settings.tolerance)
        at, used = end.at, used + end.iterations
        solution = Solution(at, end.posterior, used, end.converged, weight, end.posterior.data)
    return solution


def relative_to(at: State, base: State) -> State:
    """The state as pairs that are corrected by the errors of `base` see it."""
    return State(at.T, at.errors - base.errors)


def data_weight(rung: Rung) -> float:
    """How much a rung's data term counts: wider kernels anneal, they do not measure less."""
    return max(rung.covariance_scale, (0.5 * rung.blur_m / FOOTPRINT_M) ** 2)


def pairs_at(
    source: DeviceMixture, target: DeviceMixture, at: State, rung: Rung, settings: Alignment, density: float
) -> tuple[Pairs, Pairs] | None:
    """`rung_pairs` of the clouds as the state's errors correct them."""
    half = len(at.errors) // 2
    x, y = corrected(source, at.errors[:half]), corrected(target, at.errors[half:])
    return rung_pairs(x, y, at.T, rung, settings, density)


def with_final_pairs(solution: Solution, source: DeviceMixture, target: DeviceMixture, settings: Alignment) -> Solution:
    """The solution with its last rung's data seen again at the final pose, with many partners per row."""
    rung = replace(settings.ladder[-1], components=FINAL_ROWS, neighbours=FINAL_NEIGHBOURS)
    pairs = pairs_at(source, target, solution.at, rung, settings, FINAL_DENSITY)
    if pairs is None:
        return solution
    here = relative_to(solution.at, solution.at)
    return replace(
        solution, pairs=pairs, data=two_way(*pairs, here), weight=settings.effective_measurements * data_weight(rung)
    )
