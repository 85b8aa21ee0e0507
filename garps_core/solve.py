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
from garps_core.geometry import Array, adjoint, se3_exp, se3_inverse, se3_log, skew
from garps_core.objective import Evaluation, Pairs, evaluate, unpack
from garps_core.pairing import Cloud, pair_up, thin, visible

_SECOND_DIRECTION = ThreadPoolExecutor(1, thread_name_prefix="second_direction")
"""Compiled loops release the interpreter: target to source is computed beside source to target."""
MIN_ROWS = 50
SMALLEST_CURVATURE = 0.1
"""Steps are at most this much (its inverse) longer than Gauss-Newton's: further, the curvature is not to be trusted."""
FINAL_ROWS, FINAL_NEIGHBOURS, FINAL_DENSITY = 800, 50, 2.0
"""Pairs on which covariance and verdict rest: with few or sparse partners, cut-off kernels look like information."""
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

    T: Array
    posterior: Posterior
    iterations: int
    converged: bool
    weight: float
    """What the data term was multiplied with: effective number of independent measurements of the last rung."""
    data: Evaluation
    """The data term at T, for the covariance and the verdict."""
    pairs: tuple[Pairs, Pairs] | None = None
    """What `data` was evaluated on: source rows to target partners, and target rows to source partners."""


def two_way(forward: Pairs, backward: Pairs, T: Array) -> Evaluation:
    """Mean of the "log" objective of source rows moved by T and of target rows moved by T^-1, over T's left twist."""
    other = _SECOND_DIRECTION.submit(evaluate, backward, se3_inverse(T), "log")
    f = evaluate(forward, T, "log")
    b = other.result()
    A = -adjoint(se3_inverse(T))  # (exp(x) T)^-1 = exp(-Ad(T^-1) x) T^-1
    return Evaluation(
        0.5 * (f.value + b.value),
        0.5 * (f.gradient + A.T @ b.gradient),
        0.5 * (f.information + A.T @ b.information @ A),
        0.5 * (f.observed + A.T @ b.observed @ A),
        0.5 * (f.support + b.support),
    )


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
    L = np.linalg.cholesky(data.information * np.outer(scale, scale) + 1e-9 * np.eye(6))
    inner = np.linalg.solve(L, np.linalg.solve(L, data.observed * np.outer(scale, scale)).T)
    values, vectors = np.linalg.eigh(0.5 * (inner + inner.T))
    return values, L @ vectors, scale


def posterior(data: Evaluation, T: Array, T_prior: Array, precision: Array, weight: float) -> Posterior:
    """Add the prior (precision over the left twist) to `weight` times the data term."""
    r = se3_log(T @ se3_inverse(T_prior))
    J = inverse_left_jacobian(r)
    return Posterior(
        weight * data.value - 0.5 * float(r @ precision @ r),
        weight * data.gradient - J.T @ precision @ r,
        weight * curvature(data) + J.T @ precision @ J,
        data,
    )


@dataclass(frozen=True)
class Climb:
    """Where one rung ended."""

    T: Array
    posterior: Posterior
    iterations: int
    converged: bool


def climb(function: Callable[[Array], Posterior], T: Array, steps: int, tolerance: float) -> Climb:
    """Levenberg-damped ascent: at most `steps` evaluations beyond the first, never downhill.

    Stops when the undamped step is shorter than `tolerance` in its own metric, sqrt(step' H step): its size in sigmas.
    """
    here = function(T)
    damping, used = 1e-3, 0
    while used < steps:
        H = here.information
        if float(here.gradient @ np.linalg.solve(H + 1e-12 * np.eye(6), here.gradient)) < tolerance**2:
            return Climb(T, here, used, True)
        step = np.linalg.solve(H + damping * np.diag(np.diag(H)) + 1e-12 * np.eye(6), here.gradient)
        there_T = se3_exp(np.asarray(step, np.float64)) @ T
        there = function(there_T)
        used += 1
        if there.value >= here.value:
            T, here, damping = there_T, there, max(damping * 0.2, 1e-6)
        else:
            damping = max(damping, 1e-3) * 10
    return Climb(T, here, used, False)


