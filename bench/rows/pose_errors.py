# SPDX-License-Identifier: Apache-2.0
"""Errors of one pose that `garps_core.metrics` lacks: those of Map-free relocalisation.

Poses are 4x4, source-camera points into the target camera. Reference: Arnold et al., ECCV 2022, and its benchmark code.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from garps_core.checks import Float64Array

GRID_POINTS, GRID_STEP_M, GRID_NEAREST_M = (7, 4, 7), 0.3, 1.8


def camera_error_m(T_est: npt.ArrayLike, T_true: npt.ArrayLike) -> float:
    """Distance of the target camera's centres as the source camera sees them, c = -R^T t, m: Map-free's e_c.

    `metrics.translation_error_m` is that of the t themselves; a rotation error times |t| lies between the two.
    """
    (R, t), (R_true, t_true) = _parts(T_est), _parts(T_true)
    return float(np.linalg.norm(R.T @ t - R_true.T @ t_true))


def vcre_px(T_est: npt.ArrayLike, T_true: npt.ArrayLike, K: npt.ArrayLike, width: float, height: float) -> float:
    """Virtual correspondence reprojection error, Map-free's: how far virtual objects appear from their place, px.

    7x4x7 points X (right, down, ahead), 0.3 m apart, stand centred before the true target camera, the first plane 1.8 m
    ahead. By the estimate they are drawn at T_est T_true^-1 X instead (in the benchmark, whose poses are camera to
    world, C_est^-1 C_true X). Both pixels are clipped to [0, width] x [0, height]; their distance is averaged over the
    points. As in the benchmark a point behind the camera is divided by its negative depth too, which mirrors it before
    it is clipped; the error is never above the image's diagonal.

    Args:
        T_est, T_true: 4x4 T_target_source, m.
        K: 3x3 of the target camera, px.
        width, height: of the target image, px.
    """
    (R, t), (R_true, t_true) = _parts(T_est), _parts(T_true)
    X, size, turn = _grid(), np.array([width, height], np.float64), R @ R_true.T
    drawn = X @ turn.T + (t - turn @ t_true)
    apart = _pixels(drawn, np.asarray(K, np.float64), size) - _pixels(X, np.asarray(K, np.float64), size)
    return float(np.linalg.norm(apart, axis=1).mean())


def _parts(T: npt.ArrayLike) -> tuple[Float64Array, Float64Array]:
    pose = np.asarray(T, np.float64)
    return pose[:3, :3], pose[:3, 3]


def _grid() -> Float64Array:
    """196x3 points of `vcre_px`, m."""
    x, y, z = (GRID_STEP_M * (np.arange(n) - (n - 1) / 2) for n in GRID_POINTS)
    return np.stack(np.meshgrid(x, y, z - z[0] + GRID_NEAREST_M), axis=-1).reshape(-1, 3)


def _pixels(points: Float64Array, K: Float64Array, size: Float64Array) -> Float64Array:
    """Nx3 m -> Nx2 px, clipped to the image."""
    seen = points @ K.T
    depth = np.where(seen[:, 2:] == 0, np.finfo(float).tiny, seen[:, 2:])  # just ahead of the lens, at the image's rim
    with np.errstate(over="ignore"):
        return np.clip(seen[:, :2] / depth, 0, size)
