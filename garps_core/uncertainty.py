# SPDX-License-Identifier: Apache-2.0
"""Covariances: from curvature and shared depth errors to an honest 6x6, and between conventions.

A left twist (v, w) perturbs T to exp(v, w) T: the position t becomes t + v + w x t. ROS (REP 103) wants the
covariance of the position itself and of small rotations about the fixed axes: (dt, w) with dt = v - [t]x w.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import torch

from garps_core.geometry import Array, adjoint, se3_inverse, skew
from garps_core.objective import Pairs
from garps_core.solve import Solution, curvature, two_way
from garps_core.systematic import MODES, depth_modes

RELATIVE_STEP = 1e-3
"""Relative depth change by which the effect of a shared depth error is probed."""
MODE_ROWS = 600
"""Rows per direction that probe the effect of shared depth errors."""
OPEN_DIRECTION = 1e-3
"""Directions in which re-assigning partners cancels the curvature keep this share of it: a very large variance."""


def _position_from_twist(t: Array) -> Array:
    J = np.eye(6)
    J[:3, 3:] = -skew(t)
    return J


def ros_from_twist(covariance: Array, T: Array) -> Array:
    """6x6 covariance of a left twist at T -> (position, fixed-axis rotation), the ROS meaning."""
    J = _position_from_twist(T[:3, 3])
    return np.asarray(J @ covariance @ J.T)


def twist_from_ros(covariance: Array, T: Array) -> Array:
    """6x6 covariance in the ROS meaning -> of the left twist at T."""
    J = np.linalg.inv(_position_from_twist(T[:3, 3]))
    return np.asarray(J @ covariance @ J.T)


def inverted(covariance: Array, T: Array) -> Array:
    """Covariance (ROS meaning) of T^-1, given that of T: what swapping source and target does."""
    inverse = se3_inverse(T)
    A = adjoint(inverse)
    return ros_from_twist(A @ twist_from_ros(covariance, T) @ A.T, inverse)


def pose_covariance(solution: Solution, precision: Array, mode_sigmas: Array) -> Array:
    """6x6 covariance (ROS meaning) at the solution.

    Inverse of (weighted observed information of the data + precision of the prior), plus what one sigma of every
    shared depth mode of either view does to the optimum.

    Args:
        solution: pose, pairs of the last rung and weight of the data term.
        precision: 6x6 inverse covariance of the prior, left twist.
        mode_sigmas: (6,) sigmas of the relative depth error modes of one view.
    """
    H = solution.weight * curvature(solution.posterior.data, OPEN_DIRECTION) + precision
    inverse = np.linalg.inv(H)
    covariance = inverse.copy()
    for view in ("source", "target") if solution.pairs else ():
        effect = inverse @ (solution.weight * _gradient_per_mode(solution, view)) * mode_sigmas
        covariance += effect @ effect.T
    return ros_from_twist(0.5 * (covariance + covariance.T), solution.T)


def _gradient_per_mode(solution: Solution, view: str) -> Array:
    """(6, m) change of the data gradient per unit of each depth mode of one view, by finite differences."""
    few = tuple(_thinned(pairs) for pairs in solution.pairs or ())
    here = two_way(few[0], few[1], solution.T).gradient
    changed = [
        two_way(*_with_depth_error(few, view, mode, RELATIVE_STEP), solution.T).gradient for mode in range(MODES)
    ]
    return np.stack([(gradient - here) / RELATIVE_STEP for gradient in changed], axis=1)


def _thinned(pairs: Pairs) -> Pairs:
    """At most MODE_ROWS rows, evenly: a smooth depth error needs no more to show its effect."""
    step = max(1, len(pairs.means) // MODE_ROWS)
    weights = pairs.weights[::step]
    return Pairs(
        pairs.means[::step],
        pairs.covariances[::step],
        weights / weights.sum(),
        pairs.log_floor[::step],
        pairs.partner_means[:, :, ::step].contiguous(),
        pairs.partner_covariances[:, :, ::step].contiguous(),
        pairs.log_weights[:, ::step].contiguous(),
    )


def _with_depth_error(pairs: tuple[Pairs, ...], view: str, mode: int, step: float) -> tuple[Pairs, Pairs]:
    forward, backward = pairs
    if view == "source":
        return _rows_scaled(forward, mode, step), _partners_scaled(backward, mode, step)
    return _partners_scaled(forward, mode, step), _rows_scaled(backward, mode, step)


def _factor(points: torch.Tensor, mode: int, step: float) -> torch.Tensor:
    shape = depth_modes(points.reshape(-1, 3).double().cpu().numpy())[:, mode]
    return torch.as_tensor(1 + step * shape, dtype=points.dtype, device=points.device).reshape(points.shape[:-1])


def _rows_scaled(pairs: Pairs, mode: int, step: float) -> Pairs:
    return replace(pairs, means=pairs.means * _factor(pairs.means, mode, step)[:, None])


def _partners_scaled(pairs: Pairs, mode: int, step: float) -> Pairs:
    points = pairs.partner_means.permute(1, 2, 0)
    return replace(pairs, partner_means=pairs.partner_means * _factor(points, mode, step))
