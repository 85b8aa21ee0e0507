# SPDX-License-Identifier: Apache-2.0
"""The alignment objective, its gradient and its curvature in closed form, over a sparse set of pairs.

For rows i (components of one mixture, moved by T = (R, t)) and their partners j in the other mixture

    g_ij = w_ij phi_j |S|^-1/2 exp(-d' S^-1 d / 2),   d = R mu_i + t - mu_j,   S = R S_i R' + S_j
    s_i  = sum_j g_ij

two objectives are offered. "sum" is the paper's: log sum_i phi_i s_i (its eq. 5; the logarithm keeps the optimum).
"log" is sum_i phi_i log(1 + s_i / o_i): o_i is the density of an outlier, so that one row has a bounded say.

With u = S^-1 d, over a left twist (v, w) of T (derived in docs/objective.md):

    d log g / dv = -u
    d log g / dw = -(mu' x u) + vee(S_i' (u u' - S^-1))        mu' = R mu_i + t,  S_i' = R S_i R'
    information  = sum r_ij J' S^-1 J,  J = [I, -[mu']x]        (Gauss-Newton, responsibilities r_ij held fixed)

Every term is linear in per-row sums over partners of g, g u, g S^-1 and g u u': the pair loop needs no 3x3 arrays,
only sixteen scalars, laid out as (k, n) planes so that a row's values are implied by position.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from garps_core.geometry import Array, skew
from garps_core.objective import compiled

CHUNK_PAIRS = 1 << 15
"""Pairs handled at a time: sixteen float32 planes of this size stay in a CPU core's second-level cache."""
CHUNK_PAIRS_CUDA = 1 << 22
NOTHING = -60.0
"""Logarithm of a density, relative to the floor, that is as good as none; smaller ones become slow subnormals."""
SYMMETRIC = ((0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2))
"""Order of the six distinct elements of a symmetric 3x3 matrix."""
_FULL = np.array([[0, 1, 2], [1, 3, 4], [2, 4, 5]])
_PACKED, _TRANSPOSED = (np.array([3 * pair[a] + pair[1 - a] for pair in SYMMETRIC]) for a in (0, 1))
_OFF_DIAGONAL = np.array([i != j for i, j in SYMMETRIC])
_SKEW = np.stack([skew(axis) for axis in np.eye(3)])
"""[mu]x = sum_k mu_k _SKEW[k]."""


@dataclass(frozen=True)
class Pairs:
    """Rows of one mixture with k candidate partners each in the other mixture.

    means (n, 3) and covariances (n, 6) of the rows in their own frame; weights (n,) summing to 1; log_floor (n,);
    partner_means (3, k, n), partner_covariances (6, k, n), log_weights (k, n): log(w_ij phi_j), -inf = no partner.
    """

    means: Tensor
    covariances: Tensor
    weights: Tensor
    log_floor: Tensor
    partner_means: Tensor
    partner_covariances: Tensor
    log_weights: Tensor

    @property
    def count(self) -> int:
        """Number of candidate pairs, n * k."""
        return self.log_weights.numel()


@dataclass(frozen=True)
class Evaluation:
    """Value, gradient (6,) and Gauss-Newton information (6, 6) over a left twist (v m, w rad), float64."""

    value: float
    gradient: Array
    information: Array
    observed: Array
    """Information less what the uncertain assignment of partners takes away; may be indefinite far from an optimum."""
    support: float
    """Weighted share of rows whose partners outweigh the outlier density ("log"), else 1."""


def evaluate(pairs: Pairs, T: Array, form: str) -> Evaluation:
    """Evaluate the objective `form` ("log" or "sum") of `pairs` at the 4x4 pose T that moves the rows."""
    if form == "log" and on_compiled_path(pairs.means):
        return _evaluated(pairs, T)
    mu, S = moved_rows(pairs, T)
    sums = row_sums(pairs, mu, S)
    weights, s = pairs.weights.double(), sums[0].double()
    if form == "log":
        value = float((weights * torch.log1p(s)).sum())
        c = weights / (1 + s)
        return Evaluation(value, *combine(c, sums, mu, S, weights), float((c * s).sum()))
    total = (weights * s).sum()
    value = float(torch.log(total)) if float(total) > 0 else -np.inf
    return Evaluation(value, *combine(weights / total.clamp_min(1e-300), sums, mu, S, None), 1.0)


