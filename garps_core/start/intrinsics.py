# SPDX-License-Identifier: Apache-2.0
"""Intrinsics of an uncalibrated camera, from the point map of a two-view network."""

from __future__ import annotations

import numpy as np

from garps_core.checks import Float64Array
from garps_core.config import Config
from garps_core.errors import InitialisationError
from garps_core.geometry import Array
from garps_core.models.in_use import Networks
from garps_core.point_maps import Bool, Framing, PairMaps, Picture, PointMap

STEPS = 10
"""Steps of the reweighted least squares, which converge in about five."""
MIN_PIXELS = 100
SHORTEST, LONGEST = 0.2, 10.0
"""Range of plausible focal lengths, over the longer side of the image: 136 to 6 degrees wide."""
STEEPEST = 0.5 / SHORTEST
"""Largest slope of a ray that a camera of the shortest focal length sees."""


def estimate_intrinsics(
    source: Picture, target: Picture, config: Config, networks: Networks | None = None
) -> tuple[Array, Array]:
    """Estimate 3x3 K of two uncalibrated cameras with the two-view network of `config.start`; see `intrinsics_of`.

    Give them to views with `K_estimated=True`, so that the estimate is marked and its covariance is wider.

    Args:
        source, target: HxWx3 uint8 RGB.
        config: `start.method` must be a two-view network.
        networks: keeps what it loads for the next call; None = load what is needed for this call alone.
    Raises:
        InitialisationError: too few trusted points in front of a camera, or an implausible focal length.
        ConfigError, WeightsError, ModelError: as `Networks.pair_maps`.
    """
    maps = (networks or Networks()).pair_maps(source, target, config)
    return intrinsics_of(maps, (source.shape[:2], target.shape[:2]), config.start.min_confidence)


def intrinsics_of(
    maps: PairMaps, sizes: tuple[tuple[int, ...], tuple[int, ...]], least: float = 0.0
) -> tuple[Array, Array]:
    """Fit 3x3 K of source and target: square pixels with centres at integers, principal point at the image centre.

    Args:
        maps: point maps of the pair.
        sizes: (rows, columns) of both images.
        least: smallest confidence of the pixels that are used.
    Raises:
        InitialisationError: too few trusted points in front of a camera, or an implausible focal length.
    """
    own, trusted = (maps.source_first[0], maps.target_first[0]), maps.trusted(least)
    of_source, of_target = map(_intrinsics, own, trusted, maps.framings, sizes)
    return of_source, of_target


def _intrinsics(one: PointMap, trusted: Bool, framing: Framing, size: tuple[int, ...]) -> Float64Array:
    height, width = size
    K = np.array([[1.0, 0.0, (width - 1) / 2], [0.0, 1.0, (height - 1) / 2], [0.0, 0.0, 1.0]])
    x, y, z = np.moveaxis(one.points, -1, 0)
    ahead = z * STEEPEST > np.maximum(abs(x), abs(y))  # false for NaN; no plausible camera sees steeper rays
    rows, columns = np.nonzero(trusted & ahead)
    if len(rows) < MIN_PIXELS:
        raise InitialisationError(
            f"{len(rows)} trusted points lie in front of their camera: expected at least {MIN_PIXELS} to estimate its "
            "focal length. Give the intrinsics"
        )
    px = framing.to_image(np.stack([columns, rows], axis=1).astype(np.float64)) - K[:2, 2]
    points = one.points[rows, columns].astype(np.float64)
    f, side = focal_length(px, points[:, :2] / points[:, 2:]), max(size)
    if not SHORTEST * side <= f <= LONGEST * side:
        raise InitialisationError(
            f"a focal length of {f:.3g} px would fit the points best, for an image of {width}x{height}: expected "
            f"{SHORTEST * side:g} to {LONGEST * side:g}. Give the intrinsics"
        )
    K[0, 0] = K[1, 1] = f
    return K


def focal_length(px: Array, slopes: Array) -> float:
    """Focal length f, px, that minimises the mean distance of f * slopes (n, 2) from px (n, 2) (Weiszfeld)."""
    weights = np.ones(len(px))
    f = 1.0
    for _ in range(STEPS + 1):
        f = float((weights * (px * slopes).sum(1)).sum() / max((weights * (slopes**2).sum(1)).sum(), 1e-12))
        weights = 1 / np.maximum(np.linalg.norm(px - f * slopes, axis=1), 1e-8)
    return max(f, 1e-3)
