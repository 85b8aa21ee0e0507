# SPDX-License-Identifier: Apache-2.0
"""The computation of the live node: a job holds messages that belong together, its result the outcomes.

It takes the same steps as the offline replay (`estimates.outcomes`), so that both give the same poses.
"""

from __future__ import annotations

import math
import time
import traceback
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from typing import Any

from garps_core.align import Estimator
from garps_core.config import Config
from garps_core.geometry import se3_inverse
from garps_core.models.in_use import Networks
from garps_core.types import Mixture, PoseEstimate, Prior, View
from garps_ros.estimates.keyframes import KeyframeRule, KeyframeTracker
from garps_ros.estimates.outcomes import (
    Origin,
    Outcome,
    ViewReader,
    estimate_pair,
    failed_outcome,
    follow_frame,
    frame_names,
)
from garps_ros.estimates.preparation import (
    completed,
    depth_share,
    load_networks,
    scale_from,
    settings_of_completed,
    warm_up,
)
from garps_ros.frames.frame import Frame
from garps_ros.live.clouds import ColouredPoints, coloured_points
from garps_ros.live.priors import prior_from_message
from garps_ros.parameters.settings import NodeSettings
from msg_adapters import MessageError, header_frame_id

CORE_STAGES = ("depth", "estimate")
"""Stages that count as time of the core."""


@dataclass(frozen=True, eq=False)
class Job:
    """One pair of frames, or one frame to follow, and everything that its computation depends on.

    Args:
        frames: (source, target), or (source,) to be followed against its keyframe.
        settings, config: as they were when the frames became complete.
        epoch: counts resets and jumps back in time; a keyframe of another epoch is forgotten.
        generation: counts everything that makes earlier results stale; a result of another generation is dropped.
        arrived_s: steady time at which the frames became complete.
        prior: PoseWithCovarianceStamped for this pair, or None.
        clouds: also make the point clouds.
    """

    frames: tuple[Frame, ...]
    settings: NodeSettings
    config: Config
    epoch: int = 0
    generation: int = 0
    arrived_s: float = 0.0
    prior: Any = None
    clouds: bool = False


@dataclass(eq=False)
class Result:
    """The outcomes of a job, with their report."""

    job: Job
    outcomes: list[Origin | Outcome] = field(default_factory=list)
    began_s: float = 0.0
    """Steady time at which the computation began, s."""
    core_s: float = 0.0
    """Time inside the core, all attempts and a network's depth together, s."""
    prior: str = "none"
    """"none", "used", or the reason why the prior was not used."""
    warnings: list[str] = field(default_factory=list)
    """Frame names that look wrong; poses are computed all the same."""
    clouds: tuple[ColouredPoints, ColouredPoints] | None = None
    """Source and target, both in the target frame; None without a pose, or when the job did not ask."""
    trace: str = ""
    """Traceback of an unexpected error."""
    keyframes: int = 0
    """Keyframes so far of the camera that is followed."""

    @property
    def attempt(self) -> Outcome | None:
        """The first attempt with a pose, else the last attempt; None where a trajectory begins."""
        attempts = [outcome for outcome in self.outcomes if isinstance(outcome, Outcome)]
        return next((attempt for attempt in attempts if attempt.T is not None), attempts[-1] if attempts else None)


def decisive_settings(settings: NodeSettings, config: Config) -> tuple[tuple[Any, ...], tuple[Any, ...]]:
    """Return the settings that a result depends on: those that decide how images are read, and the others."""
    reading = settings.rectified, settings.allow_resized, config.reconstruction
    return reading, (settings.source_frame, settings.target_frame, config)


