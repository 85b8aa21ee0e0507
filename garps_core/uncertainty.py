# SPDX-License-Identifier: Apache-2.0
"""Covariances: between the solver's left twist and the ROS meaning, and from curvature to an honest 6x6.

A left twist (v, w) perturbs T to exp(v, w) T: the position t becomes t + v + w x t. ROS (REP 103) wants the
covariance of the position itself and of small rotations about the fixed axes: (dt, w) with dt = v - [t]x w.
"""

from __future__ import annotations

import numpy as np

from garps_core.geometry import Array, adjoint, skew


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
    inverse = np.linalg.inv(T)
    A = adjoint(inverse)
    return ros_from_twist(A @ twist_from_ros(covariance, T) @ A.T, inverse)
