# SPDX-License-Identifier: Apache-2.0
"""Rotation matrix to unit quaternion (x, y, z, w) and back, without scipy."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from msg_adapters.errors import MessageError

Float64Array = npt.NDArray[np.float64]

NORM_TOLERANCE = 1e-3


def quaternion_from_matrix(R: Float64Array) -> Float64Array:
    """3x3 rotation to (x, y, z, w), unit norm, w >= 0 (at w = 0 the first non-zero part is positive).

    The 4x4 matrix 4 q q^T is linear in R (Shepperd 1978); its largest column is never close to zero.
    """
    x, y, z = R[0, 0], R[1, 1], R[2, 2]
    xy, xz, yz = R[0, 1] + R[1, 0], R[0, 2] + R[2, 0], R[1, 2] + R[2, 1]
    wx, wy, wz = R[2, 1] - R[1, 2], R[0, 2] - R[2, 0], R[1, 0] - R[0, 1]
    outer = np.array(
        [
            [1 + x - y - z, xy, xz, wx],
            [xy, 1 - x + y - z, yz, wy],
            [xz, yz, 1 - x - y + z, wz],
            [wx, wy, wz, 1 + x + y + z],
        ]
    )
    q = outer[:, int(np.diag(outer).argmax())]
    q = q / np.linalg.norm(q)
    leading = q[3] if q[3] != 0 else q[:3][q[:3] != 0][0]
    return np.asarray(q if leading > 0 else -q) + 0.0  # no minus zero


def matrix_from_quaternion(q: Float64Array) -> Float64Array:
    """(x, y, z, w) to 3x3 rotation. Raises MessageError unless the norm is 1 to 1e-3; the rest is normalised away."""
    norm = float(np.linalg.norm(q))
    if abs(norm - 1) > NORM_TOLERANCE:
        raise MessageError(f"orientation has norm {norm:.4g}: expected a unit quaternion x, y, z, w; was it ever set?")
    x, y, z, w = q / norm
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
            [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
            [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
        ]
    )
