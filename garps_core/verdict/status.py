# SPDX-License-Identifier: Apache-2.0
"""What to think of a solution: its status with a reason, and its quality as one number."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from garps_core.checks import Float64Array
from garps_core.config import Alignment
from garps_core.geometry import displacement, se3_inverse, se3_log, twist_from_ros
from garps_core.objective.brightness import BrightnessFit
from garps_core.solver.ladder import Solution
from garps_core.types import Mixture, Prior, Status

RIGHT_M, RIGHT_RAD = 0.05, float(np.radians(2.0))
"""What `quality` means by right."""


@dataclass(frozen=True)
class Finding:
    """A solution of the alignment, as it is reported.

    T: 4x4, sharpened or not. covariance: 6x6, ROS meaning. overlap: share of components the other camera sees, 0..1.
    seen: how brightness agrees at T; None where it is not known.
    """

    solution: Solution
    T: Float64Array
    covariance: Float64Array
    overlap: float
    seen: BrightnessFit | None

    @property
    def merit(self) -> float:
        """To choose between solutions of one pair: how well, and on how much, the views agree."""
        if self.seen is not None:
            return self.seen.correlation * self.seen.share
        return self.solution.data.value * self.overlap

    def convincing(self, settings: Alignment) -> bool:
        """Brightness agrees so well that no other solution needs to be looked for."""
        return self.seen is not None and self.seen.correlation >= settings.enough_correlation


def relative_uncertainty(source: Mixture, T: Float64Array, covariance: Float64Array) -> float:
    """Sigma of a typical scene point along its most uncertain direction, as a share of its range in the target."""
    points = source.means[:: max(1, len(source) // 200)].astype(np.float64) @ T[:3, :3].T + T[:3, 3]
    spread = np.linalg.eigvalsh(displacement(points, twist_from_ros(covariance, T)))[:, 2]
    return float(np.median(np.sqrt(spread) / np.linalg.norm(points, axis=1)))


def verdict(found: Finding, initial: Prior, guess: bool, uncertainty: float, settings: Alignment) -> tuple[Status, str]:
    """Status and reason of a solution, the gravest first.

    Args:
        found: the solution.
        initial: the pose it started from.
        guess: the start said next to nothing, so the solution must prove itself.
        uncertainty: `relative_uncertainty` of the solution.
        settings: thresholds.
    """
    solution = found.solution
    if settings.solver == "adam":
        return Status.CONVERGED, f"the paper's fixed number of steps, {solution.iterations}"
    T0 = initial.T_target_source
    r = se3_log(found.T @ se3_inverse(T0))
    distance = float(np.sqrt(r @ np.linalg.solve(twist_from_ros(initial.covariance, T0), r)))
    if distance > settings.max_prior_sigmas:
        return (
            Status.INCONSISTENT,
            f"the views pull {distance:.1f} sigmas away from the initial pose ({settings.max_prior_sigmas:g} allowed)",
        )
    doubt = _doubt(found, initial, guess, settings)
    if doubt:
        return Status.POOR_FIT, f"{doubt}: possibly a wrong optimum, give a better prior"
    if uncertainty > settings.max_uncertainty:
        return (
            Status.DEGENERATE,
            f"a direction stays open: scene points are uncertain by {uncertainty:.1%} of their range "
            f"({settings.max_uncertainty:.1%} allowed)",
        )
    if not solution.converged:
        return Status.MAX_ITERATIONS, f"still moving after {solution.iterations} steps"
    return Status.CONVERGED, f"converged in {solution.iterations} steps, {distance:.1f} sigmas from the initial pose"


def _doubt(found: Finding, initial: Prior, guess: bool, settings: Alignment) -> str:
    """Why the solution is not to be believed, or nothing."""
    wanted = settings.guess_support if guess and found.seen is None else settings.min_support
    support = found.solution.data.support
    if support < wanted:
        return (
            f"{support:.0%} of the components found a partner, expected {wanted:.0%} after this start "
            f"({initial.origin})"
        )
    least = settings.guess_correlation if guess else settings.min_correlation
    if found.seen is not None and found.seen.correlation < least:
        return (
            f"brightness agrees to {found.seen.correlation:.2f} (correlation), expected {least:g} after this start "
            f"({initial.origin})"
        )
    return ""


def quality(found: Finding, guess: bool) -> float:
    """How likely the pose is right to 5 cm and 2 deg, 0..1: to gate on and to rank by, not calibrated.

    How small its sigmas are, times how well the views agree: the correlation of their brightness, where it is known,
    and the share of components with a partner.
    """
    covariance = found.covariance
    metres, radians = (float(np.sqrt(np.trace(part))) for part in (covariance[:3, :3], covariance[3:, 3:]))
    precise = 1 / (1 + (0.5 * metres / RIGHT_M) ** 2 + (0.5 * radians / RIGHT_RAD) ** 2)
    agreement = _logistic((found.solution.data.support - 0.4) / 0.1)
    if found.seen is not None:
        agreement *= _logistic((found.seen.correlation - 0.75) / 0.08)
    elif guess:
        agreement *= 0.5
    return float(precise * agreement)


def _logistic(x: float) -> float:
    return float(1 / (1 + np.exp(-np.clip(x, -50, 50))))
