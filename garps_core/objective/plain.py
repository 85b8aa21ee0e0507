# SPDX-License-Identifier: Apache-2.0
"""The arithmetic of the objective in torch and SciPy: a `Backend` for every device and precision."""

from __future__ import annotations

import torch
from scipy.spatial import cKDTree
from torch import Tensor

from garps_core.geometry import Array
from garps_core.objective.packed import SYMMETRIC, moved_rows
from garps_core.objective.visibility import surface_at

CHUNK_PAIRS = 1 << 15
"""Pairs handled at a time: sixteen float32 planes of this size stay in a CPU core's second-level cache."""
CHUNK_PAIRS_CUDA = 1 << 22
"""Pairs handled at a time on a GPU, where a chunk must be large enough to fill it."""
NOTHING = -60.0
"""Smallest logarithm of a density relative to the floor; smaller densities would become slow subnormals."""


def row_sums(
    mu: Tensor, S: Tensor, partner_means: Tensor, partner_covariances: Tensor, log_weights: Tensor, log_floor: Tensor
) -> Tensor:
    """Sum over each row's partners, chunk by chunk."""
    k, n = log_weights.shape
    chunk = max(1, (CHUNK_PAIRS_CUDA if mu.is_cuda else CHUNK_PAIRS) // max(k, 1))
    parts = []
    for begin in range(0, n, chunk):
        rows = slice(begin, begin + chunk)
        y, S_partner = partner_means[:, :, rows], partner_covariances[:, :, rows]
        parts.append(_chunk_sums(mu[:, rows], S[:, rows], y, S_partner, log_weights[:, rows], log_floor[rows]))
    return torch.cat(parts, dim=1)


def _chunk_sums(mu: Tensor, S_row: Tensor, y: Tensor, S: Tensor, log_weights: Tensor, log_floor: Tensor) -> Tensor:
    """Sixteen per-row sums (16, chunk) for one chunk of rows. Divided by the row's floor, in log space."""
    d0, d1, d2 = mu[0] - y[0], mu[1] - y[1], mu[2] - y[2]
    a, b, c, e, f, i = (S_row[m] + S[m] for m in range(6))
    # inverse of [[a, b, c], [b, e, f], [c, f, i]] = L D L'; cofactors would lose long thin components in float32
    left = torch.finfo(a.dtype).eps  # share of a variance that is taken to be left when rounding leaves less
    r0 = a.reciprocal()
    l1, l2 = b * r0, c * r0
    second = torch.maximum(e - b * l1, e * left)
    r1 = second.reciprocal()
    f = f.addcmul_(c, l1, value=-1)
    l3 = f * r1
    third = torch.maximum((i - c * l2).addcmul_(f, l3, value=-1), i * left)
    det = a * second * third
    p5 = third.reciprocal_()
    m = (l1 * l3).sub_(l2)
    p4, p2 = -l3 * p5, m * p5
    l1r = l1 * r1
    p1 = (m * p4).sub_(l1r)
    p0 = r0.addcmul_(l1, l1r).addcmul_(m, p2)
    p3 = r1.addcmul_(l3, p4, value=-1)
    u0 = p0 * d0 + p1 * d1 + p2 * d2
    u1 = p1 * d0 + p3 * d1 + p4 * d2
    u2 = p2 * d0 + p4 * d1 + p5 * d2
    D = d0.mul_(u0).add_(d1.mul_(u1)).add_(d2.mul_(u2))
    log_g = log_weights - log_floor - D.add_(det.log_()).mul_(0.5)
    g = log_g.clamp_(min=NOTHING).exp_()
    g0, g1, g2 = g * u0, g * u1, g * u2
    planes = (
        g, g0, g1, g2,
        p0.mul_(g), p1.mul_(g), p2.mul_(g), p3.mul_(g), p4.mul_(g), p5.mul_(g),
        g0 * u0, g0 * u1, g0 * u2, g1 * u1, g1 * u2, g2 * u2,
    )  # fmt: skip
    return torch.stack([plane.sum(0) for plane in planes])


def moments(c: Tensor, per_weight: Tensor, sums: Tensor, mu: Tensor, S: Tensor) -> tuple[Array, Array]:
    """Sum over rows as two products of matrices."""
    mu, scaled = mu.double(), sums[1:].double() * c
    U, Q, A = scaled[:3], scaled[3:9], scaled[9:]
    missing = A - torch.stack([U[i] * U[j] * per_weight for i, j in SYMMETRIC])
    ones = torch.ones_like(mu[:1])
    powers = torch.cat([ones, mu, torch.stack([mu[i] * mu[j] for i, j in SYMMETRIC])])
    summed = (powers @ torch.cat([U, Q, missing]).T).cpu().numpy()
    return summed, (S.double() @ (A - Q).T).cpu().numpy()


def log_objective(
    means: Tensor, covariances: Tensor, weights: Tensor, T: Array,
    partner_means: Tensor, partner_covariances: Tensor, log_weights: Tensor, log_floor: Tensor,
) -> tuple[float, float, Array, Array]:  # fmt: skip
    """Evaluate the "log" objective step by step."""
    mu, S = moved_rows(means, covariances, T)
    sums = row_sums(mu, S, partner_means, partner_covariances, log_weights, log_floor)
    weights, s = weights.double(), sums[0].double()
    value = float((weights * torch.log1p(s)).sum())
    c = weights / (1 + s)
    summed, turning = moments(c, 1 / weights.clamp_min(1e-300), sums, mu, S)
    return value, float((c * s).sum()), summed, turning


def nearest(moved: Tensor, partners: Tensor, k: int) -> tuple[Tensor, Tensor]:
    """Search a k-d tree, or on a GPU the whole table of distances."""
    if moved.is_cuda:
        found = [torch.cdist(block, partners).topk(k, largest=False) for block in torch.split(moved, 4096)]
        return torch.cat([f.indices for f in found]), torch.cat([f.values for f in found])
    tree = cKDTree(partners.numpy(), balanced_tree=False, compact_nodes=False, leafsize=32)
    distance, index = tree.query(moved.numpy(), k=k, workers=-1)
    shape = (len(moved), k)
    return torch.from_numpy(index.reshape(shape)), torch.from_numpy(distance.reshape(shape)).to(moved.dtype)


def gathered(
    index: Tensor, means: Tensor, covariances: Tensor, log_weights: Tensor, colours: Tensor, row_colours: Tensor,
    per_colour: float,
) -> tuple[Tensor, Tensor, Tensor]:  # fmt: skip
    """Gather by indexing plane by plane."""
    chosen = index.T.contiguous()
    cost = torch.stack([(row_colours[:, c][None] - colours[:, c][chosen]) ** 2 for c in range(3)]).sum(0)
    return (
        means.T[:, chosen].contiguous(),
        covariances.T[:, chosen].contiguous(),
        log_weights[chosen] - per_colour * cost,
    )


def visible(points: Tensor, R: Tensor, t: Tensor, K: Tensor, depth: Tensor, ratio: float) -> Tensor:
    """Project all points at once."""
    p = points @ R.T + t
    _, inside, surface = surface_at(p, K, depth)
    hidden = p[:, 2] > surface * (1 + ratio)  # False where the depth is NaN: unknown is not hidden
    return inside & ~hidden
