# SPDX-License-Identifier: Apache-2.0
"""Intrinsics of a camera nobody has calibrated, from the points that a two-view network gives its pixels."""

from __future__ import annotations

import numpy as np

from garps_core.checks import Float64Array
from garps_core.config import Config
from garps_core.errors import InitialisationError
from garps_core.geometry import Array
from garps_core.models.in_use import Networks
from garps_core.point_maps import Bool, Framing, PairMaps, Picture, PointMap

STEPS = 10
"""Of the reweighted least squares; they converge in five or so."""
MIN_PIXELS = 100
SHORTEST, LONGEST = 0.2, 10.0
"""Focal lengths that are believed, over the longer side of the image: 136 to 6 degrees wide."""
STEEPEST = 0.5 / SHORTEST
"""Slope of a ray that such a camera can see."""


def estimate_intrinsics(
    source: Picture, target: Picture, config: Config, networks: Networks | None = None
) -> tuple[Array, Array]:
    """3x3 K of two cameras nobody has calibrated, by the two-view network of `config.start`; see `intrinsics_of`.

    Give them to views with `K_estimated=True`, so that the estimate says so and its covariance is wider.

    Args:
        source, target: HxWx3 uint8 RGB.
        config: `start.method` must be a two-view network.
        networks: keeps what it loads for the next call; None = load what is needed for this call alone.
    Raises:
        InitialisationError: a map has hardly a point in front of its camera, or tells of no focal length there is.
        ConfigError, WeightsError, ModelError: as `Networks.pair_maps`.
    """
    maps = (networks or Networks()).pair_maps(source, target, config)
    return intrinsics_of(maps, (source.shape[:2], target.shape[:2]), config.start.min_confidence)


def intrinsics_of(
    maps: PairMaps, sizes: tuple[tuple[int, ...], tuple[int, ...]], least: float = 0.0
) -> tuple[Array, Array]:
    """3x3 K of source and target, pixel centres at integers: square pixels, principal point in the image's middle.

    Args:
        maps: of the pair.
        sizes: (rows, columns) of both images.
        least: pixels that are less sure than this are left out.
    Raises:
        InitialisationError: a map has hardly a point in front of its camera, or tells of no focal length there is.
    """
    own, trusted = (maps.source_first[0], maps.target_first[0]), maps.trusted(least)
    of_source, of_target = map(_intrinsics, own, trusted, maps.framings, sizes)
    return of_source, of_target


def _intrinsics(one: PointMap, trusted: Bool, framing: Framing, size: tuple[int, ...]) -> Float64Array:
    height, width = size
    K = np.array([[1.0, 0.0, (width - 1) / 2], [0.0, 1.0, (height - 1) / 2], [0.0, 0.0, 1.0]])
    x, y, z = np.moveaxis(one.points, -1, 0)
    ahead = z * STEEPEST > np.maximum(abs(x), abs(y))  # false for NaN; beyond, no camera that is believed sees anything
    rows, columns = np.nonzero(trusted & ahead)
    if len(rows) < MIN_PIXELS:
        raise InitialisationError(
            f"{len(rows)} trusted points lie in front of their camera: expected at least {MIN_PIXELS} to tell its "
            "focal length from; give the intrinsics"
        )
    px = framing.to_image(np.stack([columns, rows], axis=1).astype(np.float64)) - K[:2, 2]
    points = one.points[rows, columns].astype(np.float64)
    f, side = focal_length(px, points[:, :2] / points[:, 2:]), max(size)
    if not SHORTEST * side <= f <= LONGEST * side:
        raise InitialisationError(
            f"a focal length of {f:.3g} px would fit the points best, for an image of {width}x{height}: expected "
            f"{SHORTEST * side:g} to {LONGEST * side:g}; give the intrinsics"
        )
    K[0, 0] = K[1, 1] = f
    return K


def focal_length(px: Array, slopes: Array) -> float:
    """f that brings f * slopes (n, 2) nearest to px (n, 2), in the mean of distances, not of squares (Weiszfeld)."""
    weights = np.ones(len(px))
    f = 1.0
    for _ in range(STEPS + 1):
        f = float((weights * (px * slopes).sum(1)).sum() / max((weights * (slopes**2).sum(1)).sum(), 1e-12))
        weights = 1 / np.maximum(np.linalg.norm(px - f * slopes, axis=1), 1e-8)
    return max(f, 1e-3)
