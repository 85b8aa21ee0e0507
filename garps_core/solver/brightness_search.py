# SPDX-License-Identifier: Apache-2.0
"""Where a guess may lead by what the cameras saw: brightness descents on small pictures, from all around the guess.

On a picture of 40 pixels across, with a slope at every lamp and shadow, brightness pulls from several degrees away, and
a descent costs a few milliseconds. That is how a view is recognised that has hardly a feature. The objective of the
mixtures finds other optima (`search.py`): walls pull where brightness is flat.
"""

from __future__ import annotations

from garps_core.geometry import Array
from garps_core.mixture import Frustum
from garps_core.objective.brightness import Grid, climb_on, comparisons, grid_of
from garps_core.objective.state import WeightedStart

WIDTH_PX = 40
"""Of the small pictures: a basin of some degrees, and still enough points."""
INFORMATION = 0.4
"""Independent measurements a point of them is worth: what is far from the guess must be seen clearly."""
FIRST_STEPS, MORE_STEPS = 3, 5
PURSUED = 24
"""Descents that are carried on after the first steps: the others are worse already."""


def search_by_brightness(
    source: Frustum, target: Frustum, known: WeightedStart, starting_poses: list[Array]
) -> list[Array]:
    """Poses (4x4) where brightness agrees, best first; none when the views have no brightness or share too little.

    Args:
        source, target: what the cameras saw.
        known: the guess with its precision, which holds every descent.
        starting_poses: poses (4x4) to begin from.
    """
    if source.brightness is None or target.brightness is None:
        return []
    x, y = (grid_of(view, max(1, round(view.depth.shape[1] / WIDTH_PX))) for view in (source, target))
    ends = starting_poses
    for steps in (FIRST_STEPS, MORE_STEPS):
        moved = [climb_on(x, y, at, known.T, known.precision, INFORMATION, steps) for at in ends]
        ends = [at for merit, at in sorted(((_agreement(x, y, at), at) for at in moved), key=_first) if merit > 0]
        ends = ends[:PURSUED]
    return ends


def _first(ranked: tuple[float, Array]) -> float:
    return -ranked[0]


def _agreement(x: Grid, y: Grid, T: Array) -> float:
    """Correlation of brightness times the share that both cameras see; 0 where too little is seen."""
    seen = comparisons(x, y, T)
    if seen is None:
        return 0.0
    return min(one.correlation for one in seen) * min(one.share for one in seen)
