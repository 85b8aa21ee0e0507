# SPDX-License-Identifier: Apache-2.0
"""The paper's objective as one writes it first: gathered pairs, automatic differentiation, torch's Adam.

Li and Campbell, eq. 5, over candidate pairs: f(q, t) = sum w |S|^-1/2 exp(-d' S^-1 d / 2), where d = R mu_x + t - mu_y
and S = R S_x R' + S_y. It shares no code with the package: tests hold the package to it, and `bench.speed` times it.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

RATE_ROTATION, RATE_TRANSLATION = 3e-6, 9e-5
"""Adam's published rates for the quaternion and the translation (m)."""


@dataclass(frozen=True)
class PlainObjective:
    """P candidate pairs: means (P, 3) m, covariances (P, 3, 3) m^2 and weights (P,), one type and device."""

    means: Tensor
    covariances: Tensor
    partner_means: Tensor
    partner_covariances: Tensor
    weights: Tensor

    def __len__(self) -> int:
        return len(self.weights)

    def value(self, q: Tensor, t: Tensor) -> Tensor:
        """Objective f at the quaternion q (w, x, y, z), any length, and the translation t, m; differentiable."""
        R = rotation(q)
        d = self.means @ R.T + t - self.partner_means
        S = R @ self.covariances @ R.T + self.partner_covariances
        D = (d * torch.linalg.solve(S, d[..., None])[..., 0]).sum(-1)
        densities: Tensor = torch.linalg.det(S) ** -0.5 * torch.exp(-0.5 * D)
        return (self.weights * densities).sum()

    def path(self, q: Tensor, t: Tensor, steps: int) -> list[tuple[Tensor, Tensor]]:
        """Quaternions and translations that Adam visits from (q, t), `steps` + 1 of them."""
        q, t = (part.detach().clone().requires_grad_() for part in (q, t))
        optimiser = torch.optim.Adam([{"params": [q], "lr": RATE_ROTATION}, {"params": [t], "lr": RATE_TRANSLATION}])
        visited = [(q.detach().clone(), t.detach().clone())]
        for _ in range(steps):
            optimiser.zero_grad()
            torch.autograd.backward(-self.value(q, t))
            optimiser.step()
            visited.append((q.detach().clone(), t.detach().clone()))
        return visited


def rotation(q: Tensor) -> Tensor:
    """Quaternion (w, x, y, z) of any length -> 3x3, differentiable."""
    w, x, y, z = q / q.norm()
    return torch.stack(
        [
            torch.stack([1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)]),
            torch.stack([2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)]),
            torch.stack([2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)]),
        ]
    )
