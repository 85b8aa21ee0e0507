# SPDX-License-Identifier: Apache-2.0
"""Rigid motions and pinhole cameras in float64 numpy.

A twist is (v, w): v in m, w in rad, applied on the left, T = exp(twist) @ T0 (Sola et al., "A micro Lie theory",
arXiv:1812.01537, eq. 172-180, with translation first).
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import Rotation

Array = npt.NDArray[np.float64]


def skew(w: Array) -> Array:
    """3 -> 3x3 with skew(w) @ x == cross(w, x)."""
    return np.array([[0.0, -w[2], w[1]], [w[2], 0.0, -w[0]], [-w[1], w[0], 0.0]])


def point_jacobian(points: Array) -> Array:
    """(n, 3) -> (n, 3, 6) d (exp(x) p) / dx at x = 0 over a left twist: [I, -[p]x]."""
    J = np.zeros((len(points), 3, 6))
    J[:, 0, 0] = J[:, 1, 1] = J[:, 2, 2] = 1.0
    x, y, z = points.T
    J[:, 0, 4], J[:, 0, 5] = z, -y
    J[:, 1, 3], J[:, 1, 5] = -z, x
    J[:, 2, 3], J[:, 2, 4] = y, -x
    return J


def nearest_rotation(R: Array) -> Array:
    """The rotation closest to a 3x3 matrix in Frobenius norm (SVD)."""
    U, _, Vt = np.linalg.svd(R)
    flip = np.diag([1.0, 1.0, np.sign(np.linalg.det(U @ Vt))])
    return np.asarray(U @ flip @ Vt)


def se3_exp(twist: Array) -> Array:
    """Twist (6,) m, rad -> 4x4 rigid motion."""
    v, w = np.asarray(twist[:3], float), np.asarray(twist[3:], float)
    angle = float(np.linalg.norm(w))
    W = skew(w)
    if angle < 1e-6:
        a, b, c = 1 - angle**2 / 6, 0.5 - angle**2 / 24, 1 / 6 - angle**2 / 120
    else:
        a = np.sin(angle) / angle
        b = (1 - np.cos(angle)) / angle**2
        c = (1 - a) / angle**2
    T = np.eye(4)
    T[:3, :3] = np.eye(3) + a * W + b * W @ W
    T[:3, 3] = (np.eye(3) + b * W + c * W @ W) @ v
    return T


def so3_log(R: Array) -> Array:
    """3x3 rotation -> rotation vector (3,) rad."""
    return np.asarray(Rotation.from_matrix(R).as_rotvec())


def se3_log(T: Array) -> Array:
    """4x4 rigid motion -> twist (6,), inverse of `se3_exp`."""
    w = so3_log(T[:3, :3])
    angle = float(np.linalg.norm(w))
    W = skew(w)
    d = 1 / 12 + angle**2 / 720 if angle < 1e-4 else (1 - angle / 2 / np.tan(angle / 2)) / angle**2
    return np.concatenate([(np.eye(3) - 0.5 * W + d * W @ W) @ T[:3, 3], w])


def se3_inverse(T: Array) -> Array:
    """Inverse of a rigid motion, exact in R."""
    inverse = np.eye(4)
    inverse[:3, :3] = T[:3, :3].T
    inverse[:3, 3] = -T[:3, :3].T @ T[:3, 3]
    return inverse


def adjoint(T: Array) -> Array:
    """6x6 Ad(T) with T exp(x) T^-1 == exp(Ad(T) x), order (v, w)."""
    A = np.zeros((6, 6))
    A[:3, :3] = A[3:, 3:] = T[:3, :3]
    A[:3, 3:] = skew(T[:3, 3]) @ T[:3, :3]
    return A


def pixel_rays(K: Array, u: Array, v: Array) -> Array:
    """Rays ((u-cx)/fx, (v-cy)/fy, 1) of pixel coordinates (pixel centres at integers), shape (..., 3)."""
    return np.stack([(u - K[0, 2]) / K[0, 0], (v - K[1, 2]) / K[1, 1], np.ones_like(u)], axis=-1)


def project(K: Array, points: Array) -> Array:
    """Points (..., 3) m in front of the camera -> pixels (..., 2), pixel centres at integers."""
    xy = points[..., :2] / points[..., 2:3]
    return np.asarray(xy * (K[0, 0], K[1, 1]) + (K[0, 2], K[1, 2]))


def transform(T: Array, points: Array) -> Array:
    """Apply a 4x4 rigid motion to points (..., 3)."""
    return np.asarray(points @ T[:3, :3].T + T[:3, 3])


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
    """Covariance (6x6, ROS meaning) of T^-1, given that of T; source and target are swapped."""
    inverse = se3_inverse(T)
    A = adjoint(inverse)
    return ros_from_twist(A @ twist_from_ros(covariance, T) @ A.T, inverse)


def displacement(points: Array, covariance: Array) -> Array:
    """(n, 3, 3) covariance of points (n, 3) m moved by a pose with the given 6x6 covariance (left twist)."""
    J = point_jacobian(points)
    return np.asarray(J @ covariance @ J.transpose(0, 2, 1))
