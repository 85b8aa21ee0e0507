# SPDX-License-Identifier: Apache-2.0
"""The arithmetic of the objective in compiled loops: a `Backend` for float32 on a CPU, where numba is installed.

Nothing here decides anything: every function gives the same numbers as its namesake in `plain.py` to 1e-5
(`test/core/objective/test_compiled.py`). Only tensors are handed to the loops (`loops.py`, `neighbours.py`) here.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

from garps_core.geometry import Array
from garps_core.objective import loops, neighbours, plain
from garps_core.objective.packed import packed_rotation

AVAILABLE = loops.AVAILABLE
"""True where numba is installed."""


def row_sums(
    mu: Tensor, S: Tensor, partner_means: Tensor, partner_covariances: Tensor, log_weights: Tensor, log_floor: Tensor
) -> Tensor:
    """Sum over each row's partners, block by block."""
    planes = _arrays(mu, S, partner_means, partner_covariances, log_weights, log_floor)
    return torch.from_numpy(loops.row_sums(*planes))


def moments(c: Tensor, per_weight: Tensor, sums: Tensor, mu: Tensor, S: Tensor) -> tuple[Array, Array]:
    """Sum over rows, block by block."""
    return loops.moments(*_arrays(c, per_weight, sums, mu, S))


def log_objective(
    means: Tensor, covariances: Tensor, weights: Tensor, T: Array,
    partner_means: Tensor, partner_covariances: Tensor, log_weights: Tensor, log_floor: Tensor,
) -> tuple[float, float, Array, Array]:  # fmt: skip
    """Evaluate the "log" objective in one pass."""
    R, t, turn = (part.astype(np.float32) for part in (T[:3, :3], T[:3, 3], packed_rotation(T[:3, :3])))
    mu, S, w = _arrays(means, covariances, weights)
    partners = _arrays(partner_means, partner_covariances, log_weights, log_floor)
    return loops.evaluated(mu, S, R, t, turn, w, *partners)


def nearest(moved: Tensor, partners: Tensor, k: int) -> tuple[Tensor, Tensor]:
    """Search the cells of the partners' image; or the tree, where cells do not pay or a partner is not in the image."""
    many = len(moved) > neighbours.MOST_ROWS
    if many or not len(partners) or float(partners[:, 2].min()) <= neighbours.NEAREST_M:
        return plain.nearest(moved, partners, k)
    rows, points = _arrays(moved, partners)
    index, distance = neighbours.nearest(rows, points, k)
    return torch.from_numpy(index), torch.from_numpy(distance)


def gathered(
    index: Tensor, means: Tensor, covariances: Tensor, log_weights: Tensor, colours: Tensor, row_colours: Tensor,
    per_colour: float,
) -> tuple[Tensor, Tensor, Tensor]:  # fmt: skip
    """Gather row by row."""
    y, S, w, own, theirs = _arrays(means, covariances, log_weights, row_colours, colours)
    y, S, w = neighbours.gathered(index.numpy(), y, S, w, theirs, own, per_colour)
    return torch.from_numpy(y), torch.from_numpy(S), torch.from_numpy(w)


def visible(points: Tensor, R: Tensor, t: Tensor, K: Tensor, depth: Tensor, ratio: float) -> Tensor:
    """Project point by point."""
    means, turn, shift, camera, depths = _arrays(points, R, t, K, depth)
    return torch.from_numpy(neighbours.visible(means, turn, shift, camera, depths, ratio))


def _arrays(*tensors: Tensor) -> tuple[npt.NDArray[Any], ...]:
    return tuple(tensor.contiguous().numpy() for tensor in tensors)
