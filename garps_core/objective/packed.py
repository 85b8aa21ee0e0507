# SPDX-License-Identifier: Apache-2.0
"""Symmetric 3x3 matrices as six numbers, and how a pose turns them."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from garps_core.geometry import Array

SYMMETRIC = ((0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2))
"""Order of the six distinct elements of a symmetric 3x3 matrix."""
FULL = np.array([[0, 1, 2], [1, 3, 4], [2, 4, 5]])
"""Position in the six numbers of every element of the 3x3 matrix."""
_PACKED, _TRANSPOSED = (np.array([3 * pair[a] + pair[1 - a] for pair in SYMMETRIC]) for a in (0, 1))
_OFF_DIAGONAL = np.array([i != j for i, j in SYMMETRIC])


def pack(S: Tensor) -> Tensor:
    """Symmetric (..., 3, 3) -> (..., 6)."""
    return torch.stack([S[..., i, j] for i, j in SYMMETRIC], dim=-1)


def unpack(six: Tensor) -> Tensor:
    """(..., 6) -> symmetric (..., 3, 3)."""
    return six[..., torch.as_tensor(FULL, device=six.device)]


def packed_rotation(R: Array) -> Array:
    """6x6 matrix that takes a packed symmetric S to the packed R S R'."""
    turned = np.asarray(np.einsum("ac,bd->abcd", R, R).reshape(9, 9)[_PACKED])
    return np.asarray(turned[:, _PACKED] + np.where(_OFF_DIAGONAL, turned[:, _TRANSPOSED], 0.0))


def moved_rows(means: Tensor, covariances: Tensor, T: Array) -> tuple[Tensor, Tensor]:
    """Means (n, 3) and packed covariances (n, 6), moved by the 4x4 pose T and laid out as planes (3, n) and (6, n)."""
    R, t = (torch.as_tensor(part, dtype=means.dtype, device=means.device) for part in (T[:3, :3], T[:3, 3:]))
    turn = torch.as_tensor(packed_rotation(T[:3, :3]), dtype=means.dtype, device=means.device)
    return torch.addmm(t, R, means.T), turn @ covariances.T
