# SPDX-License-Identifier: Apache-2.0
"""Checks of input: calibrations, rigid motions, covariances."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

from garps_core.errors import InputError
from garps_core.geometry import nearest_rotation

FloatArray = npt.NDArray[np.floating[Any]]
Float32Array = npt.NDArray[np.float32]
Float64Array = npt.NDArray[np.float64]
IntArray = npt.NDArray[np.integer[Any]]


def checked_intrinsics(K: Any) -> Float64Array:
    """Return K as 3x3 float64, pixels. Raises InputError unless it is a finite pinhole matrix with positive focals."""
    K = np.asarray(numeric("K", K), np.float64)
    if K.shape != (3, 3):
        raise InputError(f"K has shape {K.shape}: expected 3x3, [[fx, 0, cx], [0, fy, cy], [0, 0, 1]] in pixels")
    if not np.isfinite(K).all():
        raise InputError("K holds NaN or infinity: expected finite pixels. Check the camera calibration")
    if K[0, 0] <= 0 or K[1, 1] <= 0:
        raise InputError(
            f"K has focal lengths fx={K[0, 0]:g}, fy={K[1, 1]:g}: expected both positive, in pixels; "
            "an uncalibrated camera publishes zeros, calibrate it first"
        )
    if np.abs(K[2] - (0, 0, 1)).max() > 1e-9 or K[1, 0] != 0:
        raise InputError(f"K has last row {K[2].tolist()}: expected [0, 0, 1] and K[1,0] = 0. Is it transposed?")
    if K[0, 1] != 0:
        raise InputError(f"K has skew {K[0, 1]:g}: expected 0; rectify the image first")
    return np.asarray(K, np.float64)


def checked_rigid(name: str, T: Any) -> Float64Array:
    """Return T as 4x4 float64 with an exact rotation. Raises InputError unless it is a rigid motion to 1e-3."""
    T = numeric(name, T).astype(np.float64)
    if T.shape != (4, 4):
        raise InputError(f"{name} has shape {T.shape}: expected a 4x4 rigid transform")
    if not np.isfinite(T).all():
        raise InputError(f"{name} holds NaN or infinity: expected a finite 4x4 rigid transform")
    if np.abs(T[3] - (0, 0, 0, 1)).max() > 1e-9:
        raise InputError(f"{name} has last row {T[3].tolist()}: expected [0, 0, 0, 1]")
    R = T[:3, :3]
    off = np.abs(R.T @ R - np.eye(3)).max()
    if off > 1e-3 or np.linalg.det(R) < 0:
        raise InputError(
            f"{name} is no rigid motion: R^T R differs from identity by {off:.2g}, det R = {np.linalg.det(R):.3g}; "
            "expected a right-handed rotation without scale"
        )
    T = T.copy()
    T[:3, :3] = nearest_rotation(R)
    return np.asarray(T, np.float64)


def checked_covariance(name: str, covariance: Any) -> Float64Array:
    """Return a 6x6 float64 covariance. Raises InputError unless finite, symmetric and positive definite."""
    C = numeric(name, covariance).astype(np.float64)
    if C.shape != (6, 6):
        raise InputError(f"{name} has shape {C.shape}: expected 6x6 (x, y, z in m; rotations about X, Y, Z in rad)")
    if not np.isfinite(C).all():
        raise InputError(f"{name} holds NaN or infinity: expected finite variances. Use a large one for unknown")
    if np.abs(C - C.T).max() > 1e-6 * np.abs(C).max():
        raise InputError(f"{name} is not symmetric: largest difference {np.abs(C - C.T).max():.3g}, expected 0")
    smallest = float(np.linalg.eigvalsh(0.5 * (C + C.T))[0])
    if smallest <= 0:
        raise InputError(
            f"{name} is not positive definite: smallest eigenvalue {smallest:.3g}, expected above 0; "
            "zeros do not mean unknown. Give every direction a positive variance"
        )
    return 0.5 * (C + C.T)


def numeric(name: str, value: Any) -> npt.NDArray[Any]:
    """Return value as an array of real numbers. Raises InputError for anything else."""
    try:
        array = np.asarray(value)
    except (ValueError, TypeError) as error:
        raise InputError(f"{name} is no array ({error}): expected numbers") from None
    if array.dtype.kind not in "fiu":
        raise InputError(f"{name} has dtype {array.dtype}: expected real numbers")
    return array
