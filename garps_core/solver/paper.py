# SPDX-License-Identifier: Apache-2.0
"""The published method, for comparison: the plain pair sum maximised by Adam over a quaternion and a translation.

Li and Campbell, "Gaussian Alignment for Relative Camera Pose Estimation via Single-View Reconstruction", eq. 5 and
section 3.2. Components are cut by opacity, every n-th is kept, and each gets its k nearest neighbours at the start, up
to a largest distance. The weights sum to one in either mixture, and the data term of a solution is log f.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import torch
from scipy.spatial.transform import Rotation

from garps_core.config import Alignment, Paper, Rung
from garps_core.geometry import Array, skew
from garps_core.objective.pairs import DeviceMixture, pair_up, without_floor
from garps_core.objective.shape import Pairs, evaluate
from garps_core.objective.state import State, WeightedStart
from garps_core.solver.ladder import MIN_ROWS, Solution, final_pairs, posterior, two_way
from garps_core.solver.problem import Problem


def salient(mixture: DeviceMixture, settings: Paper) -> DeviceMixture:
    """Components of at least the opacity threshold, then every `component_stride`-th of them."""
    kept = mixture.take(mixture.weights >= settings.opacity_threshold)
    kept = kept.take(torch.arange(0, len(kept), settings.component_stride, device=kept.means.device))
    return replace(kept, weights=kept.weights / kept.weights.sum())


def paper_pairs(source: DeviceMixture, target: DeviceMixture, T: Array, settings: Paper) -> Pairs | None:
    """The paper's candidate pairs at pose T (4x4); None when fewer than 50 components are left in a mixture."""
    x, y = salient(source, settings), salient(target, settings)
    if min(len(x), len(y)) < MIN_ROWS:
        return None
    rung = Rung(covariance_scale=settings.covariance_scale, neighbours=settings.neighbours)
    pairing = Alignment(
        colour_variance=settings.colour_variance,
        semantic_discount=settings.semantic_discount,
        max_distance_m=settings.max_distance_m,
    )
    return without_floor(pair_up(x, y, T, rung, pairing))


def value_and_gradient(pairs: Pairs, q: Array, t: Array) -> tuple[float, Array, Array]:
    """Value f and its gradients over the quaternion q (w, x, y, z; normalised inside) and the translation t (m)."""
    T = pose(q, t)
    e = evaluate(pairs, T, "sum")
    f = float(np.exp(e.value))
    about_fixed_t = f * (e.gradient[3:] - np.cross(t, e.gradient[:3]))  # a left twist also swings t
    # w = 2 vec(dq q*) / |q|^2 for R(q + dq) = exp(w) R(q): columns of the map from dq
    w, v = q[0], q[1:]
    dw = np.zeros((3, 4))
    dw[:, 0] = -v
    dw[:, 1:] = w * np.eye(3) - skew(v).T
    return f, 2.0 * dw.T @ about_fixed_t / (q @ q), f * e.gradient[:3]


def pose(q: Array, t: Array) -> Array:
    """The 4x4 pose of a quaternion (w, x, y, z) of any length and a translation (m)."""
    T = np.eye(4)
    T[:3, :3] = Rotation.from_quat(np.roll(q, -1)).as_matrix()
    T[:3, 3] = t
    return T


def adam_path(pairs: Pairs, T: Array, settings: Paper, steps: int) -> list[Array]:
    """The `steps` + 1 poses (4x4) that Adam (Kingma and Ba) visits from T, with a learning rate for q and one for t."""
    start = np.roll(Rotation.from_matrix(T[:3, :3]).as_quat(), 1)
    q = torch.tensor(start, dtype=torch.float64, requires_grad=True)
    t = torch.tensor(T[:3, 3], dtype=torch.float64, requires_grad=True)
    groups = [{"params": [q], "lr": settings.rate_rotation}, {"params": [t], "lr": settings.rate_translation}]
    optimiser = torch.optim.Adam(groups, maximize=True)
    path = [T]
    for _ in range(steps):
        _, dq, dt = value_and_gradient(pairs, q.detach().numpy(), t.detach().numpy())
        q.grad, t.grad = torch.from_numpy(dq), torch.from_numpy(dt)
        optimiser.step()
        path.append(pose(q.detach().numpy().copy(), t.detach().numpy().copy()))
    return path


def maximise(problem: Problem) -> list[Solution]:
    """The paper's solution from the start; its curvature plus the start's precision makes the covariance.

    The start does not hold the pose while Adam moves it.
    """
    start, settings = problem.start, problem.config.paper
    pairs = paper_pairs(problem.source, problem.target, start.T, settings)
    if pairs is None:
        return []
    at = State(adam_path(pairs, start.T, settings, settings.steps)[-1])
    weight = problem.settings.effective_measurements * settings.covariance_scale
    end = posterior(evaluate(pairs, at.T, "sum"), at, WeightedStart(start.T, start.precision), weight)
    data = replace(end.data, support=_support(at, problem))
    return [Solution(at, end, settings.steps, True, weight, data, fixed_steps=True)]


def _support(at: State, problem: Problem) -> float:
    """Share of the components with a partner, on the final pairs of the default method; the plain sum has no floor."""
    pairs = final_pairs(at, problem)
    return 0.0 if pairs is None else two_way(*pairs, at, problem.pool).support