def _evaluated(pairs: Pairs, T: Array) -> Evaluation:
    """The "log" objective on the compiled path, in one pass."""
    R, t, turn = (part.astype(np.float32) for part in (T[:3, :3], T[:3, 3], _packed_rotation(T[:3, :3])))
    rows = (pairs.means, pairs.covariances, pairs.weights)
    partners = (pairs.partner_means, pairs.partner_covariances, pairs.log_weights, pairs.log_floor)
    means, own, weights = (part.contiguous().numpy() for part in rows)
    value, support, moments, turning = compiled.evaluated(
        means, own, R, t, turn, weights, *(part.contiguous().numpy() for part in partners)
    )
    information = _through_jacobian(moments[:, 3:9])
    observed = information - _through_jacobian(moments[:, 9:])
    return Evaluation(value, _gradient(moments[:4, :3], turning), information, observed, support)


def row_information(pairs: Pairs, T: Array) -> tuple[Array, Array]:
    """What each row of the "log" objective measures: (n, 3, 3) sum of r_ij S^-1 times its weight, and (n, 3) mu'."""
    mu, S = moved_rows(pairs, T)
    sums = row_sums(pairs, mu, S)
    sums = sums.double()
    Q = sums[4:10] * (pairs.weights.double() / (1 + sums[0]))
    return unpack(Q.T).cpu().numpy(), mu.T.double().cpu().numpy()


def moved_rows(pairs: Pairs, T: Array) -> tuple[Tensor, Tensor]:
    """Means (3, n) and packed covariances (6, n) of the rows moved by T."""
    like = pairs.means
    R, t = (torch.as_tensor(part, dtype=like.dtype, device=like.device) for part in (T[:3, :3], T[:3, 3:]))
    turn = torch.as_tensor(_packed_rotation(T[:3, :3]), dtype=like.dtype, device=like.device)
    return torch.addmm(t, R, like.T), turn @ pairs.covariances.T


def _packed_rotation(R: Array) -> Array:
    """6x6 matrix that takes a packed symmetric S to the packed R S R'."""
    turned = np.asarray(np.einsum("ac,bd->abcd", R, R).reshape(9, 9)[_PACKED])
    return np.asarray(turned[:, _PACKED] + np.where(_OFF_DIAGONAL, turned[:, _TRANSPOSED], 0.0))


