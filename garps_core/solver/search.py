# SPDX-License-Identifier: Apache-2.0
"""Multi-start search: the start is a guess, so the alignment is tried from poses turned all around it.

Two objectives rank the starting poses. A coarse rung of the mixtures, blurred by decimetres, finds bare walls by their
shape; brightness on thumbnails (`brightness_search.py`) finds places with little shape. The best of both are followed
down the ladder. Even blurred, an optimum attracts from some tens of degrees only, hence the turned starting poses. The
prior, as wide as the guess, holds all of them together.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from itertools import islice, zip_longest

import numpy as np
from scipy.spatial.transform import Rotation

from garps_core.geometry import Array, se3_inverse, se3_log
from garps_core.objective.pairs import overlap
from garps_core.objective.state import State, WeightedStart
from garps_core.solver.brightness_search import search_by_brightness
from garps_core.solver.ladder import Solution, run_ladder, with_final_pairs
from garps_core.solver.problem import Problem

Rings = tuple[tuple[float, int, float], ...]
"""Rings of starting poses: angle (in sigmas of the start's rotation), number of axes, axis of the first (in steps)."""
RINGS: Rings = ((1.5, 6, 0.0), (3.0, 8, 0.5))
"""Starting poses of the search by shape."""
FINE_RINGS: Rings = tuple((0.5 * ring, 12, 0.5 * (ring % 2)) for ring in range(1, 7))
"""Starting poses of the search by brightness, whose basins are smaller."""
SAME_RAD = 0.1
"""Twist (rad, m) below which two poses count as one."""


def search(problem: Problem) -> Iterator[Solution]:
    """Maximum a posteriori alignments from a guess, the most promising first, each computed when it is asked for.

    At most `search_followed`; none when too little is visible.
    """
    for at in islice(_distinct(_promising(problem)), problem.settings.search_followed):
        end = run_ladder(problem, at, problem.settings.search_ladder)
        if end is not None:
            yield with_final_pairs(end, problem)


def _promising(problem: Problem) -> Iterator[State]:
    """The best by brightness, then alternately by shape and by brightness; shape runs only if one is not enough."""
    by_brightness = [problem.state(T) for T in _by_brightness(problem)]
    yield from by_brightness[:1]
    for pair in zip_longest(_by_shape(problem), by_brightness[1:]):
        yield from (at for at in pair if at is not None)


def _by_shape(problem: Problem) -> list[State]:
    """Ends of the coarse ascents from around the guess, the best first."""
    ends = [
        end
        for T in starting_poses(problem.start, RINGS)
        if (end := run_ladder(problem, problem.state(T), problem.settings.search)) is not None
    ]
    ends.sort(key=lambda end: -_merit(end, problem))
    return [end.at for end in ends]


def _by_brightness(problem: Problem) -> list[Array]:
    """Ends (4x4) of the photometric search from around the guess, the best first; none without frustums."""
    source, target = problem.source.frustum, problem.target.frustum
    if source is None or target is None:
        return []
    return search_by_brightness(source, target, problem.start, starting_poses(problem.start, FINE_RINGS))


def starting_poses(start: WeightedStart, rings: Rings) -> list[Array]:
    """The start's pose (4x4), then that pose turned about axes in the image plane, ring by ring."""
    sigma = float(np.sqrt(np.trace(np.linalg.inv(start.precision)[3:, 3:]) / 3))
    poses = [start.T]
    for turns, count, first in rings:
        for angle in 2 * np.pi * (np.arange(count) + first) / count:
            T = np.eye(4)
            T[:3, :3] = Rotation.from_rotvec(turns * sigma * np.array([np.cos(angle), np.sin(angle), 0])).as_matrix()
            poses.append(T @ start.T)
    return poses


def _merit(end: Solution, problem: Problem) -> float:
    """Objective times overlap: the objective is a mean over what both cameras see, however little that is."""
    return end.data.value * overlap(problem.source, problem.target, end.T, problem.settings)


def _distinct(states: Iterable[State]) -> Iterator[State]:
    """The states without those close to an earlier one."""
    kept: list[State] = []
    for at in states:
        if all(np.linalg.norm(se3_log(at.T @ se3_inverse(other.T))) > SAME_RAD for other in kept):
            kept.append(at)
            yield at
