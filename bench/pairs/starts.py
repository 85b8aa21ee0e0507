# SPDX-License-Identifier: Apache-2.0
"""Starting poses for a pair: the truth, disturbed by a known amount."""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation

from bench.pairs.pair import Pair, rng_of
from garps_core.checks import Float64Array
from garps_core.geometry import skew, transform
from garps_core.types import Prior

DISTURBANCE_M = 0.12
DISTURBANCE_DEG = 1.0
NOMINAL_RANGE_M = 3.0
"""Distance, on the optical axis, of the centre of a scene whose points are unknown."""


def disturbed(T: Float64Array, scene_points: Float64Array, rng: np.random.Generator) -> Float64Array:
    """The pose turned by exactly 1 deg about the centre of the scene and then moved by 0.12 m, in random directions.

    Turning about the scene keeps it in view, as the errors of real initialisers do: points move by about 0.12 m.

    Args:
        T: 4x4 T_target_source.
        scene_points: Nx3 m, source frame.
        rng: seed it with the pair's name, `rng_of(pair.id)`.
    """
    centre = transform(T, scene_points).mean(0)
    axis, direction = rng.normal(size=(2, 3))
    turn = Rotation.from_rotvec(axis / np.linalg.norm(axis) * np.radians(DISTURBANCE_DEG)).as_matrix()
    D = np.eye(4)
    D[:3, :3] = turn
    D[:3, 3] = centre - turn @ centre + direction / np.linalg.norm(direction) * DISTURBANCE_M
    return np.asarray(D @ T)


def disturbed_prior(pair: Pair, seed: int = 0) -> Prior:
    """`disturbed` truth with the covariance of disturbances of that size, in ROS order and meaning.

    A turn w about the scene centre c and a move v shift the source origin t (target frame) by v + w x (t - c).
    """
    points = pair.points if len(pair.points) else np.array([[0.0, 0.0, NOMINAL_RANGE_M]])
    start = disturbed(pair.T_target_source, points, rng_of(pair.id, seed))
    lever = start[:3, 3] - transform(start, points).mean(0)
    J = np.eye(6)
    J[:3, 3:] = -skew(lever)
    variances = np.repeat([DISTURBANCE_M**2 / 3, np.radians(DISTURBANCE_DEG) ** 2 / 3], 3)
    return Prior(start, J @ np.diag(variances) @ J.T, "given", "disturbed truth")
