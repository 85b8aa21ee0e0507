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

Every term is linear in per-row sums over partners of g, g u, g S^-1 and g u u': the pair loop (`backend.py`) needs no
3x3 arrays, only sixteen scalars.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from garps_core.geometry import Array, skew
from garps_core.objective.backend import Backend
from garps_core.objective.packed import FULL, moved_rows, unpack

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
    backend: Backend

    @property
    def rows(self) -> tuple[Tensor, Tensor, Tensor]:
        """Means, covariances and weights of the rows, in the order that backends take them."""
        return self.means, self.covariances, self.weights

    @property
    def partners(self) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """Means, covariances and log weights of the partners, and the floor, in the order that backends take them."""
        return self.partner_means, self.partner_covariances, self.log_weights, self.log_floor

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
    backend = pairs.backend
    if form == "log":
        value, support, *moments = backend.log_objective(*pairs.rows, T, *pairs.partners)
        return Evaluation(value, *derivatives(*moments), support)
    mu, S = moved_rows(pairs.means, pairs.covariances, T)
    sums = backend.row_sums(mu, S, *pairs.partners)
    weights, s = pairs.weights.double(), sums[0].double()
    total = (weights * s).sum()
    value = float(torch.log(total)) if float(total) > 0 else -np.inf
    c = weights / total.clamp_min(1e-300)
    return Evaluation(value, *derivatives(*backend.moments(c, torch.zeros_like(c), sums, mu, S)), 1.0)


def row_information(pairs: Pairs, T: Array) -> tuple[Array, Array]:
    """Weighted sum of r_ij S^-1 over the partners of each row, (n, 3, 3), and the moved means (n, 3); "log" form."""
    mu, S = moved_rows(pairs.means, pairs.covariances, T)
    sums = pairs.backend.row_sums(mu, S, *pairs.partners).double()
    Q = sums[4:10] * (pairs.weights.double() / (1 + sums[0]))
    return unpack(Q.T).cpu().numpy(), mu.T.double().cpu().numpy()


def derivatives(moments: Array, turning: Array) -> tuple[Array, Array, Array]:
    """Gradient, Gauss-Newton and observed information from the moments (10, 15) and (6, 6) of a backend.

    J' Q J is quadratic in mu', so it needs only the moments sum Q, sum mu' Q and sum mu' mu'' Q: two small products.
    """
    information = _through_jacobian(moments[:, 3:9])
    return _gradient(moments[:4, :3], turning), information, information - _through_jacobian(moments[:, 9:])


def _gradient(moments: Array, turning: Array) -> Array:
    """(-sum u, sum vee(S' (u u' - S^-1)) - mu' x u) from moments (4, 3) of u with (1, mu') and `turning` (6, 6)."""
    product = np.einsum("abbc->ac", turning[FULL[:, :, None, None], FULL])  # S' (u u' - S^-1), 3x3
    outer = moments[1:]  # sum mu' u'
    return np.concatenate([-moments[0], _vee(product) - _vee(outer)])


def _vee(M: Array) -> Array:
    """(M12 - M21, M20 - M02, M01 - M10); of an outer product a b' this is a x b."""
    return np.array([M[1, 2] - M[2, 1], M[2, 0] - M[0, 2], M[0, 1] - M[1, 0]])


def _through_jacobian(moments: Array) -> Array:
    """Sum of J' Q J (6, 6), J = [I, -[mu']x], from moments (10, 6) of the packed Q with (1, mu', mu' mu'')."""
    return (_THROUGH @ moments.reshape(60)).reshape(6, 6)


def _through_jacobian_of_one(moments: Array) -> Array:
    full = moments[:, FULL]  # (10, 3, 3)
    first, second = full[1:4], full[4:][FULL]
    H = np.empty((6, 6))
    H[:3, :3] = full[0]
    H[:3, 3:] = -np.einsum("kab,kbc->ac", first, _SKEW)
    H[3:, :3] = H[:3, 3:].T
    H[3:, 3:] = np.einsum("kba,klbc,lcd->ad", _SKEW, second, _SKEW)
    return H


_THROUGH = np.stack([_through_jacobian_of_one(unit.reshape(10, 6)).ravel() for unit in np.eye(60)], axis=1)
"""The linear map of `_through_jacobian` as a (36, 60) matrix: an evaluation needs it twice, and einsum is slow."""
