# SPDX-License-Identifier: Apache-2.0
"""Candidates for the pose of one pair of views, and the choice among them."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

from garps_core.checks import Float64Array
from garps_core.config import Alignment
from garps_core.objective.brightness import BrightnessFit
from garps_core.solver.ladder import Solution

CONVINCING_SHARE = 0.25
"""Smallest shared share that makes a correlation convincing: smooth walls correlate over any sliver, while right poses
0.6 m and 20 degrees apart in a room share about a half."""


@dataclass(frozen=True)
class Candidate:
    """A solution of the alignment with what is needed to judge it.

    T: 4x4, after the fit of brightness if there was one. covariance: 6x6, ROS order and meaning.
    overlap: share of components that the other camera sees, 0..1, the smaller of both directions.
    brightness: agreement of brightness at T; None where it could not be compared.
    """

    solution: Solution
    T: Float64Array
    covariance: Float64Array
    overlap: float
    brightness: BrightnessFit | None

    @property
    def merit(self) -> float:
        """Agreement times shared share: correlation x share (0..1), or objective x overlap without brightness."""
        if self.brightness is not None:
            return self.brightness.correlation * self.brightness.share
        return self.solution.data.value * self.overlap

    @property
    def rank(self) -> tuple[bool, float]:
        """Order among the candidates of one pair; merits with and without brightness have no common scale."""
        return self.brightness is not None, self.merit

    def convincing(self, settings: Alignment) -> bool:
        """Whether brightness agrees so well, over so much of both views, that no other candidate is needed."""
        if self.brightness is None:
            return False
        shared = min(self.overlap, self.brightness.share)
        enough = max(CONVINCING_SHARE, settings.min_overlap)
        return self.brightness.correlation >= settings.enough_correlation and shared >= enough


def best_candidate(candidates: Iterable[Candidate], settings: Alignment) -> Candidate | None:
    """The first convincing candidate, else the one of the highest rank; None when there is none.

    Candidates may be computed on demand: none is asked for after a convincing one.
    """
    best: Candidate | None = None
    for candidate in candidates:
        if candidate.convincing(settings):
            return candidate
        if best is None or candidate.rank > best.rank:
            best = candidate
    return best
