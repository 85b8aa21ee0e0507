# SPDX-License-Identifier: Apache-2.0
"""Photometric multi-start search: Gauss-Newton on 40-pixel thumbnails from many starting rotations.

On a thumbnail every lamp and shadow has a slope, so brightness attracts from several degrees away and one ascent costs
a few milliseconds. It recognises views that have hardly a feature. The objective of the mixtures finds other optima
(`search.py`): walls attract where brightness is flat.
"""

from __future__ import annotations

from garps_core.geometry import Array
from garps_core.mixture import Frustum
from garps_core.objective.brightness import Grid, ascend_on, comparisons, grid_of
from garps_core.objective.state import WeightedStart

WIDTH_PX = 40
"""Width of a thumbnail: small enough for basins of some degrees, large enough for enough points."""
POINT_WEIGHT = 0.4
"""Independent measurements per point of a thumbnail; small, so that poses far from the guess need clear evidence."""
FIRST_STEPS, MORE_STEPS = 3, 5
"""Gauss-Newton steps from every starting pose, and of those that are continued."""
CONTINUED = 24
"""Ascents that are continued after the first steps; the others are already worse."""


def search_by_brightness(
    source: Frustum, target: Frustum, start: WeightedStart, starting_poses: list[Array]
) -> list[Array]:
    """Poses (4x4) where brightness agrees, best first; none when the views have no brightness or share too little.

    Args:
        source, target: frustums with brightness.
        start: the guess with its precision, the prior of every ascent.
        starting_poses: poses (4x4) to start from.
    """
    if source.brightness is None or target.brightness is None:
        return []
    x, y = (grid_of(view, max(1, round(view.depth.shape[1] / WIDTH_PX))) for view in (source, target))
    ends = starting_poses
    for steps in (FIRST_STEPS, MORE_STEPS):
        moved = [ascend_on(x, y, at, start.T, start.precision, POINT_WEIGHT, steps) for at in ends]
        ends = [at for merit, at in sorted(((_agreement(x, y, at), at) for at in moved), key=_first) if merit > 0]
        ends = ends[:CONTINUED]
    return ends


def _first(ranked: tuple[float, Array]) -> float:
    return -ranked[0]


def _agreement(x: Grid, y: Grid, T: Array) -> float:
    """Correlation of brightness times the share that both cameras see; 0 where too little is shared."""
    fits = comparisons(x, y, T)
    if fits is None:
        return 0.0
    return min(fit.correlation for fit in fits) * min(fit.share for fit in fits)
