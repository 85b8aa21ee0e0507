# SPDX-License-Identifier: Apache-2.0
"""The published method, for reproduction: the plain pair sum maximised by Adam over a quaternion and a translation.

Li and Campbell, "Gaussian Alignment for Relative Camera Pose Estimation via Single-View Reconstruction", eq. 5 and
section 3.2. Opacity threshold, then every s-th component, then k nearest neighbours at the initial pose with a
distance cut. The objective's value is f itself, with weights that sum to one in either mixture.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import torch
from scipy.spatial.transform import Rotation

from garps_core.config import Alignment
from garps_core.geometry import Array, skew
from garps_core.objective.pairs import DeviceMixture, pair_up, without_floor
from garps_core.objective.shape import Pairs, evaluate
from garps_core.objective.state import State, WeightedStart
from garps_core.solver.ladder import MIN_ROWS, Solution, posterior
from garps_core.solver.problem import Problem


def salient(cloud: DeviceMixture, settings: Alignment) -> DeviceMixture:
    """Components of at least the opacity threshold, then every `component_stride`-th of them."""
    kept = cloud.take(cloud.weights >= settings.opacity_threshold)
    kept = kept.take(torch.arange(0, len(kept), settings.component_stride, device=kept.means.device))
    return replace(kept, weights=kept.weights / kept.weights.sum())


def paper_pairs(source: DeviceMixture, target: DeviceMixture, T: Array, settings: Alignment) -> Pairs | None:
    """The paper's candidate pairs at pose T; None when fewer than 50 components are left in a mixture."""
    x, y = salient(source, settings), salient(target, settings)
    if min(len(x), len(y)) < MIN_ROWS:
        return None
    return without_floor(pair_up(x, y, T, settings.ladder[0], settings))


def value_and_gradient(pairs: Pairs, q: Array, t: Array) -> tuple[float, Array, Array]:
    """f and its gradients over the quaternion q (w, x, y, z; normalised inside) and the translation t, m."""
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
    """Quaternion (w, x, y, z), any length, and translation -> 4x4."""
    T = np.eye(4)
    T[:3, :3] = Rotation.from_quat(np.roll(q, -1)).as_matrix()
    T[:3, 3] = t
    return T


def adam_path(pairs: Pairs, T: Array, settings: Alignment, steps: int) -> list[Array]:
    """Poses visited by Adam (Kingma and Ba) from T, `steps` + 1 of them, with a learning rate for q and one for t."""
    start = np.roll(Rotation.from_matrix(T[:3, :3]).as_quat(), 1)
    q = torch.tensor(start, dtype=torch.float64, requires_grad=True)
    t = torch.tensor(T[:3, 3], dtype=torch.float64, requires_grad=True)
    groups = [{"params": [q], "lr": settings.adam_rate_rotation}, {"params": [t], "lr": settings.adam_rate_translation}]
    optimiser = torch.optim.Adam(groups, maximize=True)
    path = [T]
    for _ in range(steps):
        _, dq, dt = value_and_gradient(pairs, q.detach().numpy(), t.detach().numpy())
        q.grad, t.grad = torch.from_numpy(dq), torch.from_numpy(dt)
        optimiser.step()
        path.append(pose(q.detach().numpy().copy(), t.detach().numpy().copy()))
    return path


def maximise(problem: Problem) -> list[Solution]:
    """The paper's optimisation from the start; its curvature plus the start's precision makes the covariance."""
    start, settings = problem.start, problem.settings
    pairs = paper_pairs(problem.source, problem.target, start.T, settings)
    if pairs is None:
        return []
    rung = settings.ladder[0]
    at = State(adam_path(pairs, start.T, settings, rung.steps)[-1])
    weight = settings.effective_measurements * rung.covariance_scale
    end = posterior(evaluate(pairs, at.T, "sum"), at, WeightedStart(start.T, start.precision), weight)
    return [Solution(at, end, rung.steps, True, weight, end.data, fixed_steps=True)]
