# SPDX-License-Identifier: Apache-2.0
"""Point maps of a pair -> pose with covariance: PnP of one picture's pixels against their points in the other camera.

Each order of the pair gives a pose. The order with the more confident maps is kept, as the authors of DUSt3R do, and
refined on its inliers. Errors of neighbouring pixels are correlated; the sums of their residuals over blocks of the
picture measure by how much this widens the covariance. The covariance is also widened where the two orders contradict
each other, and by the errors that all points share: scale and a smooth warp (`depth_errors.py`).
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from garps_core.config import Config
from garps_core.config.lifting import Lifting
from garps_core.depth_errors import error_sigmas
from garps_core.errors import InitialisationError
from garps_core.gauss_newton import NormalEquations, gauss_newton
from garps_core.geometry import Array, adjoint, ros_from_twist, se3_inverse, se3_log, transform
from garps_core.point_maps import Bool, Framing, PairMaps, PointMap
from garps_core.start.degenerate import fixed_pose
from garps_core.start.match_pose import REFINEMENT_STEPS
from garps_core.start.ransac import ransac
from garps_core.start.reprojection import DAMPING, MIN_PIXEL_SIGMA, Normal, OneWay, inliers_of, keep, normal_equations
from garps_core.types import Prior, View

STEP_PX = 4
"""Spacing of the pixels of a map that are used, in both directions; those between them add nothing."""
THRESHOLD_PX = 5.0
"""Largest reprojection error of an inlier, in pixels of the map (Wang et al. 2024)."""
MIN_TRIALS = 50
"""Smallest number of trials of RANSAC. Few are enough: most pixels of a good map fit."""
MIN_SHARE = 0.2
"""Share of the trusted pixels that must fit one pose. The points of a network that fails fit none."""
MIN_TRUSTED = 100
"""Smallest number of trusted pixels to compute a pose from."""
BLOCKS = 6
"""Blocks along the longer side of the trusted part whose residuals count as independent of each other's."""


@dataclass(frozen=True)
class _Order:
    """One order of the pair: the first camera's frame holds the points, the second one's pixels saw them."""

    views: tuple[View, View]
    framings: tuple[Framing, Framing]
    maps: tuple[PointMap, PointMap]
    trusted: tuple[Bool, Bool]
    """Masks of the trusted pixels of the first and of the second picture."""

    @property
    def score(self) -> float:
        """Confidence of the network in this order: the product of the mean confidences of both maps."""
        return float(self.maps[0].confidence.mean() * self.maps[1].confidence.mean())


@dataclass(frozen=True)
class _Pose:
    """T_second_first with two covariances of its left twist: by noise, and by the errors that all points share."""

    T: Array
    noise: Array
    shared: Array
    reason: str

    def inverted(self) -> _Pose:
        """Return the pose of the swapped pair."""
        inverse = se3_inverse(self.T)
        A = adjoint(inverse)
        return replace(self, T=inverse, noise=A @ self.noise @ A.T, shared=A @ self.shared @ A.T)


def pose_from_maps(maps: PairMaps, source: View, target: View, config: Config) -> Prior:
    """Return the start pose with covariance; its `reason` names order, pixels and source of the scale.

    Args:
        maps: point maps of source and target.
        source, target: intrinsics, and where `start.scale` asks for it, depth.
        config: `start`, `lifting` and `seed` are used.
    Raises:
        InitialisationError: too few trusted pixels, or too few that fit one pose, in both orders; no depth to scale by.
        ConfigError: metres from a network that has none.
    """
    orders = _orders(maps, source, target, config.start.min_confidence)
    by_network = maps.gives_metres(config.start.scale)
    poses: dict[str, _Pose] = {}
    failures = []
    for name, order in orders.items():
        try:
            found = _posed(order, by_network, config)
        except InitialisationError as failure:
            failures.append(f"{name} first: {failure}")
            continue
        poses[name] = found if name == "source" else found.inverted()
    if not poses:
        raise InitialisationError(f"{maps.origin}: {'; '.join(failures)}")
    best = max(poses, key=lambda name: orders[name].score)
    pose = poses[best]
    contradiction = _contradiction(*poses.values()) if len(poses) == 2 else 1.0
    covariance = ros_from_twist(pose.noise * contradiction + pose.shared, pose.T)
    reason = "; ".join([f"{best} first: {pose.reason}", *failures])
    if contradiction > 1:
        reason += f"; the other order contradicts it, sigmas times {np.sqrt(contradiction):.1f}"
    with fixed_pose(f"{maps.origin}: {reason}"):
        return Prior(pose.T, covariance, maps.origin, reason)


