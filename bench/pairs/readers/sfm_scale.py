# SPDX-License-Identifier: Apache-2.0
"""The metres of a clip that has none: a depth map over the depth of sparse structure-from-motion points.

The factor is exp of the mean of log(depth of the map) - log(depth of the point), made robust: of 1000 draws of 5
points the one that most points agree with to 0.1 decides, and the mean is taken over those. "Metres" so found are the
metres of whatever made the depth map, with its scale error: a truth that depends on a network, to be named as such.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from bench.pairs.readers.dataset_files import arrays, floats, rows
from garps_core.checks import Float32Array, Float64Array
from garps_core.geometry import project

SOURCE = "sfm-depth"
DRAWS = 1000
DRAWN = 5
AGREEMENT = 0.1
MIN_POINTS = 10


def depth_scale(depth: Float32Array, K: Float64Array, points: Float64Array, rng: np.random.Generator) -> float:
    """The factor from the clip's unit to metres.

    Args:
        depth: HxW m along z, NaN = no reading.
        K: 3x3 px of the depth map, pixel centres at integers.
        points: Nx3 in the frame of the camera that the depth map belongs to, in the clip's unit.
        rng: of the draws.
    Raises:
        ValueError: fewer than 10 points fall on depth; there is no factor to be had.
    """
    ratios = log_ratios(depth, K, points)
    if len(ratios) < MIN_POINTS:
        raise ValueError(f"{len(ratios)} sparse points fall on depth: expected at least {MIN_POINTS}")
    return float(np.exp(robust_mean(ratios, rng)))


def log_ratios(depth: Float32Array, K: Float64Array, points: Float64Array) -> Float64Array:
    """Log of the map's depth, at the nearest pixel, over the point's, for points in view that have one."""
    points = points[np.isfinite(points).all(1) & (points[:, 2] > 1e-6)]
    pixels = project(K, points).round()
    seen = ((pixels >= 0) & (pixels < depth.shape[::-1])).all(1)
    u, v = pixels[seen].astype(int).T
    mapped, z = depth[v, u].astype(np.float64), points[seen, 2]
    known = np.isfinite(mapped) & (mapped > 0)
    return np.asarray(np.log(mapped[known]) - np.log(z[known]))


def robust_mean(values: Float64Array, rng: np.random.Generator) -> float:
    """Mean of those that agree with the best draw; of all, where no draw has one that agrees."""
    best = np.zeros(len(values), bool)
    for _ in range(DRAWS):
        middle = values[rng.choice(len(values), DRAWN, replace=False, shuffle=False)].mean()
        agree = np.abs(values - middle) < AGREEMENT
        if agree.sum() > best.sum():
            best = agree
    return float(values[best].mean() if best.any() else values.mean())


def points_file(folder: Path, clip: str) -> Path:
    """FOLDER/points/CLIP.npz, or .txt where only that is there."""
    packed, text = folder / "points" / f"{clip}.npz", folder / "points" / f"{clip}.txt"
    return text if text.is_file() and not packed.is_file() else packed


def read_points(path: Path) -> Float64Array:
    """Sparse points, Nx3 in the clip's world frame and unit: array `points` of an .npz, or "x y z" per line."""
    if path.suffix == ".txt":
        return np.array([floats(where, words, "x y z") for where, words in rows(path)]).reshape(-1, 3)
    points = arrays(path).get("points")
    if points is None or points.ndim != 2 or points.shape[1] != 3 or points.dtype.kind not in "fiu":
        raise ValueError(f"{path}: expected an array `points`, Nx3 numbers")
    return points.astype(np.float64)