def rung_pairs(
    source: Cloud, target: Cloud, T: Array, rung: Rung, settings: Alignment, density: float
) -> tuple[Pairs, Pairs] | None:
    """Pairs in both directions among the components that both cameras see under T; None when too few are left.

    Rows are thinned to the rung's components, partners only to the rung's resolution: a covariance scaled by s covers
    s components, and `density` partners are kept for each such kernel. Two equally thin mixtures would be two grids,
    and a textureless wall would snap from grid to grid.
    """
    back = se3_inverse(T)
    x, y = _at_resolution(source, rung, density), _at_resolution(target, rung, density)
    x_seen = x.take(visible(x, T, target.frustum, settings.occlusion_ratio))
    y_seen = y.take(visible(y, back, source.frustum, settings.occlusion_ratio))
    x_rows = thin(x_seen, int(np.ceil(len(x_seen) * min(1.0, rung.components / len(x)))))
    y_rows = thin(y_seen, int(np.ceil(len(y_seen) * min(1.0, rung.components / len(y)))))
    if min(len(x_rows), len(y_rows)) < MIN_ROWS:
        return None
    other = _SECOND_DIRECTION.submit(pair_up, y_rows, x_seen, back, rung, settings)
    return pair_up(x_rows, y_seen, T, rung, settings), other.result()


def _at_resolution(cloud: Cloud, rung: Rung, density: float) -> Cloud:
    return thin(cloud, max(rung.components, int(density * len(cloud) / max(rung.covariance_scale, 1.0))))


def displacement(points: Array, covariance: Array) -> Array:
    """(n, 3, 3) covariance of points (n, 3) m moved by a pose with the given 6x6 covariance (left twist)."""
    J = np.concatenate([np.broadcast_to(np.eye(3), (len(points), 3, 3)), -np.stack([skew(p) for p in points])], axis=2)
    return np.asarray(J @ covariance @ J.transpose(0, 2, 1))


def entry(source: Cloud, T: Array, covariance: Array, ladder: tuple[Rung, ...]) -> int:
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


def anneal(source: Cloud, target: Cloud, T_prior: Array, covariance: Array, settings: Alignment) -> Solution | None:
    """Run the ladder from the prior's pose; None when a rung finds too few visible components.

    Args:
        source, target: mixtures on the device.
        T_prior: 4x4 start. covariance: its 6x6, left twist.
    """
    precision = np.asarray(np.linalg.inv(covariance), np.float64)
    T, used = T_prior, 0
    solution: Solution | None = None
    for rung in settings.ladder[entry(source, T_prior, covariance, settings.ladder) :]:
        pairs = rung_pairs(source, target, T, rung, settings, settings.partner_density)
        if pairs is None:
            return None
        weight = settings.information * rung.covariance_scale  # wider kernels anneal, they do not measure less

        def function(pose: Array, pairs: tuple[Pairs, Pairs] = pairs, weight: float = weight) -> Posterior:
            return posterior(two_way(*pairs, pose), pose, T_prior, precision, weight)

        end = climb(function, T, rung.steps, settings.tolerance)
        T, used = end.T, used + end.iterations
        solution = Solution(T, end.posterior, used, end.converged, weight, end.posterior.data)
    return solution if solution is None else _seen_closely(solution, source, target, settings)


def _seen_closely(solution: Solution, source: Cloud, target: Cloud, settings: Alignment) -> Solution:
    """The solution with its last rung's data seen again at the final pose, with many partners per row."""
    rung = replace(settings.ladder[-1], components=FINAL_ROWS, neighbours=FINAL_NEIGHBOURS)
    pairs = rung_pairs(source, target, solution.T, rung, settings, FINAL_DENSITY)
    if pairs is None:
        return solution
    return replace(solution, pairs=pairs, data=two_way(*pairs, solution.T))
