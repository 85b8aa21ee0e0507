# SPDX-License-Identifier: Apache-2.0
"""Frames in, outcomes out: every pair becomes an estimate, or the reason why there is none."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass

from garps_core.checks import Float64Array
from garps_core.errors import GarpsError, InputError, ReconstructionError
from garps_core.types import PoseEstimate, View
from garps_ros.estimates.keyframes import Estimate, KeyframeTracker
from garps_ros.frames.frame import Frame, frame_warning, view_from_messages
from msg_adapters import MessageError, header_frame_id

FAILURES: dict[type[Exception], str] = {
    MessageError: "malformed_message",
    InputError: "invalid_input",
    ReconstructionError: "no_reconstruction",
}
OTHER_FAILURE = "core_error"

Completed = Callable[[View], View]
"""A function that gives a view the depth that its estimates are made from."""


@dataclass(frozen=True, eq=False)
class Row:
    """One line of poses.csv: an estimate of `source` in `target`, or why there is none."""

    source_stamp_ns: int
    target_stamp_ns: int
    source_frame: str
    target_frame: str
    status: str
    reason: str
    overlap: float | None = None
    T_target_source: Float64Array | None = None
    covariance: Float64Array | None = None
    segment: int = 0
    quality: float | None = None


@dataclass(frozen=True)
class Origin:
    """The start of a trajectory; with a stamp (ns), its first pose is the identity at that time."""

    segment: int
    frame_id: str
    child_frame_id: str
    stamp_ns: int | None = None


@dataclass(frozen=True, eq=False)
class Outcome:
    """The row of a pair, and the pose to publish; T None = nothing is published.

    Args:
        row: of poses.csv.
        frame_id: frame in which `T` places the camera.
        child_frame_id: frame of the camera.
        T: 4x4, the camera in `frame_id`.
        covariance: 6x6 of `T` in the ROS meaning.
        seconds: wall time from messages to pose.
    """

    row: Row
    frame_id: str
    child_frame_id: str
    T: Float64Array | None
    covariance: Float64Array | None
    seconds: float | None


class ViewReader:
    """Makes a View of a Frame, and logs the calibration in use at first and whenever it changes.

    Args:
        rectified: "auto", "rectified" or "raw".
        say: called with a line for people.
        allow_resized: accept images that were scaled evenly against their CameraInfo.
    """

    def __init__(self, rectified: str, say: Callable[[str], None], allow_resized: bool = False) -> None:
        self.rectified, self.allow_resized, self._say = rectified, allow_resized, say
        self._said: dict[str, str] = {}
        self.warnings: dict[str, str] = {}
        """Image topic -> warning that the last frame may hold another camera's calibration or depth; "" = none."""

    def read(self, frame: Frame) -> View:
        """Decode, choose the calibration, undistort. Raises MessageError or InputError."""
        topic = frame.topics.image
        view, decision = view_from_messages(
            frame.image,
            frame.info,
            frame.depth,
            topic=topic,
            rectified=self.rectified,
            allow_resized=self.allow_resized,
        )
        self.warnings[topic] = frame_warning(frame.image, frame.info, frame.depth)
        told = f"{decision}; {self.warnings[topic]}" if self.warnings[topic] else decision
        if self._said.get(topic) != told:
            self._said[topic] = told
            self._say(f"{topic}: {told}")
        return view


def estimate_pairs(
    pairs: Iterable[tuple[Frame, Frame]], reader: ViewReader, estimate: Estimate
) -> Iterator[Origin | Outcome]:
    """Estimate the pose of the first camera of each pair (source) in the second (target)."""
    begun = False
    for source, target in pairs:
        outcome = estimate_pair(source, target, reader, estimate)
        if not begun:
            yield Origin(0, outcome.frame_id, outcome.child_frame_id)
            begun = True
        yield outcome


