# SPDX-License-Identifier: Apache-2.0
"""The arithmetic that an alignment is done with, chosen once, when its mixtures are moved to the device.

`plain.py` (torch and SciPy) works everywhere; `compiled.py` (loops, needs numba) is several times faster on a CPU.
"""

from __future__ import annotations

from typing import Protocol

import torch
from torch import Tensor

from garps_core.geometry import Array
from garps_core.objective import compiled, plain


class Backend(Protocol):
    """The functions that both modules offer. Tensors are all on one device and of one precision.

    n rows have k partners each. Planes are laid out as (k, n), so that the values of a row are implied by position.
    """

    def row_sums(
        self,
        mu: Tensor,
        S: Tensor,
        partner_means: Tensor,
        partner_covariances: Tensor,
        log_weights: Tensor,
        log_floor: Tensor,
    ) -> Tensor:
        """(16, n) sums over each row's partners: g, g u (3), g S^-1 (6), g u u' (6), in units of the floor.

        Args:
            mu, S: (3, n) means and (6, n) covariances of the rows, moved by the pose.
            partner_means, partner_covariances, log_weights, log_floor: as in `Pairs`.
        """

    def moments(self, c: Tensor, per_weight: Tensor, sums: Tensor, mu: Tensor, S: Tensor) -> tuple[Array, Array]:
        """(10, 15) sums of (1, mu', mu' mu'') times (u, S^-1, missing), and (6, 6) of S' times (u u' - S^-1).

        Args:
            c: (n,) float64, d objective / d s_i, multiplies the sums.
            per_weight: (n,) float64, multiplies the outer product of a row's own u; 0 for the "sum" form.
            sums, mu, S: from, and as for, `row_sums`.
        """

    def log_objective(
        self,
        means: Tensor,
        covariances: Tensor,
        weights: Tensor,
        T: Array,
        partner_means: Tensor,
        partner_covariances: Tensor,
        log_weights: Tensor,
        log_floor: Tensor,
    ) -> tuple[float, float, Array, Array]:
        """Value and support of the "log" objective at the 4x4 pose T that moves the rows, and both `moments`."""

    def nearest(self, moved: Tensor, partners: Tensor, k: int) -> tuple[Tensor, Tensor]:
        """Indices and distances (n, k) of the k nearest partners (m, 3) of the moved rows (n, 3), nearest first, m."""

    def gathered(
        self,
        index: Tensor,
        means: Tensor,
        covariances: Tensor,
        log_weights: Tensor,
        colours: Tensor,
        row_colours: Tensor,
        per_colour: float,
    ) -> tuple[Tensor, Tensor, Tensor]:
        """Means (3, k, n), covariances (6, k, n) and log weights less the cost of colour (k, n) of the partners chosen.

        Args:
            means, covariances, log_weights, colours: (m, 3), (m, 6), (m,) and (m, 3) of all partners.
            row_colours: (n, 3). index: (n, k). per_colour: cost of a squared difference of colours.
        """

    def visible(self, points: Tensor, R: Tensor, t: Tensor, K: Tensor, depth: Tensor, ratio: float) -> Tensor:
        """Mask (n,) of the points (n, 3) m that a camera sees when they are moved by R and t.

        Args:
            K, depth: intrinsics (3, 3) and depth map (h, w) m of the camera; NaN = unknown, and hides nothing.
            ratio: a point is hidden when it is further behind the depth map than this share of the depth.
        """


def backend_for(device: torch.device, dtype: torch.dtype) -> Backend:
    """The fastest backend for a device and a precision."""
    if compiled.AVAILABLE and device.type == "cpu" and dtype == torch.float32:
        return compiled
    return plain
