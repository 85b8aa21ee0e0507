# SPDX-License-Identifier: Apache-2.0
"""What a result says besides its poses: for the diagnostics and the log."""

from __future__ import annotations

from garps_ros.estimates.outcomes import Outcome
from garps_ros.live.estimator import Result
from garps_ros.live.health import Health
from garps_ros.live.log import Log


def note_result(result: Result, health: Health, log: Log) -> None:
    """What became of the prior, doubts, keyframes, an error that nobody expected."""
    health.facts["prior"] = result.prior
    health.facts["doubts"] = "; ".join(result.doubts)
    if result.keyframes:
        health.facts["keyframes"] = str(result.keyframes)
    if result.prior not in ("none", "used"):
        log.warn("prior", f"prior {result.prior}")
    for doubt in result.doubts:
        log.warn(f"doubt {doubt}", doubt)
    if result.trace:
        log.error("estimate", f"unexpected error: {result.trace}")


def note_outcome(outcome: Outcome, health: Health) -> None:
    """Which frames it is of, and how much they share."""
    health.facts["frames"] = f"{outcome.child_frame_id} in {outcome.frame_id}"
    if outcome.row.overlap is not None:
        health.facts["overlap"] = f"{outcome.row.overlap:.2f}"
        health.facts["quality"] = f"{outcome.row.quality or 0:.2f}"
