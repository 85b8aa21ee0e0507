# SPDX-License-Identifier: Apache-2.0
"""Errors of an estimated relative pose against the truth, in float64.

Poses are 4x4, source-camera points into the target camera (metres). Nothing here looks at images: the same numbers can
be computed for any method. The difference of translations is that of the source origin as the target camera sees it.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

from garps_core.geometry import so3_log

CHI2_6_95 = 12.591587243743977
"""95 % quantile of the chi-square distribution with 6 degrees of freedom: the bound of an honest `nees`."""


def rotation_error_deg(T_est: npt.ArrayLike, T_true: npt.ArrayLike) -> float:
    """Angle between the rotations of two 4x4 poses, 0..180 deg.

    From the Frobenius norm, which keeps its digits near zero, where the usual arccos of the trace loses half of them.
    """
    chord = np.linalg.norm(_pose(T_est)[:3, :3] - _pose(T_true)[:3, :3])
    return float(np.degrees(2 * np.arcsin(min(chord / (2 * np.sqrt(2)), 1.0))))


def translation_error_m(T_est: npt.ArrayLike, T_true: npt.ArrayLike) -> float:
    """Distance of the two translations, m."""
    return float(np.linalg.norm(_pose(T_est)[:3, 3] - _pose(T_true)[:3, 3]))


def error_3d_m(T_est: npt.ArrayLike, T_true: npt.ArrayLike, points: npt.ArrayLike) -> float:
    """Mean displacement of source points (Nx3, m, source frame) between the two poses, m. NaN without points."""
    points = np.asarray(points, np.float64)
    if len(points) == 0:
        return float("nan")
    difference = _pose(T_est)[:3] - _pose(T_true)[:3]
    return float(np.linalg.norm(points @ difference[:, :3].T + difference[:, 3], axis=1).mean())


def direction_error_deg(T_est: npt.ArrayLike, T_true: npt.ArrayLike) -> float:
    """Angle between the two translations, 0..180 deg; blind to their lengths. NaN when either is zero."""
    a, b = _pose(T_est)[:3, 3], _pose(T_true)[:3, 3]
    if not a.any() or not b.any():
        return float("nan")
    return float(np.degrees(np.arctan2(np.linalg.norm(np.cross(a, b)), a @ b)))


def scale_ratio(T_est: npt.ArrayLike, T_true: npt.ArrayLike) -> float:
    """Length of the estimated translation over the true one; 1 is right. NaN when the true one is zero."""
    length = float(np.linalg.norm(_pose(T_true)[:3, 3]))
    return float(np.linalg.norm(_pose(T_est)[:3, 3])) / length if length > 0 else float("nan")


def pose_error(T_est: npt.ArrayLike, T_true: npt.ArrayLike) -> npt.NDArray[np.float64]:
    """Error (6,) of a pose: t_true - t_est in m, then the rotation vector of R_true R_est^T in rad.

    Both are in the target frame, so a covariance in ROS order and meaning describes this error.
    """
    estimate, truth = _pose(T_est), _pose(T_true)
    return np.concatenate([truth[:3, 3] - estimate[:3, 3], so3_log(truth[:3, :3] @ estimate[:3, :3].T)])


def nees(T_est: npt.ArrayLike, covariance: npt.ArrayLike, T_true: npt.ArrayLike) -> float:
    """Normalised estimation error squared, e^T C^-1 e, of a pose with its 6x6 covariance (ROS order, m and rad).

    When the covariance is honest it follows chi-square with 6 degrees of freedom: mean 6, 95 % under `CHI2_6_95`.
    """
    error = pose_error(T_est, T_true)
    C = np.asarray(covariance, np.float64)
    # Metres and radians differ by orders of magnitude: solving for correlations keeps the digits.
    sigma = np.sqrt(np.diag(C))
    whitened = error / sigma
    return float(whitened @ np.linalg.solve(C / np.outer(sigma, sigma), whitened))


def _pose(T: Any) -> npt.NDArray[np.float64]:
    return np.asarray(T, np.float64)