def row_sums(pairs: Pairs, mu: Tensor, S: Tensor) -> Tensor:
    """(16, n) sums over each row's partners: g, g u (3), g S^-1 (6), g u u' (6), in units of the floor."""
    if on_compiled_path(mu):
        own, partners = (mu, S), (pairs.partner_means, pairs.partner_covariances, pairs.log_weights, pairs.log_floor)
        return torch.from_numpy(compiled.row_sums(*(part.contiguous().numpy() for part in own + partners)))
    n, k = len(pairs.means), pairs.log_weights.shape[0]
    chunk = max(1, (CHUNK_PAIRS_CUDA if mu.is_cuda else CHUNK_PAIRS) // max(k, 1))
    parts = [_chunk_sums(pairs, mu, S, slice(begin, begin + chunk)) for begin in range(0, n, chunk)]
    return torch.cat(parts, dim=1)


def on_compiled_path(like: Tensor) -> bool:
    """True where `compiled` can do the arithmetic: numba is there, and the numbers are float32 on a CPU."""
    return compiled.AVAILABLE and like.device.type == "cpu" and like.dtype == torch.float32


def _chunk_sums(pairs: Pairs, mu: Tensor, S_row: Tensor, rows: slice) -> Tensor:
    """Sixteen per-row sums (16, chunk) for one chunk of rows. Divided by the row's floor, in log space."""
    y = pairs.partner_means[:, :, rows]
    S = pairs.partner_covariances[:, :, rows]
    d0, d1, d2 = mu[0, rows] - y[0], mu[1, rows] - y[1], mu[2, rows] - y[2]
    a, b, c, e, f, i = (S_row[m, rows] + S[m] for m in range(6))
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
    log_g = pairs.log_weights[:, rows] - pairs.log_floor[rows] - D.add_(det.log_()).mul_(0.5)
    g = log_g.clamp_(min=NOTHING).exp_()
    g0, g1, g2 = g * u0, g * u1, g * u2
    planes = (
        g, g0, g1, g2,
        p0.mul_(g), p1.mul_(g), p2.mul_(g), p3.mul_(g), p4.mul_(g), p5.mul_(g),
        g0 * u0, g0 * u1, g0 * u2, g1 * u1, g1 * u2, g2 * u2,
    )  # fmt: skip
    return torch.stack([plane.sum(0) for plane in planes])


def combine(c: Tensor, sums: Tensor, mu: Tensor, S: Tensor, weights: Tensor | None) -> tuple[Array, Array, Array]:
    """Gradient, Gauss-Newton and observed information from row sums; c (n,) = d objective / d s_i.

    J' Q J is quadratic in mu', so it needs only the moments sum Q, sum mu' Q and sum mu' mu'' Q: two small products.
    """
    per_weight = torch.zeros_like(c) if weights is None else 1 / weights.clamp_min(1e-300)
    if on_compiled_path(mu):
        moments, turning = compiled.moments(*(part.numpy() for part in (c, per_weight, sums, mu, S)))
    else:
        moments, turning = _moments(c, per_weight, sums, mu, S)
    information = _through_jacobian(moments[:, 3:9])
    return _gradient(moments[:4, :3], turning), information, information - _through_jacobian(moments[:, 9:])


def _moments(c: Tensor, per_weight: Tensor, sums: Tensor, mu: Tensor, S: Tensor) -> tuple[Array, Array]:
    """(10, 15) sums of (1, mu', mu' mu'') times (u, S^-1, missing), and (6, 6) of S' times (u u' - S^-1)."""
    mu, scaled = mu.double(), sums[1:].double() * c
    U, Q, A = scaled[:3], scaled[3:9], scaled[9:]
    missing = A - torch.stack([U[i] * U[j] * per_weight for i, j in SYMMETRIC])
    ones = torch.ones_like(mu[:1])
    powers = torch.cat([ones, mu, torch.stack([mu[i] * mu[j] for i, j in SYMMETRIC])])
    moments = (powers @ torch.cat([U, Q, missing]).T).cpu().numpy()
    return moments, (S.double() @ (A - Q).T).cpu().numpy()


def _gradient(moments: Array, turning: Array) -> Array:
    """(-sum u, sum vee(S' (u u' - S^-1)) - mu' x u) from moments (4, 3) of u with (1, mu') and `turning` (6, 6)."""
    product = np.einsum("abbc->ac", turning[_FULL[:, :, None, None], _FULL])  # S' (u u' - S^-1), 3x3
    outer = moments[1:]  # sum mu' u'
    return np.concatenate([-moments[0], _vee(product) - _vee(outer)])


def _vee(M: Array) -> Array:
    """(M12 - M21, M20 - M02, M01 - M10); of an outer product a b' this is a x b."""
    return np.array([M[1, 2] - M[2, 1], M[2, 0] - M[0, 2], M[0, 1] - M[1, 0]])


def _through_jacobian(moments: Array) -> Array:
    """Sum of J' Q J (6, 6), J = [I, -[mu']x], from moments (10, 6) of the packed Q with (1, mu', mu' mu'')."""
    return (_THROUGH @ moments.reshape(60)).reshape(6, 6)


def _through_jacobian_of_one(moments: Array) -> Array:
    full = moments[:, _FULL]  # (10, 3, 3)
    first, second = full[1:4], full[4:][_FULL]
    H = np.empty((6, 6))
    H[:3, :3] = full[0]
    H[:3, 3:] = -np.einsum("kab,kbc->ac", first, _SKEW)
    H[3:, :3] = H[:3, 3:].T
    H[3:, 3:] = np.einsum("kba,klbc,lcd->ad", _SKEW, second, _SKEW)
    return H


_THROUGH = np.stack([_through_jacobian_of_one(unit.reshape(10, 6)).ravel() for unit in np.eye(60)], axis=1)
"""The linear map of `_through_jacobian` as a (36, 60) matrix: an evaluation needs it twice, and einsum is slow."""


def pack(S: Tensor) -> Tensor:
    """Symmetric (..., 3, 3) -> (..., 6)."""
    return torch.stack([S[..., i, j] for i, j in SYMMETRIC], dim=-1)


def unpack(six: Tensor) -> Tensor:
    """(..., 6) -> symmetric (..., 3, 3)."""
    return six[..., torch.as_tensor(_FULL, device=six.device)]