def estimate_pair(source: Frame, target: Frame, reader: ViewReader, estimate: Estimate) -> Outcome:
    """Estimate the pose of the source camera in the target camera; the outcome says why there is none."""
    began = time.perf_counter()
    source_name, target_name = names = frame_names(source, target)
    stamps = source.stamp_ns, target.stamp_ns
    try:
        found = estimate(reader.read(source), reader.read(target))
    except (MessageError, GarpsError) as error:
        return Outcome(_failed(stamps, names, 0, error), target_name, source_name, None, None, None)
    T, covariance = (found.T_target_source, found.covariance) if found.ok else (None, None)
    seconds = time.perf_counter() - began
    return Outcome(_row(stamps, names, 0, found), target_name, source_name, T, covariance, seconds)


def estimate_keyframes(
    frames: Iterable[Frame], reader: ViewReader, tracker: KeyframeTracker, completed: Completed = lambda view: view
) -> Iterator[Origin | Outcome]:
    """Estimate one camera's pose in the first keyframe of its segment; rows hold the pose in the keyframe used."""
    for frame in frames:
        yield from follow_frame(frame, reader, tracker, completed)


def follow_frame(
    frame: Frame, reader: ViewReader, tracker: KeyframeTracker, completed: Completed = lambda view: view
) -> Iterator[Origin | Outcome]:
    """Follow the camera to one more frame; yield an Origin where a segment begins, else every attempt at a pose.

    A view is `completed` once, however many estimates it takes part in.
    """
    began = time.perf_counter()
    name = frame_name(frame)
    try:
        view = completed(reader.read(frame))
        if tracker.begins(view):
            yield Origin(tracker.segment, _start_name(name, tracker), name, view.stamp_ns)
            return
        for attempt in tracker.follow(view):
            stamps = frame.stamp_ns, attempt.target.stamp_ns
            row = _row(stamps, (name, name), tracker.segment, attempt.estimate)
            seconds = time.perf_counter() - began
            start = _start_name(name, tracker)
            yield Outcome(row, start, name, attempt.T_start_source, attempt.covariance, seconds)
            began = time.perf_counter()
    except (MessageError, GarpsError) as error:
        stamps, start = (frame.stamp_ns, tracker.keyframe_stamp_ns), _start_name(name, tracker)
        yield Outcome(_failed(stamps, (name, name), tracker.segment, error), start, name, None, None, None)


def _start_name(name: str, tracker: KeyframeTracker) -> str:
    return f"{name}_start" + (f"_{tracker.segment}" if tracker.segment > 1 else "")


def failed_outcome(frames: tuple[Frame, ...], error: Exception) -> Outcome:
    """Return the outcome of one or two frames that ended in an unexpected error."""
    source, target = frames[0], frames[-1]
    names = frame_names(source, target) if len(frames) == 2 else (frame_name(source), frame_name(source))
    row = _failed((source.stamp_ns, target.stamp_ns), names, 0, error)
    return Outcome(row, names[1], names[0], None, None, None)


def frame_names(source: Frame, target: Frame) -> tuple[str, str]:
    """Return the frame names of both cameras, from their topics where the drivers give none, or one name to both."""
    names = header_frame_id(source.image), header_frame_id(target.image)
    return names if all(names) and names[0] != names[1] else (_topic_name(source), _topic_name(target))


def frame_name(frame: Frame) -> str:
    """Return the frame name of one camera, from its topic where the driver gives none."""
    return header_frame_id(frame.image) or _topic_name(frame)


def _topic_name(frame: Frame) -> str:
    return frame.topics.image.strip("/").replace("/", "_")


def _row(stamps: tuple[int, int], names: tuple[str, str], segment: int, found: PoseEstimate) -> Row:
    pose = found.T_target_source, found.covariance
    return Row(*stamps, *names, found.status.value, found.reason, found.overlap, *pose, segment, found.quality)


def _failed(stamps: tuple[int, int], names: tuple[str, str], segment: int, error: Exception) -> Row:
    kind = next((name for kind, name in FAILURES.items() if isinstance(error, kind)), OTHER_FAILURE)
    reason = str(error) if isinstance(error, (MessageError, GarpsError)) else f"{type(error).__name__}: {error}"
    return Row(*stamps, *names, kind, reason, segment=segment)