def _orders(maps: PairMaps, source: View, target: View, min_confidence: float) -> dict[str, _Order]:
    of_source, of_target = maps.trusted(min_confidence)
    return {
        "source": _order((source, target), maps.framings, maps.source_first, (of_source, of_target)),
        "target": _order((target, source), maps.framings[::-1], maps.target_first, (of_target, of_source)),
    }


def _order(
    views: tuple[View, View],
    framings: tuple[Framing, Framing],
    maps: tuple[PointMap, PointMap],
    trusted: tuple[Bool, Bool],
) -> _Order:
    first, second = (np.isfinite(one.points).all(-1) & sure for one, sure in zip(maps, trusted, strict=True))
    return _Order(views, framings, maps, (first, second))


def _posed(order: _Order, by_network: bool, config: Config) -> _Pose:
    way = _second(order)
    if len(way.points) < MIN_TRUSTED:
        total = order.trusted[1][::STEP_PX, ::STEP_PX].size
        raise InitialisationError(
            f"{len(way.points)} of {total} pixels are surer than {config.start.min_confidence:g}: expected at least "
            f"{MIN_TRUSTED}; do the pictures share anything, are the weights trained?"
        )
    unit = float(np.median(np.linalg.norm(way.points, axis=1))) or 1.0  # a network without metres may have any unit
    of_one = replace(way, points=way.points / unit)
    T = ransac(of_one, THRESHOLD_PX, config, MIN_TRIALS)
    count = 0
    if T is not None:
        fitting = inliers_of(of_one, T, THRESHOLD_PX)
        count = int(fitting.sum())
        T[:3, 3] *= unit
    if T is None or count < MIN_SHARE * len(way.points):
        raise InitialisationError(
            f"{count} of {len(way.points)} trusted pixels fit one pose: expected at least {MIN_SHARE:.0%}"
        )
    scale, scale_sigma, whose = _scale(order, T, by_network, config)
    T[:3, 3] *= scale
    fitted = replace(keep(way, fitting), points=way.points[fitting] * scale)
    counts = f"{count} of {len(way.points)} trusted pixels fit"
    with fixed_pose(counts):
        T, noise, shared = _refined(T, fitted, scale_sigma, config)
        Prior(T, ros_from_twist(noise + shared, T))
    return _Pose(T, noise, shared, f"{counts}; {whose}")


def _second(order: _Order) -> OneWay:
    """The second picture's trusted pixels with their points in the first camera's frame."""
    rows, columns = _sampled(order.trusted[1])
    px = np.stack([columns, rows], axis=1).astype(np.float64)
    K = order.framings[1].intrinsics(order.views[1].K)
    return OneWay(order.maps[1].points[rows, columns].astype(np.float64), px, K)


