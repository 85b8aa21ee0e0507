# SPDX-License-Identifier: Apache-2.0
"""Maximum a posteriori alignment by damped second-order steps over an annealing ladder.

    maximise  information * L(T) - r' Lambda_0 r / 2,     r = log(T T_0^-1) as a left twist

L is the mean of the objective seen from the source and from the target, so swapping the views gives the inverse
pose. Lambda_0 is the inverse covariance of the initial pose, converted to the left twist.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from garps_core.config import Alignment, Rung
from garps_core.geometry import Array, adjoint, se3_exp, se3_inverse, se3_log, skew
from garps_core.objective import Evaluation, Pairs, evaluate
from garps_core.pairing import Cloud, pair_up, thin, visible

MIN_ROWS = 50


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


def two_way(forward: Pairs, backward: Pairs, T: Array) -> Evaluation:
    """Mean of the "log" objective of source rows moved by T and of target rows moved by T^-1, over T's left twist."""
    f = evaluate(forward, T, "log")
    b = evaluate(backward, se3_inverse(T), "log")
    A = -adjoint(se3_inverse(T))  # (exp(x) T)^-1 = exp(-Ad(T^-1) x) T^-1
    return Evaluation(
        0.5 * (f.value + b.value),
        0.5 * (f.gradient + A.T @ b.gradient),
        0.5 * (f.information + A.T @ b.information @ A),
        0.5 * (f.observed + A.T @ b.observed @ A),
        0.5 * (f.support + b.support),
    )


def inverse_left_jacobian(twist: Array) -> Array:
    """6x6 d log(exp(x) exp(twist)) / dx at x = 0, to fourth order in the twist (Sola eq. 179 ff.)."""
    ad = np.zeros((6, 6))
    ad[:3, :3] = ad[3:, 3:] = skew(twist[3:])
    ad[:3, 3:] = skew(twist[:3])
    square = ad @ ad
    return np.asarray(np.eye(6) - 0.5 * ad + square / 12 - square @ square / 720)


def posterior(data: Evaluation, T: Array, T_prior: Array, precision: Array, weight: float) -> Posterior:
    """Add the prior (precision over the left twist) to `weight` times the data term."""
    r = se3_log(T @ se3_inverse(T_prior))
    J = inverse_left_jacobian(r)
    return Posterior(
        weight * data.value - 0.5 * float(r @ precision @ r),
        weight * data.gradient - J.T @ precision @ r,
        weight * data.information + J.T @ precision @ J,
        data,
    )


def climb(function: Callable[[Array], Posterior], T: Array, steps: int, tolerance: float) -> Solution:
    """Levenberg-damped ascent: at most `steps` evaluations beyond the first, never downhill.

    Stops when a step is shorter than `tolerance` in its own metric, sqrt(step' H step): its size in sigmas.
    """
    here = function(T)
    damping, converged, used = 1e-3, False, 0
    while used < steps and not converged:
        H = here.information
        step = np.linalg.solve(H + damping * np.diag(np.diag(H)) + 1e-12 * np.eye(6), here.gradient)
        size = float(np.sqrt(max(step @ H @ step, 0.0)))
        if size < tolerance:
            return Solution(T, here, used, True)
        there_T = se3_exp(step) @ T
        there = function(there_T)
        used += 1
        if there.value >= here.value:
            converged = size < tolerance * 10
            T, here, damping = there_T, there, max(damping * 0.2, 1e-6)
        else:
            damping = max(damping, 1e-3) * 10
            converged = damping > 1e8
    return Solution(T, here, used, converged)


def rung_pairs(source: Cloud, target: Cloud, T: Array, rung: Rung, settings: Alignment) -> tuple[Pairs, Pairs] | None:
    """Pairs in both directions among the components that both cameras see under T; None when too few are left."""
    back = se3_inverse(T)
    x, y = thin(source, rung.components), thin(target, rung.components)
    x_seen = x.take(visible(x, T, target.frustum, settings.occlusion_ratio))
    y_seen = y.take(visible(y, back, source.frustum, settings.occlusion_ratio))
    if min(len(x_seen), len(y_seen)) < MIN_ROWS:
        return None
    return pair_up(x_seen, y_seen, T, rung, settings), pair_up(y_seen, x_seen, back, rung, settings)


def anneal(
    source: Cloud, target: Cloud, T_prior: Array, precision: Array, ladder: tuple[Rung, ...], settings: Alignment
) -> Solution | None:
    """Run the ladder from the prior's pose; None when a rung finds too few visible components."""
    T, used = T_prior, 0
    solution: Solution | None = None
    for rung in ladder:
        pairs = rung_pairs(source, target, T, rung, settings)
        if pairs is None:
            return None
        forward, backward = pairs

        def function(pose: Array, forward: Pairs = forward, backward: Pairs = backward) -> Posterior:
            data = two_way(forward, backward, pose)
            return posterior(data, pose, T_prior, precision, settings.information)

        solution = climb(function, T, rung.steps, settings.tolerance)
        T, used = solution.T, used + solution.iterations
    assert solution is not None
    return Solution(T, solution.posterior, used, solution.converged)
