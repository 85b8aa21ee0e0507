# SPDX-License-Identifier: Apache-2.0
"""Which components may be partners: thinning, two-way visibility, nearest neighbours, colour and label weights."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import torch
from scipy.spatial import cKDTree
from torch import Tensor

from garps_core.config import Alignment, Config, Rung
from garps_core.devices import checked_device
from garps_core.geometry import Array, se3_inverse
from garps_core.objective import neighbours
from garps_core.objective.shape import Pairs, on_compiled_path, pack
from garps_core.types import Frustum, Mixture

NEAREST_Z_M = 1e-3
"""Image coordinates of points nearer than this, or behind the camera, are taken at this range."""


@dataclass(frozen=True)
class DeviceMixture:
    """A mixture on the device: means (n, 3), covariances (n, 6), weights (n,), colours (n, 3), labels (n,) or None."""

    means: Tensor
    covariances: Tensor
    weights: Tensor
    colours: Tensor
    labels: Tensor | None
    frustum: Frustum | None

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
        return DeviceMixture(means, covariances, weights, colours, labels, self.frustum)


def to_device(mixture: Mixture, config: Config) -> DeviceMixture:
    """Move a mixture to the device and arithmetic of the config. Raises ConfigError when the device is not there."""
    device = checked_device(config.device)
    dtype = torch.float64 if config.dtype == "float64" else torch.float32
    means, covariances, weights, colours = (
        torch.as_tensor(np.ascontiguousarray(part), dtype=dtype, device=device)
        for part in (mixture.means, mixture.covariances, mixture.weights, mixture.colours)
    )
    labels = None if mixture.labels is None else torch.as_tensor(mixture.labels, device=device)
    return DeviceMixture(means, pack(covariances), weights, colours, labels, mixture.frustum)


def thin(cloud: DeviceMixture, components: int) -> DeviceMixture:
    """An even subsample of at most `components` by index; lifted mixtures are listed along a space-filling curve."""
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
    if on_compiled_path(like):
        points, turn, shift, camera, map_ = (part.contiguous().numpy() for part in (like, R, t, K, depth))
        return torch.from_numpy(neighbours.seen(points, turn, shift, camera, map_, occlusion_ratio))
    height, width = depth.shape
    p = like @ R.T + t
    z = p[:, 2].clamp_min(1e-6)
    u = (p[:, 0] / z * K[0, 0] + K[0, 2]).round().clamp(-1, width).long()
    v = (p[:, 1] / z * K[1, 1] + K[1, 2]).round().clamp(-1, height).long()
    inside = (p[:, 2] > 1e-3) & (u >= 0) & (u < width) & (v >= 0) & (v < height)
    seen = depth[v.clamp(0, height - 1), u.clamp(0, width - 1)]
    hidden = p[:, 2] > seen * (1 + occlusion_ratio)  # False where the depth is NaN: unknown is not hidden
    return inside & ~hidden


def overlap(source: DeviceMixture, target: DeviceMixture, T: Array, settings: Alignment) -> float:
    """Smaller of the two shares of components that the other camera sees under T, 0..1."""
    ahead = visible(source, T, target.frustum, settings.occlusion_ratio)
    back = visible(target, se3_inverse(T), source.frustum, settings.occlusion_ratio)
    return min(float(ahead.double().mean()), float(back.double().mean()))


def pair_up(rows: DeviceMixture, partners: DeviceMixture, T: Array, rung: Rung, settings: Alignment) -> Pairs:
    """Candidate pairs of `rows` (moved by T) with their nearest `partners`, covariances widened by the rung."""
    index, distance = _nearest(rows, partners, T, min(rung.neighbours, len(partners)), settings.depth_weight)
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
    )


def widened(covariances: Tensor, rung: Rung) -> Tensor:
    """Packed covariances (n, 6) as a rung sees them: scaled, and blurred in all directions by half of `blur_m`'s."""
    wider = covariances * rung.covariance_scale
    if rung.blur_m > 0:
        wider[:, [0, 3, 5]] += 0.5 * rung.blur_m**2
    return wider


