# SPDX-License-Identifier: Apache-2.0
"""The start is a guess: coarse starting_poses all around it, by shape and by sight; the best of both are followed.

Kernels of a coarse rung are blurred by decimetres, so that surfaces pull from where a guess leaves them. Even so an
optimum is only found from some tens of degrees, hence starting_poses that are turned about the camera's axes, ranked by
the objective. Brightness (`brightness_search.py`) finds places with little shape; bare walls are found by shape.
The prior holds all of them together: it is as wide as the guess.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from itertools import islice, zip_longest

import numpy as np
from scipy.spatial.transform import Rotation

from garps_core.config import Alignment
from garps_core.geometry import Array, se3_inverse, se3_log
from garps_core.objective.pairs import DeviceMixture, overlap
from garps_core.objective.state import State, WeightedStart
from garps_core.solver.brightness_search import search_by_brightness
from garps_core.solver.ladder import Solution, run_ladder, with_final_pairs

RINGS = ((1.5, 6, 0.0), (3.0, 8, 0.5))
"""Where the objective's descents begin (`starting_poses`)."""
FINE_RINGS = tuple((0.5 * ring, 12, 0.5 * (ring % 2)) for ring in range(1, 7))
"""Where those of brightness begin: their basins are smaller."""
SAME_RAD = 0.1
"""Poses to follow that are closer to each other than this (rad, m) are one."""


def search(
    source: DeviceMixture, target: DeviceMixture, known: WeightedStart, settings: Alignment
) -> Iterator[Solution]:
    """Maximum a posteriori alignments from a guess, the most promising first, found one by one as they are asked for.

    At most `search_followed`; none when too little is visible.
    """
    for at in islice(_distinct(_promising(source, target, known, settings)), settings.search_followed):
        end = run_ladder(source, target, at, known, settings.search_ladder, settings)
        if end is not None:
            yield with_final_pairs(end, source, target, settings)


def _promising(
    source: DeviceMixture, target: DeviceMixture, known: WeightedStart, settings: Alignment
) -> Iterator[State]:
    """The best by sight, then the next by shape and by sight in turn; shape is asked only if one is not enough."""
    by_sight = [_at(T, known) for T in _seen_from_around(source, target, known)]
    yield from by_sight[:1]
    for pair in zip_longest(_by_shape(source, target, known, settings), by_sight[1:]):
        yield from (at for at in pair if at is not None)


def _by_shape(source: DeviceMixture, target: DeviceMixture, known: WeightedStart, settings: Alignment) -> list[State]:
    """Where the objective, blurred by decimetres, leads from around the guess, the best first."""
    begun = [
        found
        for T in starting_poses(known, RINGS)
        if (found := run_ladder(source, target, _at(T, known), known, settings.search, settings)) is not None
    ]
    begun.sort(key=lambda found: -_merit(found, source, target, settings))
    return [found.at for found in begun]


def _seen_from_around(source: DeviceMixture, target: DeviceMixture, known: WeightedStart) -> list[Array]:
    if source.frustum is None or target.frustum is None:
        return []
    return search_by_brightness(source.frustum, target.frustum, known, starting_poses(known, FINE_RINGS))


def starting_poses(known: WeightedStart, rings: tuple[tuple[float, int, float], ...]) -> list[Array]:
    """Poses to begin from: the guess itself, and it turned about axes across the line of sight.

    A ring is turned by so many sigmas of the guess's rotation, about so many axes, the first so many steps from x.
    """
    sigma = float(np.sqrt(np.trace(np.linalg.inv(known.precision)[3:, 3:]) / 3))
    poses = [known.T]
    for turns, count, first in rings:
        for angle in 2 * np.pi * (np.arange(count) + first) / count:
            T = np.eye(4)
            T[:3, :3] = Rotation.from_rotvec(turns * sigma * np.array([np.cos(angle), np.sin(angle), 0])).as_matrix()
            poses.append(T @ known.T)
    return poses


def _at(T: Array, known: WeightedStart) -> State:
    return State(T, np.zeros(len(known.error_precision)))


def _merit(found: Solution, source: DeviceMixture, target: DeviceMixture, settings: Alignment) -> float:
    """The objective's mean counts only what both cameras see, so it is worth the share that they see."""
    return found.data.value * overlap(source, target, found.T, settings)


def _distinct(states: Iterable[State]) -> Iterator[State]:
    """Without those that lie by an earlier one."""
    kept: list[State] = []
    for at in states:
        if all(np.linalg.norm(se3_log(at.T @ se3_inverse(other.T))) > SAME_RAD for other in kept):
            kept.append(at)
            yield at