class JobRunner:
    """Computes jobs one after the other; keeps the keyframe between them.

    Args:
        say: called, in the worker's thread, with a line for people.
    """

    def __init__(self, say: Callable[[str], None]) -> None:
        self._say, self._networks = say, Networks()
        self._reader = ViewReader("auto", say)
        self._tracker: KeyframeTracker | None = None
        self._epoch = -1
        self._job: Job
        self._result: Result
        self._prior: Prior | None = None
        self._aligned: tuple[PoseEstimate, tuple[Mixture, Mixture] | None] | None = None
        self.stage = ""
        """The present stage of the work; "" between jobs."""
        self.scale = ""
        """The source of metric scale, in words; "" until prepared."""

    def prepare(self, config: Config) -> None:
        """Load networks and compile, so that the first job need not wait. Raises what `load_networks` does."""
        with self._in_stage("load networks"):
            load_networks(config, self._say, self._networks)
            self.scale = scale_from(config)
        with self._in_stage("compile"):
            warm_up(config, self._say)

    def __call__(self, job: Job) -> Result:
        """Compute a job. An unexpected error becomes an outcome with status core_error and a traceback."""
        self._job, self._result, self._aligned, self._prior = job, Result(job, began_s=time.monotonic()), None, None
        self._reader.rectified, self._reader.allow_resized = job.settings.rectified, job.settings.allow_resized
        result = self._result
        with self._in_stage("decode"):
            try:
                for outcome in self._outcomes():
                    result.outcomes.append(self._renamed(outcome))
                result.warnings = self._warnings()
                if job.clouds and result.outcomes:
                    result.clouds = self._clouds(result.outcomes[-1])
            except Exception as error:
                result.trace = traceback.format_exc()
                result.outcomes.append(failed_outcome(job.frames, error))
        return result

    def _outcomes(self) -> Iterator[Origin | Outcome]:
        frames = self._job.frames
        if len(frames) == 2:
            self._read_prior()
            yield estimate_pair(frames[0], frames[1], self._reader, self._estimate)
            return
        yield from follow_frame(frames[0], self._reader, self._followed(), self._completed)
        self._result.keyframes = self._followed().keyframes

    def _followed(self) -> KeyframeTracker:
        settings = self._job.settings
        rule = KeyframeRule(
            settings.keyframe_overlap,
            settings.keyframe_motion,
            math.radians(settings.keyframe_rotation),
            settings.keyframe_lost_after,
            depth_share(self._job.config),
        )
        if self._tracker is None or self._epoch != self._job.epoch:
            # Segments are counted on: poses of before and after a reset must not share a frame.
            segment = 0 if self._tracker is None else self._tracker.segment
            self._tracker, self._epoch = KeyframeTracker(self._estimate, rule, segment), self._job.epoch
        self._tracker.rule = rule
        return self._tracker

    def _read_prior(self) -> None:
        if self._job.prior is None:
            return
        try:
            target_frame = self._job.settings.target_frame or frame_names(self._job.frames[0], self._job.frames[1])[1]
            self._prior = prior_from_message(self._job.prior, target_frame)
        except MessageError as error:
            self._result.prior = f"refused: {error}"

    def _warnings(self) -> list[str]:
        frames, settings = self._job.frames, self._job.settings
        warnings = [f"{f.topics.image}: {w}" for f in frames if (w := self._reader.warnings.get(f.topics.image))]
        told = [header_frame_id(frame.image) for frame in frames]
        named = settings.source_frame and (settings.target_frame or len(frames) == 1)
        if not named and (not all(told) or len(set(told)) < len(told)):
            what = f"images say frame_id {', '.join(map(repr, told))}: topics name the frames instead"
            warnings.append(f"{what}; set source_frame and target_frame")
        return warnings

    def _completed(self, view: View) -> View:
        with self._in_stage("depth"):
            return completed(view, self._job.config, self._networks)

    def _estimate(self, source: View, target: View) -> PoseEstimate:
        config = self._job.config
        if len(self._job.frames) == 1:
            config = settings_of_completed(config)
        with self._in_stage("estimate"):
            found, mixtures = Estimator(config, self._networks).estimate_with_mixtures(source, target, self._prior)
        if self._prior is not None:
            self._result.prior = self._use_of_prior(found)
        self._aligned = found, mixtures if self._job.clouds else None
        return found

    def _use_of_prior(self, found: PoseEstimate) -> str:
        """Return "used", alone or together with a measured start, or the reason why the prior was not used."""
        method = self._job.config.start.method
        if found.initial is None:
            return f"not used: {found.status.value}"
        if found.initial.origin.split(" and ")[0] == "given":
            return "used"
        if method in ("features", "identity"):
            return f"not used: start.method is {method}"
        verb = "contradict" if found.initial.origin == "features" else "contradicts"
        return f"not used: {found.initial.origin} {verb} it"

    def _renamed(self, outcome: Origin | Outcome) -> Origin | Outcome:
        """Replace the frame names where the settings give others."""
        settings = self._job.settings
        segment = outcome.segment if isinstance(outcome, Origin) else outcome.row.segment
        target = settings.target_frame and settings.target_frame + (f"_{segment}" if segment > 1 else "")
        return replace(
            outcome,
            frame_id=target or outcome.frame_id,
            child_frame_id=settings.source_frame or outcome.child_frame_id,
        )

    def _clouds(self, outcome: Origin | Outcome) -> tuple[ColouredPoints, ColouredPoints] | None:
        """Return both clouds in the frame of the outcome, which is not always the keyframe's own."""
        if isinstance(outcome, Origin) or outcome.T is None or self._aligned is None:
            return None
        found, mixtures = self._aligned
        if found.T_target_source is None or mixtures is None:
            return None
        with self._in_stage("clouds"):
            T_frame_target = outcome.T @ se3_inverse(found.T_target_source)
            return coloured_points(mixtures[0], outcome.T), coloured_points(mixtures[1], T_frame_target)

    @contextmanager
    def _in_stage(self, name: str) -> Iterator[None]:
        before, self.stage, began = self.stage, name, time.perf_counter()
        try:
            yield
        finally:
            self.stage = before
            if name in CORE_STAGES:
                self._result.core_s += time.perf_counter() - began
