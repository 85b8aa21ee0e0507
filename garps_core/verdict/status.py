# SPDX-License-Identifier: Apache-2.0
"""Status of a candidate with its reason, and its quality as one number."""

from __future__ import annotations

import numpy as np

from garps_core.checks import Float64Array
from garps_core.config import Alignment
from garps_core.geometry import displacement, se3_inverse, se3_log, twist_from_ros
from garps_core.types import Mixture, Prior, Status
from garps_core.verdict.candidate import Candidate

RIGHT_M, RIGHT_RAD = 0.05, float(np.radians(2.0))
"""Errors (m, rad) up to which `quality` calls a pose right."""
FIXED_STEPS_SUPPORT = 0.65
"""Smallest share of components with a partner after a fixed number of steps. Such a pose need not be an optimum, so
more is expected of it: in rooms, the share is at least 0.69 up to 3 cm off the truth, and at most 0.60 at 10 cm."""


def relative_uncertainty(source: Mixture, T: Float64Array, covariance: Float64Array) -> float:
    """Sigma of a typical scene point along its most uncertain direction, as a share of its range in the target."""
    points = source.means[:: max(1, len(source) // 200)].astype(np.float64) @ T[:3, :3].T + T[:3, 3]
    spread = np.linalg.eigvalsh(displacement(points, twist_from_ros(covariance, T)))[:, 2]
    return float(np.median(np.sqrt(spread) / np.linalg.norm(points, axis=1)))


def verdict(
    candidate: Candidate, start: Prior, guess: bool, uncertainty: float, settings: Alignment
) -> tuple[Status, str]:
    """Status and reason of a candidate, whatever its method; the gravest status first.

    Args:
        candidate: the pose to judge.
        start: the pose from which it was found, with its covariance.
        guess: the start carries next to no information, so the pose needs more evidence.
        uncertainty: `relative_uncertainty` of the candidate.
        settings: thresholds.
    """
    solution, distance = candidate.solution, _sigmas_away(candidate.T, start)
    if distance > settings.max_prior_sigmas:
        return (
            Status.INCONSISTENT,
            f"the views pull {distance:.1f} sigmas away from the start ({settings.max_prior_sigmas:g} allowed)",
        )
    weakness = _missing_evidence(candidate, guess, settings)
    if weakness:
        return (
            Status.POOR_FIT,
            f"{weakness} after this start ({start.origin}): possibly a wrong optimum, give a better prior",
        )
    if uncertainty > settings.max_uncertainty:
        return (
            Status.DEGENERATE,
            f"a direction stays open: scene points are uncertain by {uncertainty:.1%} of their range "
            f"({settings.max_uncertainty:.1%} allowed)",
        )
    away = f"{distance:.1f} sigmas from the start"
    if solution.fixed_steps:
        return Status.CONVERGED, f"the paper's fixed number of steps, {solution.iterations}, {away}"
    if not solution.converged:
        return Status.MAX_ITERATIONS, f"still moving after {solution.iterations} steps"
    return Status.CONVERGED, f"converged in {solution.iterations} steps, {away}"


def _sigmas_away(T: Float64Array, start: Prior) -> float:
    """Mahalanobis distance of a pose from the start."""
    T0 = start.T_target_source
    r = se3_log(T @ se3_inverse(T0))
    return float(np.sqrt(r @ np.linalg.solve(twist_from_ros(start.covariance, T0), r)))


def _missing_evidence(candidate: Candidate, guess: bool, settings: Alignment) -> str:
    """The evidence that is missing for the pose, or nothing."""
    brightness, support = candidate.brightness, candidate.solution.data.support
    wanted = settings.guess_support if guess and brightness is None else settings.min_support
    if candidate.solution.fixed_steps:
        wanted = max(wanted, FIXED_STEPS_SUPPORT)
    if support < wanted:
        return f"{support:.0%} of the components found a partner, expected {wanted:.0%}"
    least = settings.guess_correlation if guess else settings.min_correlation
    if brightness is not None and brightness.correlation < least:
        return f"brightness agrees to {brightness.correlation:.2f} (correlation), expected {least:g}"
    return ""


def quality(candidate: Candidate, guess: bool) -> float:
    """Score of being right to 5 cm and 2 deg, 0..1: for thresholds and ranking, not a calibrated probability.

    It is the product of three factors: small sigmas, correlation of brightness where it was compared, and the share of
    components with a partner.
    """
    covariance = candidate.covariance
    metres, radians = (float(np.sqrt(np.trace(part))) for part in (covariance[:3, :3], covariance[3:, 3:]))
    precise = 1 / (1 + (0.5 * metres / RIGHT_M) ** 2 + (0.5 * radians / RIGHT_RAD) ** 2)
    agreement = _logistic((candidate.solution.data.support - 0.4) / 0.1)
    if candidate.brightness is not None:
        agreement *= _logistic((candidate.brightness.correlation - 0.75) / 0.08)
    elif guess:
        agreement *= 0.5
    return float(precise * agreement)


def _logistic(x: float) -> float:
    return float(1 / (1 + np.exp(-np.clip(x, -50, 50))))
