# SPDX-License-Identifier: Apache-2.0
"""The 6x6 covariance of a pose, from the curvature of the posterior and the errors that a depth map shares.

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
"""Share of the Gauss-Newton curvature below which a direction is open. A textureless wall keeps 0.5 to 1.5 %, from the
rim of the overlap alone."""
OPEN_DIRECTION = 1e-5
"""Share of the Gauss-Newton curvature that an open direction gets, so that its variance is very large."""


def pose_covariance(solution: Solution, start: WeightedStart, lifting: Lifting) -> Array:
    """6x6 covariance (ROS order and meaning) at the solution.

    It is the pose block of the inverse of (weighted observed information of the data + precision of the start), plus
    the covariance of the shifts that the shared depth errors cause in the optimum, unless they were solved for.

    Args:
        solution: pose with its final pairs; few, frozen partners would look like curvature.
        start: prior of pose and depth errors.
        lifting: sigmas of the shared errors.
    """
    data, weight, precision = solution.data, solution.weight, start.joint()
    covariance = np.linalg.inv(weight * curvature(data, OPEN_DIRECTION, OPEN_BELOW) + precision)
    if solution.pairs is not None:
        sigmas = error_sigmas(lifting)
        if len(start.error_precision):
            sigmas[:DEPTH_MODES] = 0.0
        held = np.linalg.inv(weight * data.information + precision)
        for pull in error_gradients(*solution.pairs, solution.at):
            effect = held @ (weight * pull) * sigmas
            covariance += effect @ effect.T
    of_pose = covariance[:6, :6]
    return ros_from_twist(0.5 * (of_pose + of_pose.T), solution.T)


def share_of_start(solution: Solution, start: WeightedStart) -> Array:
    """6x6 part of the covariance of the solution's left twist that comes from the start's pose: C K C.

    K is the start's precision, D the information of the data, C = (D + K)^-1. The shared errors that `pose_covariance`
    adds are left out, because they come from the data.
    """
    joint = solution.weight * curvature(solution.data, OPEN_DIRECTION, OPEN_BELOW) + start.joint()
    C = np.linalg.inv(joint)[:6, :6]
    return np.asarray(C @ start.precision @ C)


def inflated(covariance: Array, of_start: Array, factor: float) -> Array:
    """Covariance of an estimate whose data have sigmas `factor` times as large as assumed; the start's are right.

    The estimate weighted the data by the assumed sigmas: C' = C (f^2 D + K) C = f^2 C - (f^2 - 1) C K C. The part that
    comes from the data grows by f^2.

    Args:
        covariance: 6x6 as computed.
        of_start: 6x6 part of it that comes from the start, C K C.
        factor: f, at least 1.
    Returns:
        6x6, nowhere less than the covariance.
    """
    return np.asarray(covariance + (factor**2 - 1) * (covariance - of_start))


def error_gradients(forward: Pairs, backward: Pairs, at: State) -> tuple[Array, Array]:
    """Change of the gradient of `two_way` per unit of each shared error of the source's, and of the target's, points.

    Partners are held fixed, as in the Gauss-Newton information: -J' Q dd for a displacement dd of rows minus partners.

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
