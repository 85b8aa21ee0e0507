# SPDX-License-Identifier: Apache-2.0
"""Choice of candidate pairs: thinning, two-way visibility, nearest neighbours, colour and label weights."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor

from garps_core.config import Alignment, Config, Rung
from garps_core.devices import checked_device
from garps_core.geometry import Array, se3_inverse
from garps_core.objective.backend import Backend, backend_for
from garps_core.objective.packed import pack
from garps_core.objective.shape import Pairs
from garps_core.types import Frustum, Mixture


@dataclass(frozen=True)
class DeviceMixture:
    """A mixture on the device, with the backend of its arithmetic.

    means (n, 3), covariances (n, 6) (`packed.py`), weights (n,), colours (n, 3), labels (n,) or None.
    """

    means: Tensor
    covariances: Tensor
    weights: Tensor
    colours: Tensor
    labels: Tensor | None
    frustum: Frustum | None
    backend: Backend

    def __len__(self) -> int:
        return len(self.means)

    def take(self, index: Tensor) -> DeviceMixture:
        """Components `index` (bool mask or integers)."""
        if index.dtype == torch.bool:
            index = index.nonzero().squeeze(1)  # once, not for every part
        labels = None if self.labels is None else self.labels[index]
        means, covariances, weights, colours = (
            part.index_select(0, index) for part in (self.means, self.covariances, self.weights, self.colours)
        )
        return DeviceMixture(means, covariances, weights, colours, labels, self.frustum, self.backend)


def to_device(mixture: Mixture, config: Config) -> DeviceMixture:
    """Move a mixture to the device of the config and choose its backend. Raises ConfigError without that device."""
    device = checked_device(config.device)
    dtype = torch.float64 if config.dtype == "float64" else torch.float32
    means, covariances, weights, colours = (
        torch.as_tensor(np.ascontiguousarray(part), dtype=dtype, device=device)
        for part in (mixture.means, mixture.covariances, mixture.weights, mixture.colours)
    )
    labels = None if mixture.labels is None else torch.as_tensor(mixture.labels, device=device)
    return DeviceMixture(
        means, pack(covariances), weights, colours, labels, mixture.frustum, backend_for(device, dtype)
    )


def thin(cloud: DeviceMixture, components: int) -> DeviceMixture:
    """Take an even subsample of at most `components` by index; lifted mixtures lie along a space-filling curve."""
    if len(cloud) <= components:
        return cloud
    index = torch.arange(components, device=cloud.means.device, dtype=torch.float64) * (len(cloud) / components)
    return cloud.take(index.long())


def visible(cloud: DeviceMixture, T: Array, other: Frustum | None, occlusion_ratio: float) -> Tensor:
    """Mask (n,) of components that the other camera sees when moved by T: in its image, not behind its depth."""
    if other is None:
        return torch.ones(len(cloud), dtype=torch.bool, device=cloud.means.device)
    like = cloud.means
    R, t = (torch.as_tensor(part, dtype=like.dtype, device=like.device) for part in (T[:3, :3], T[:3, 3]))
    K = torch.as_tensor(other.K, dtype=like.dtype, device=like.device)
    depth = torch.as_tensor(other.depth, dtype=like.dtype, device=like.device)
    return cloud.backend.visible(like, R, t, K, depth, occlusion_ratio)


def overlap(source: DeviceMixture, target: DeviceMixture, T: Array, settings: Alignment) -> float:
    """Smaller of the two shares of components that the other camera sees under T, 0..1."""
    ahead = visible(source, T, target.frustum, settings.occlusion_ratio)
    back = visible(target, se3_inverse(T), source.frustum, settings.occlusion_ratio)
    return min(float(ahead.double().mean()), float(back.double().mean()))


def pair_up(rows: DeviceMixture, partners: DeviceMixture, T: Array, rung: Rung, settings: Alignment) -> Pairs:
    """Candidate pairs of `rows` (moved by T) with their nearest `partners`, covariances widened by the rung."""
    index, distance = _nearest(rows, partners, T, min(rung.neighbours, len(partners)))
    means, covariances, log_weights = _gathered(rows, partners, index, rung, settings)
    if rows.labels is not None and partners.labels is not None:
        differs = (rows.labels[None] != partners.labels[index.T]).to(log_weights.dtype)
        log_weights = log_weights + differs * float(np.log(max(settings.semantic_discount, 1e-30)))
    own = widened(rows.covariances, rung)
    return Pairs(
        rows.means,
        own,
        rows.weights / rows.weights.sum(),
        _log_floor(own, partners, rung.outlier_floor or settings.outlier_floor),
        means,
        covariances,
        log_weights.masked_fill(settings.max_distance_m < distance.T, -torch.inf),
        rows.backend,
    )


def widened(covariances: Tensor, rung: Rung) -> Tensor:
    """Scale packed covariances (n, 6) by a rung, and add half the variance of its `blur_m` in all directions."""
    wider = covariances * rung.covariance_scale
    if rung.blur_m > 0:
        wider[:, [0, 3, 5]] += 0.5 * rung.blur_m**2
    return wider


def _gathered(
    rows: DeviceMixture, partners: DeviceMixture, index: Tensor, rung: Rung, settings: Alignment
) -> tuple[Tensor, Tensor, Tensor]:
    """Means (3, k, n), covariances (6, k, n) and log weights (k, n) of the partners with index (n, k).

    Colours cost half their squared Mahalanobis distance, each with `colour_variance` per channel.
    """
    covariances = widened(partners.covariances, rung)
    log_weights, per_colour = torch.log(partners.weights.clamp_min(1e-30)), 0.25 / settings.colour_variance
    means, colours = partners.means, partners.colours
    return rows.backend.gathered(index, means, covariances, log_weights, colours, rows.colours, per_colour)


def _nearest(rows: DeviceMixture, partners: DeviceMixture, T: Array, k: int) -> tuple[Tensor, Tensor]:
    """Indices and distances (n, k) of the nearest partners of the rows moved by T, m."""
    like = rows.means
    R, t = (torch.as_tensor(part, dtype=like.dtype, device=like.device) for part in (T[:3, :3], T[:3, 3]))
    return rows.backend.nearest(like @ R.T + t, partners.means, k)


def _log_floor(covariances: Tensor, partners: DeviceMixture, floor: float) -> Tensor:
    """Logarithm of the outlier density o_i, (n,).

    o_i is `floor` times the density of one partner of mean weight and equal covariance at distance zero.
    """
    a, b, c, e, f, i = (2 * covariances).double().unbind(-1)
    det = a * (e * i - f * f) - b * (b * i - c * f) + c * (b * f - c * e)
    scale = torch.log(partners.weights.double().mean() * max(floor, 1e-30))
    return (scale - 0.5 * torch.log(det.clamp_min(1e-60))).to(covariances.dtype)


def without_floor(pairs: Pairs) -> Pairs:
    """Replace the outlier density of pairs by 1, for the paper's plain sum."""
    return replace(pairs, log_floor=torch.zeros_like(pairs.log_floor))