def _sampled(trusted: Bool) -> tuple[npt.NDArray[np.intp], npt.NDArray[np.intp]]:
    """Rows and columns of every n-th trusted pixel."""
    rows, columns = np.nonzero(trusted[STEP_PX // 2 :: STEP_PX, STEP_PX // 2 :: STEP_PX])
    return rows * STEP_PX + STEP_PX // 2, columns * STEP_PX + STEP_PX // 2


def _scale(order: _Order, T: Array, by_network: bool, config: Config) -> tuple[float, float, str]:
    """Metres per unit of the maps, its relative sigma, and whose metres they are, in words."""
    if by_network:
        return 1.0, config.start.network_scale_sigma, "metres as the network says"
    ratios = [ratio for k in (0, 1) if (ratio := _depth_ratio(order, k, T)) is not None]
    if not ratios:
        raise InitialisationError(
            "no depth to take the scale from: expected a sensor's or a network's (reconstruction.method), or a metric "
            "network for the pose"
        )
    logs = np.log(ratios)
    one = np.hypot(config.lifting.scale_sigma, config.lifting.warp_sigma) / np.sqrt(len(ratios))
    sigma = float(np.hypot(one, np.ptp(logs) / 2))
    scale = float(np.exp(logs.mean()))
    return scale, sigma, f"metres by the depth of {len(ratios)} of 2 views, {scale:.3g} per unit of the network"


def _depth_ratio(order: _Order, k: int, T: Array) -> float | None:
    """Median of a view's depth over that of its map, moved into its own camera; None without depth."""
    depth = order.views[k].depth
    if depth is None:
        return None
    rows, columns = _sampled(order.trusted[k])
    px = order.framings[k].to_image(np.stack([columns, rows], axis=1).astype(np.float64))
    u, v = np.rint(px).astype(int).T
    points = order.maps[k].points[rows, columns].astype(np.float64)
    z = (transform(T, points) if k else points)[:, 2]
    metres = depth[v.clip(0, depth.shape[0] - 1), u.clip(0, depth.shape[1] - 1)]
    usable = np.isfinite(metres) & (z > 0)
    return float(np.median(metres[usable] / z[usable])) if usable.sum() >= MIN_TRUSTED else None


def _refined(T: Array, way: OneWay, scale_sigma: float, config: Config) -> tuple[Array, Array, Array]:
    """Robust Gauss-Newton; the pose, and as covariances of its left twist the noise and what all points share."""
    shared = error_sigmas(config.lifting)
    shared[0] = scale_sigma
    shared[1:6] = np.maximum(shared[1:6], config.start.network_warp_sigma)
    lifting = replace(config.lifting, patch_sigma=0.0)  # that of another depth: these points were seen with both views
    reprojection = OneWayReprojection(way, lifting)
    T = gauss_newton(T, reprojection, REFINEMENT_STEPS)
    normal = normal_equations(way, T, reprojection.pixel_sigma, lifting)
    inverse = np.linalg.inv(normal.H + DAMPING)
    alike = max(1.0, float(np.trace(_spread(normal, way.px) @ inverse)) / 6)  # 1 for pixels that err by themselves
    effect = inverse @ normal.from_points * shared
    pointing = inverse @ normal.from_pixels * error_sigmas(config.lifting)
    return T, np.asarray(inverse * alike, np.float64), effect @ effect.T + pointing @ pointing.T


@dataclass
class OneWayReprojection:
    """Normal equations of the reprojection errors of one direction, for `gauss_newton`."""

    way: OneWay
    lifting: Lifting
    pixel_sigma: float = 1.0
    """Noise of the pixels, px, read off the residuals of the last pose."""

    def __call__(self, T: Array) -> NormalEquations:
        """Return H and g at the pose T (4x4), and update the noise of the pixels for the next one."""
        normal = normal_equations(self.way, T, self.pixel_sigma, self.lifting)
        self.pixel_sigma = max(1.4826 * float(np.median(np.abs(normal.residual_px))), MIN_PIXEL_SIGMA)
        return normal.H + DAMPING, normal.b


def _spread(normal: Normal, px: Array) -> Array:
    """Sum of g g' over blocks of the picture, g = (1 - H_block H^-1)^-1 b_block: the jackknife's sandwich.

    The factor makes up for what a block takes part in the fit and so hides of its errors (Bell and McCaffrey 2002).
    """
    px = px - px.min(0)
    side = (px.max() + 1) / BLOCKS  # a whole covariance from so few sums would be a wild one: its mean is all we take
    blocks = np.unique(np.floor(px / side).astype(int), axis=0, return_inverse=True)[1].ravel()
    count = int(blocks.max()) + 1
    scores, informations = np.zeros((count, 6)), np.zeros((count, 6, 6))
    np.add.at(scores, blocks, normal.scores)
    np.add.at(informations, blocks, normal.informations)
    hidden = informations @ np.linalg.inv(normal.H + DAMPING)
    g = np.linalg.solve(np.eye(6) - hidden, scores[..., None])[..., 0]
    return np.asarray(g.T @ g * ((count - 1) / count))


def _contradiction(one: _Pose, other: _Pose) -> float:
    """Factor on the noise's covariance that makes the difference of both orders a usual one, at least 1."""
    difference = se3_log(one.T @ se3_inverse(other.T))
    apart = float(difference @ np.linalg.solve(one.noise + other.noise, difference))
    return max(1.0, apart / len(difference))
