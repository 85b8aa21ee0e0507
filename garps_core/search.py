# SPDX-License-Identifier: Apache-2.0
"""The start is a guess: several coarse beginnings around it, ranked by the objective, the best ones followed.

Kernels of a coarse rung are blurred by decimetres, so that surfaces pull from where a guess leaves them. Even so an
optimum is only found from some tens of degrees, hence beginnings that are turned about the camera's axes. The prior
holds all of them together: it is as wide as the guess.
"""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation

from garps_core.config import Alignment
from garps_core.geometry import Array, se3_inverse, se3_log
from garps_core.joint import State
from garps_core.pairing import Cloud, overlap
from garps_core.solve import Belief, Solution, descend, seen_closely

RINGS = ((1.5, 6, 0.0), (3.0, 8, 0.5))
"""Beginnings are turned by so many sigmas of the guess's rotation, about so many axes across the view, the first
so many steps from x."""
SAME_RAD = 0.1
"""Beginnings that end closer to each other than this (rad, m) are one."""


def search(source: Cloud, target: Cloud, known: Belief, settings: Alignment) -> list[Solution]:
    """Maximum a posteriori alignments from a guess, the most promising first; none when too little is visible."""
    begun = [
        found
        for T in beginnings(known)
        if (found := descend(source, target, _at(T, known), known, settings.search, settings)) is not None
    ]
    begun.sort(key=lambda found: -_merit(found, source, target, settings))
    followed = [
        seen_closely(end, source, target, settings)
        for found in _distinct(begun)[: settings.search_followed]
        if (end := descend(source, target, found.at, known, settings.search_ladder, settings)) is not None
    ]
    return sorted(followed, key=lambda end: -_merit(end, source, target, settings))


def beginnings(known: Belief) -> list[Array]:
    """Poses to begin from: the guess itself, and it turned about axes across the line of sight."""
    sigma = float(np.sqrt(np.trace(np.linalg.inv(known.precision)[3:, 3:]) / 3))
    poses = [known.T]
    for turns, count, first in RINGS:
        for angle in 2 * np.pi * (np.arange(count) + first) / count:
            T = np.eye(4)
            T[:3, :3] = Rotation.from_rotvec(turns * sigma * np.array([np.cos(angle), np.sin(angle), 0])).as_matrix()
            poses.append(T @ known.T)
    return poses


def _at(T: Array, known: Belief) -> State:
    return State(T, np.zeros(len(known.error_precision)))


def _merit(found: Solution, source: Cloud, target: Cloud, settings: Alignment) -> float:
    """The objective's mean counts only what both cameras see, so it is worth the share that they see."""
    return found.data.value * overlap(source, target, found.T, settings)


def _distinct(found: list[Solution]) -> list[Solution]:
    kept: list[Solution] = []
    for one in found:
        if all(np.linalg.norm(se3_log(one.T @ se3_inverse(other.T))) > SAME_RAD for other in kept):
            kept.append(one)
    return kept