def _gathered(
    rows: DeviceMixture, partners: DeviceMixture, index: Tensor, rung: Rung, settings: Alignment
) -> tuple[Tensor, Tensor, Tensor]:
    """Of each row's partners, index (n, k): means (3, k, n), covariances (6, k, n), log weights (k, n).

    Colours cost half their squared Mahalanobis distance, each with `colour_variance` per channel.
    """
    covariances = widened(partners.covariances, rung)
    log_weights, per_colour = torch.log(partners.weights.clamp_min(1e-30)), 0.25 / settings.colour_variance
    if on_compiled_path(rows.means):
        means, packed, weights, colours, own = (
            part.contiguous().numpy()
            for part in (partners.means, covariances, log_weights, partners.colours, rows.colours)
        )
        y, S, w = neighbours.gathered(index.numpy(), means, packed, weights, colours, own, per_colour)
        return torch.from_numpy(y), torch.from_numpy(S), torch.from_numpy(w)
    chosen = index.T.contiguous()
    cost = torch.stack([(rows.colours[:, c][None] - partners.colours[:, c][chosen]) ** 2 for c in range(3)]).sum(0)
    return (
        partners.means.T[:, chosen].contiguous(),
        covariances.T[:, chosen].contiguous(),
        log_weights[chosen] - per_colour * cost,
    )


def _nearest(
    rows: DeviceMixture, partners: DeviceMixture, T: Array, k: int, depth_weight: float
) -> tuple[Tensor, Tensor]:
    """Indices and distances (n, k) of the nearest partners; metres, or image coordinates if depth_weight < 1."""
    like = rows.means
    R, t = (torch.as_tensor(part, dtype=like.dtype, device=like.device) for part in (T[:3, :3], T[:3, 3]))
    moved = like @ R.T + t
    them = partners.means
    few = len(like) <= neighbours.MOST_ROWS
    if few and on_compiled_path(like) and len(them) and float(them[:, 2].min()) > NEAREST_Z_M:
        index, distance = neighbours.nearest(moved.numpy(), them.contiguous().numpy(), k, depth_weight)
        return torch.from_numpy(index), torch.from_numpy(distance)
    if depth_weight < 1:
        moved, them = image_coordinates(moved, depth_weight), image_coordinates(them, depth_weight)
    if like.is_cuda:
        found = [torch.cdist(block, them).topk(k, largest=False) for block in torch.split(moved, 4096)]
        return torch.cat([f.indices for f in found]), torch.cat([f.values for f in found])
    distance, index = cKDTree(them.numpy(), balanced_tree=False, compact_nodes=False, leafsize=32).query(
        moved.numpy(), k=k, workers=-1
    )
    shape = (len(rows), k)
    return torch.from_numpy(index.reshape(shape)), torch.from_numpy(distance.reshape(shape)).to(like.dtype)


def image_coordinates(points: Tensor, depth_weight: float) -> Tensor:
    """(n, 3) m -> (x/z, y/z, depth_weight log z): a partner along the same ray is near although its depth is off."""
    z = points[:, 2:].clamp_min(NEAREST_Z_M)
    return torch.cat([points[:, :2] / z, depth_weight * torch.log(z)], dim=1)


def _log_floor(covariances: Tensor, partners: DeviceMixture, floor: float) -> Tensor:
    """log o_i: `floor` times what one partner of mean weight gives a row of the same covariance at distance zero."""
    a, b, c, e, f, i = (2 * covariances).double().unbind(-1)
    det = a * (e * i - f * f) - b * (b * i - c * f) + c * (b * f - c * e)
    scale = torch.log(partners.weights.double().mean() * max(floor, 1e-30))
    return (scale - 0.5 * torch.log(det.clamp_min(1e-60))).to(covariances.dtype)


def without_floor(pairs: Pairs) -> Pairs:
    """The same pairs with unit outlier density, as the paper's plain sum needs."""
    return replace(pairs, log_floor=torch.zeros_like(pairs.log_floor))
