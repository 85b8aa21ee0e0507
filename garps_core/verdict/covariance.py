# SPDX-License-Identifier: Apache-2.0
"""Covariances: from curvature and shared depth errors to an honest 6x6, and between conventions.

A left twist (v, w) perturbs T to exp(v, w) T: the position t becomes t + v + w x t. ROS (REP 103) wants the
covariance of the position itself and of small rotations about the fixed axes: (dt, w) with dt = v - [t]x w.
"""

from __future__ import annotations

import numpy as np

from garps_core.config.lifting import Lifting
from garps_core.depth_errors import DEPTH_MODES, error_fields, error_sigmas
from garps_core.geometry import Array, point_jacobian, ros_from_twist, se3_inverse
from garps_core.objective.shape import Pairs, row_information
from garps_core.objective.state import State, WeightedStart
from garps_core.objective.with_depth_errors import backward_jacobian
from garps_core.solver.ladder import Solution, curvature

OPEN_BELOW = 0.02
"""A textureless wall keeps 0.5 to 1.5 % of its curvature, from the rim of the overlap alone: so little is none."""
OPEN_DIRECTION = 1e-5
"""Share of the curvature that open directions are given: a very large variance."""


def pose_covariance(solution: Solution, known: WeightedStart, lifting: Lifting) -> Array:
    """6x6 covariance (ROS meaning) at the solution.

    The pose's part of the inverse of (weighted observed information of the data + precision of what was known), plus
    what one sigma of every shared error that was not solved for does to the optimum.

    Args:
        solution: pose, and pairs chosen anew at it with many partners each (few, frozen partners look like curvature).
        known: the prior of pose and depth errors.
        lifting: sigmas of the shared errors.
    """
    data, weight, precision = solution.data, solution.weight, known.joint()
    covariance = np.linalg.inv(weight * curvature(data, OPEN_DIRECTION, OPEN_BELOW) + precision)
    if solution.pairs is not None:
        sigmas = error_sigmas(lifting)
        if len(known.error_precision):
            sigmas[:DEPTH_MODES] = 0.0
        held = np.linalg.inv(weight * data.information + precision)
        for pull in error_gradients(*solution.pairs, solution.at):
            effect = held @ (weight * pull) * sigmas
            covariance += effect @ effect.T
    of_pose = covariance[:6, :6]
    return ros_from_twist(0.5 * (of_pose + of_pose.T), solution.T)


def share_of_known(solution: Solution, known: WeightedStart) -> Array:
    """6x6 part of the covariance of the solution's left twist that comes from what was known of the pose: C K C.

    C = (D + K)^-1 without the shared errors that `pose_covariance` adds: they come from the data.
    """
    joint = solution.weight * curvature(solution.data, OPEN_DIRECTION, OPEN_BELOW) + known.joint()
    C = np.linalg.inv(joint)[:6, :6]
    return np.asarray(C @ known.precision @ C)


def inflated(covariance: Array, of_known: Array, factor: float) -> Array:
    """Covariance of an estimate whose data are noisier than it took them for, while what was known is as it said.

    With sigmas `factor` times as large the data count for less, but the estimate had weighted them as if they were
    good: C' = C (f^2 D + K) C = f^2 C - (f^2 - 1) C K C, of what the data say alone f^2.

    Args:
        covariance: 6x6 as computed.
        of_known: 6x6 part of it that comes from what was known, C K C.
        factor: f, at least 1.
    Returns:
        6x6, nowhere less than the covariance.
    """
    return np.asarray(covariance + (factor**2 - 1) * (covariance - of_known))


def error_gradients(forward: Pairs, backward: Pairs, at: State) -> tuple[Array, Array]:
    """What each shared error of the source's, and of the target's, points adds to the gradient of `two_way`.

    Partners are held, as in the Gauss-Newton information: -J' Q dd for a displacement dd of rows minus partners.

    Returns:
        Two (6 + errors, 8) arrays over the unknowns of `at`, per unit of each mode.
    """
    B = backward_jacobian(at.T, len(at.errors))
    rows_f, partners_f = _one_way_pull(forward, at.T, len(at.errors))
    rows_b, partners_b = _one_way_pull(backward, se3_inverse(at.T), len(at.errors))
    return 0.5 * (rows_f + B.T @ partners_b), 0.5 * (partners_f + B.T @ rows_b)


def _one_way_pull(pairs: Pairs, T: Array, errors: int) -> tuple[Array, Array]:
    Q, moved = row_information(pairs, T)
    rows = T[:3, :3] @ error_fields(pairs.means.double().cpu().numpy())
    partners = error_fields(moved)
    J = point_jacobian(moved)
    if errors:
        J = np.concatenate([J, rows[:, :, :DEPTH_MODES], -partners[:, :, :DEPTH_MODES]], axis=2)
    JQ = J.transpose(0, 2, 1) @ Q
    return -(JQ @ rows).sum(0), (JQ @ partners).sum(0)
