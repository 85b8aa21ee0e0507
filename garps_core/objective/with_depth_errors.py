# SPDX-License-Identifier: Apache-2.0
"""The objective over the pose and the smooth errors of both depth maps together.

Two maps that differ by a few per cent in scale and shape cannot be superposed rigidly; a rigid fit turns the
difference into motion. So each map may have a smooth relative error, six polynomials of the ray's slopes
(`depth_errors.py`), with a prior. Unknowns are the left twist of the pose and, where wanted, the errors of the source's
and of the target's map: 6 or 18 numbers.

    d = R p (1 + phi(p) a_s) + t - y (1 + psi(y) a_t)

A partner's error is taken at the place of its row, psi(mu') for psi(y): the field is smooth and they are neighbours.
Then only the rows move, the pair loop is that of the pose alone, and J gains the columns (R p) phi and -mu' psi.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import torch
from torch import Tensor

from garps_core.depth_errors import DEPTH_MODES, depth_modes
from garps_core.geometry import Array, adjoint, se3_inverse
from garps_core.objective.packed import moved_rows, unpack
from garps_core.objective.pairs import DeviceMixture
from garps_core.objective.shape import Evaluation, Pairs, derivatives, evaluate
from garps_core.objective.state import State

MODES = DEPTH_MODES
"""Number of error modes of one depth map."""


def corrected(cloud: DeviceMixture, errors: Array) -> DeviceMixture:
    """Move the means along their rays by the errors (6,) of their depth map; () = none."""
    if not len(errors):
        return cloud
    means = cloud.means.double()
    gain = 1 + depth_modes(means) @ torch.as_tensor(errors, device=means.device)
    return replace(cloud, means=(means * gain[:, None]).to(cloud.means.dtype))


def evaluate_jointly(pairs: Pairs, T: Array, of_rows: Array, of_partners: Array) -> Evaluation:
    """The "log" objective over (left twist, errors of the rows' map, errors of the partners' map), 18 numbers.

    Args:
        pairs: rows and partners, as corrected so far.
        T: 4x4 pose that moves the rows.
        of_rows, of_partners: (6,) errors beyond what is corrected already.
    """
    own = pairs.means.double()
    rows_modes = depth_modes(own)
    R, t, by_rows, by_partners = (
        torch.as_tensor(part, dtype=own.dtype, device=own.device)
        for part in (T[:3, :3], T[:3, 3], of_rows, of_partners)
    )
    arm = own @ R.T
    there = arm * (1 + rows_modes @ by_rows)[:, None] + t
    partner_modes = depth_modes(there)
    mu = there * (1 - partner_modes @ by_partners)[:, None]
    _, S = moved_rows(pairs.means, pairs.covariances, T)
    packed = mu.T.to(S.dtype).contiguous()
    sums = pairs.backend.row_sums(packed, S, *pairs.partners)
    weights, s = pairs.weights.double(), sums[0].double()
    c = weights / (1 + s)
    moments = pairs.backend.moments(c, 1 / weights.clamp_min(1e-300), sums, packed, S)
    gradient, information, observed = derivatives(*moments)
    scaled = sums[1:].double() * c
    U, Q, A = scaled[:3].T, unpack(scaled[3:9].T), unpack(scaled[9:].T)
    missing = A - U[:, :, None] * U[:, None, :] / weights.clamp_min(1e-300)[:, None, None]
    columns = (arm, mu, rows_modes, partner_modes)
    of_errors = torch.cat([-(arm * U).sum(1) @ rows_modes, (mu * U).sum(1) @ partner_modes])
    return Evaluation(
        float((weights * torch.log1p(s)).sum()),
        np.concatenate([gradient, of_errors.cpu().numpy()]),
        _bordered(information, Q, *columns),
        _bordered(observed, Q - missing, *columns),
        float((c * s).sum()),
    )


def _bordered(pose: Array, Q: Tensor, arm: Tensor, mu: Tensor, rows_modes: Tensor, partner_modes: Tensor) -> Array:
    """Sum of J' Q J (18, 18) given its pose block; the columns are arm times modes, and -mu times modes."""
    pull_rows, pull_partners = (Q @ arm[..., None])[..., 0], -(Q @ mu[..., None])[..., 0]
    H = np.empty((6 + 2 * MODES, 6 + 2 * MODES))
    H[:6, :6] = pose
    for begin, pull, modes in ((6, pull_rows, rows_modes), (6 + MODES, pull_partners, partner_modes)):
        through = torch.cat([pull, torch.linalg.cross(mu, pull)], dim=1)
        H[:6, begin : begin + MODES] = (through.T @ modes).cpu().numpy()
    H[6 : 6 + MODES, 6 : 6 + MODES] = _weighted(rows_modes, (arm * pull_rows).sum(1), rows_modes)
    H[6 : 6 + MODES, 6 + MODES :] = _weighted(rows_modes, (arm * pull_partners).sum(1), partner_modes)
    H[6 + MODES :, 6 + MODES :] = _weighted(partner_modes, -(mu * pull_partners).sum(1), partner_modes)
    upper = np.triu(H)
    return np.asarray(upper + np.triu(H, 1).T)


def _weighted(a: Tensor, weights: Tensor, b: Tensor) -> Array:
    return np.asarray((a.T @ (weights[:, None] * b)).cpu().numpy())


def evaluate_at(pairs: Pairs, state: State, swapped: bool = False) -> Evaluation:
    """The objective of one direction at a state; `swapped`: the rows are the target's, the pose is inverted."""
    T = se3_inverse(state.T) if swapped else state.T
    if not len(state.errors):
        return evaluate(pairs, T, "log")
    of_source, of_target = state.errors[:MODES], state.errors[MODES:]
    rows, partners = (of_target, of_source) if swapped else (of_source, of_target)
    return evaluate_jointly(pairs, T, rows, partners)


def backward_jacobian(T: Array, errors: int) -> Array:
    """Jacobian of the swapped views' unknowns by the unknowns, (6 + errors, 6 + errors).

    (exp(x) T)^-1 = exp(-Ad(T^-1) x) T^-1, and the errors of both maps change places.
    """
    B = np.zeros((6 + errors, 6 + errors))
    B[:6, :6] = -adjoint(se3_inverse(T))
    B[6:, 6:] = np.roll(np.eye(errors), errors // 2, axis=0)
    return B


def two_sided(f: Evaluation, b: Evaluation, T: Array) -> Evaluation:
    """Mean of both directions' evaluations, over the unknowns of the first."""
    B = backward_jacobian(T, len(f.gradient) - 6)
    return Evaluation(
        0.5 * (f.value + b.value),
        0.5 * (f.gradient + B.T @ b.gradient),
        0.5 * (f.information + B.T @ b.information @ B),
        0.5 * (f.observed + B.T @ b.observed @ B),
        0.5 * (f.support + b.support),
    )
