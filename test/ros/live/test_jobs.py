# SPDX-License-Identifier: Apache-2.0
"""The worker computes the same as the replay; names, priors, keyframes, clouds and errors of a live job."""

import re
from dataclasses import replace

import numpy as np
import pytest
import recordings
from counted_time import CountedTime
from recordings import COVARIANCE, PERIOD, START, moved, picture
from ros_messages import camera_info, header, image, message_class
from scipy.spatial import cKDTree
from surfaces import TRUTH, colours_at, height, look

from garps_core import Config
from garps_core.align import estimate_relative_pose
from garps_core.errors import InputError
from garps_core.geometry import se3_inverse
from garps_core.mixtures.reconstruct import reconstruct
from garps_core.types import PoseEstimate, Prior, Status
from garps_ros.estimates.keyframes import KeyframeRule, KeyframeTracker
from garps_ros.estimates.outcomes import Origin, ViewReader, estimate_keyframes, estimate_pair
from garps_ros.frames.frame import CameraTopics, Frame
from garps_ros.live import jobs
from garps_ros.live.jobs import Job, JobRunner
from garps_ros.parameters.settings import NodeSettings
from msg_adapters import PoseWriter

LIBRARIES = ("rclpy", "rosbags")
SETTINGS = NodeSettings()
KEYFRAME = replace(SETTINGS, pairing="keyframe", keyframe_motion=9.0)


def framed(rgb, depth, index, side="source", library="rosbags", frame_id=None, **calibration):
    head = {"stamp_ns": START + index * PERIOD, "frame_id": f"{side}_optical" if frame_id is None else frame_id}
    info = camera_info(library, (rgb.shape[1], rgb.shape[0]), D=[0] * 5, model="plumb_bob", **head, **calibration)
    encoding = "32FC1" if depth.dtype == np.float32 else "16UC1"
    topics = CameraTopics(f"/{side}/image", f"/{side}/camera_info", f"/{side}/depth")
    images = image(rgb, "rgb8", library, **head), image(depth, encoding, library, **head)
    return Frame(topics, head["stamp_ns"], *images, info)


def frame(index, side="source", **more):
    """A small image whose first pixel says which it is."""
    return framed(picture(index), np.full((48, 64), 2000, np.uint16), index, side, **more)


def pair(index=1, **more):
    return frame(index), frame(index, "target", **more)


def seen(view, index, side="source", library="rosbags"):
    return framed(view.rgb, view.depth, index, side, library, K=view.K)


@pytest.fixture
def calls(monkeypatch):
    """Arguments of the calls of an estimator that answers at once."""
    calls = []

    def estimate(*given):
        calls.append(given)
        return with_mixtures(replace(recordings.estimate(*given[:2]), initial=given[3]), *given[:2])

    monkeypatch.setattr(jobs, "Estimator", recordings.answering(estimate))
    return calls


def answering(monkeypatch, estimate):
    """Let the estimator be `estimate(source, target)`."""
    monkeypatch.setattr(jobs, "Estimator", recordings.answering(lambda s, t, *_: with_mixtures(estimate(s, t), s, t)))


def with_mixtures(estimate, *views):
    return estimate, tuple(reconstruct(view) for view in views)


def solve(*frames, settings=SETTINGS, by=None, **more):
    return (by or JobRunner(lambda _: None))(Job(frames, settings, Config(), **more))


def follow(by, indices, settings=KEYFRAME, **more):
    """Outcomes of frames of one camera, one job each."""
    return [o for i in indices for o in solve(frame(i), settings=settings, by=by, **more).outcomes]


def same(a, b):
    """Two outcomes agree bit by bit; only the time that they took may differ."""
    if isinstance(a, Origin):
        return a == b
    arrays = [(a.T, b.T), (a.covariance, b.covariance)]
    arrays += [(a.row.T_target_source, b.row.T_target_source), (a.row.covariance, b.row.covariance)]
    assert all((x is None) == (y is None) and (x is None or x.tobytes() == y.tobytes()) for x, y in arrays)
    words = [replace(o.row, T_target_source=None, covariance=None) for o in (a, b)]
    return vars(words[0]) == vars(words[1]) and (a.frame_id, a.child_frame_id) == (b.frame_id, b.child_frame_id)


@pytest.mark.parametrize("library", LIBRARIES)
def test_a_real_pair_is_estimated_as_offline_bit_by_bit(library):
    pytest.importorskip("embreex")
    rooms = pytest.importorskip("bench.rooms")
    room = rooms.make_pair(1, 2, width=160, height=120)
    source = framed(room.rgb0, room.depth0, 1, "source", library, K=room.K0)
    target = framed(room.rgb1, room.depth1, 1, "target", library, K=room.K1)
    offline = estimate_pair(
        source, target, ViewReader("auto", print), lambda s, t: estimate_relative_pose(s, t, Config())
    )
    result = solve(source, target)
    (live,) = result.outcomes
    assert live.row.status == "converged" and np.abs(live.T - room.T_1_0).max() < 0.02
    assert same(live, offline)
    assert 0 < result.core_s < live.seconds and result.trace == ""
    assert (live.frame_id, live.child_frame_id) == ("target_optical", "source_optical")
    assert (live.row.source_stamp_ns, live.row.target_stamp_ns) == (source.stamp_ns, target.stamp_ns)


def test_one_camera_is_followed_as_offline(monkeypatch):
    def failing(source, target):
        return recordings.estimate(source, target, bad=(6, *range(9, 14)))

    answering(monkeypatch, failing)
    settings = replace(KEYFRAME, keyframe_motion=0.25)
    tracker = KeyframeTracker(failing, KeyframeRule(0.5, 0.25, np.radians(20)))
    offline = list(estimate_keyframes([frame(i) for i in range(1, 20)], ViewReader("auto", print), tracker))
    live = follow(JobRunner(print), range(1, 20), settings)
    assert len(live) == len(offline) > 20 and all(same(a, b) for a, b in zip(live, offline, strict=True))
    assert [o.frame_id for o in live if isinstance(o, Origin)] == ["source_optical_start", "source_optical_start_2"]


def test_estimator_gets_source_target_and_the_jobs_config(calls):
    config = Config().replace({"lifting.stride": 7})
    result = JobRunner(print)(Job(pair(3), SETTINGS, config, began := 4))
    ((source, target, given, prior),) = calls
    assert (source.frame_id, target.frame_id) == ("source_optical", "target_optical")
    assert given is config and prior is None and result.job.epoch == began
    np.testing.assert_allclose(result.outcomes[0].T[0, 3], 0.25)


@pytest.mark.parametrize(
    ("source_frame", "target_frame", "expected"),
    [
        ("", "", ("target_optical", "source_optical")),
        ("arm_cam", "", ("target_optical", "arm_cam")),
        ("", "map", ("map", "source_optical")),
        ("arm_cam", "map", ("map", "arm_cam")),
    ],
)
def test_frame_names_can_be_replaced(calls, source_frame, target_frame, expected):
    settings = replace(SETTINGS, source_frame=source_frame, target_frame=target_frame)
    (outcome,) = solve(*pair(), settings=settings).outcomes
    assert (outcome.frame_id, outcome.child_frame_id) == expected
    assert (outcome.row.target_frame, outcome.row.source_frame) == ("target_optical", "source_optical"), "as it came"


def test_cameras_of_the_same_name_are_told_apart_by_their_topics(calls):
    (outcome,) = solve(*pair(frame_id="source_optical")).outcomes
    assert (outcome.frame_id, outcome.child_frame_id) == ("target_image", "source_image")


def test_every_segment_has_a_frame_of_its_own(monkeypatch):
    answering(monkeypatch, lambda s, t: recordings.estimate(s, t, bad=range(3, 8)))
    settings = replace(KEYFRAME, target_frame="map", source_frame="cam")
    outcomes = follow(JobRunner(print), range(1, 12), settings)
    assert [o.frame_id for o in outcomes if isinstance(o, Origin)] == ["map", "map_2"]
    good = [o for o in outcomes if not isinstance(o, Origin) and o.T is not None]
    assert [o.frame_id for o in good] == ["map"] + ["map_2"] * (len(good) - 1) and len(good) >= 3
    assert {o.child_frame_id for o in outcomes} == {"cam"}


# --- priors -----------------------------------------------------------------------------------------------------------


def given(frame_id, library="rosbags", covariance=COVARIANCE):
    make = PoseWriter(message_class(library))
    posed = make.pose_with_covariance_stamped(moved(0.3), COVARIANCE, START, "any")
    posed.header, posed.pose.covariance = header(library, START, frame_id), np.asarray(covariance, float).ravel()
    return posed


@pytest.mark.parametrize("library", LIBRARIES)
def test_a_prior_is_used_for_its_own_pair_only(calls, library):
    by = JobRunner(print)
    result = solve(*pair(), by=by, prior=given("target_optical", library))
    np.testing.assert_array_equal(calls[0][3].T_target_source, moved(0.3))
    np.testing.assert_allclose(calls[0][3].covariance, COVARIANCE)
    assert result.prior == "used"
    without = solve(*pair(2), by=by)
    assert calls[1][3] is None and without.prior == "none"


def test_a_prior_speaks_of_the_name_that_is_published(calls):
    settings = replace(SETTINGS, target_frame="map")
    assert solve(*pair(), settings=settings, prior=given("map")).prior == "used"
    assert "'map'" in solve(*pair(), settings=settings, prior=given("target_optical")).prior


@pytest.mark.parametrize(
    ("prior", "reason"),
    [
        (lambda: given("source_optical"), "prior is in frame 'source_optical': expected .* 'target_optical'"),
        (lambda: given("target_optical", covariance=np.zeros(36)), "zeros do not mean unknown"),
        (lambda: given("target_optical", covariance=np.full(36, np.nan)), "covariance"),
    ],
)
def test_a_prior_that_cannot_be_used_is_left_out_with_its_reason(calls, prior, reason):
    result = solve(*pair(), prior=prior())
    assert re.search(reason, result.prior) and result.prior.startswith("refused: ")
    assert calls[0][3] is None and result.outcomes[0].T is not None


@pytest.mark.parametrize("frames", [pair(2), (frame(2),)], ids=["pair", "followed"])
@pytest.mark.parametrize("error", [ValueError("odd"), MemoryError("no room"), AssertionError()])
def test_an_unexpected_error_is_an_outcome_with_its_trace_and_the_next_job_works(monkeypatch, frames, error):
    def estimate(source, target):
        if source.stamp_ns == frames[0].stamp_ns:
            raise error
        return recordings.estimate(source, target)

    answering(monkeypatch, estimate)
    by, settings = JobRunner(print), KEYFRAME if len(frames) == 1 else SETTINGS
    others = [pair(1)[: len(frames)], pair(3)[: len(frames)]]
    solve(*others[0], settings=settings, by=by)
    result = solve(*frames, settings=settings, by=by)
    (outcome,) = result.outcomes
    assert (outcome.T, outcome.covariance, outcome.row.status) == (None, None, "core_error")
    assert (
        outcome.row.reason == f"{type(error).__name__}: {error}" and outcome.row.source_stamp_ns == frames[0].stamp_ns
    )
    assert "Traceback" in result.trace and type(error).__name__ in result.trace and by.stage == ""
    after = solve(*others[1], settings=settings, by=by)
    assert after.outcomes[0].T is not None and after.trace == ""
    assert len(frames) == 2 or after.outcomes[0].row.target_stamp_ns == frame(1).stamp_ns, "the keyframe is kept"


def test_what_ends_the_thread_is_not_caught(monkeypatch):
    answering(monkeypatch, lambda *_: (_ for _ in ()).throw(SystemExit(3)))
    by = JobRunner(print)
    with pytest.raises(SystemExit):
        solve(*pair(), by=by)
    assert by.stage == ""


def test_expected_failures_are_outcomes_without_trace(monkeypatch, calls):
    blank = replace(pair()[0], info=camera_info("rosbags", K=np.zeros((3, 3)), frame_id="source_optical"))
    result = solve(blank, pair()[1], clouds=True)
    assert result.outcomes[0].row.status == "malformed_message" and (result.trace, calls) == ("", [])

    def refuse(*_):
        raise InputError("too dark")

    answering(monkeypatch, refuse)
    result = solve(*pair())
    assert (result.outcomes[0].row.status, result.outcomes[0].row.reason) == ("invalid_input", "too dark")
    assert result.trace == "" and result.clouds is None


# --- keyframes and settings -------------------------------------------------------------------------------------------


def targets(outcomes):
    return [round((o.row.target_stamp_ns - START) / PERIOD) for o in outcomes if not isinstance(o, Origin)]


def test_another_epoch_forgets_the_keyframe(calls):
    by = JobRunner(print)
    assert targets(follow(by, (1, 2, 3))) == [1, 1]
    (begins, *rest) = follow(by, (4, 5), epoch=1)
    assert isinstance(begins, Origin) and (begins.segment, begins.stamp_ns) == (2, frame(4).stamp_ns)
    assert begins.frame_id == "source_optical_start_2", "poses of before and after must not share a frame"
    assert targets(rest) == [4]
    assert solve(frame(6), settings=KEYFRAME, by=by, epoch=1).keyframes == 1


def test_the_rule_for_keyframes_can_be_changed_while_running(calls):
    by = JobRunner(print)
    assert targets(follow(by, (1, 2, 3, 4))) == [1, 1, 1]
    near = replace(KEYFRAME, keyframe_motion=0.05)
    assert targets(follow(by, (5, 6, 7), near)) == [1, 5, 6]
    assert targets(follow(by, (8, 9), replace(KEYFRAME, keyframe_overlap=0.95))) == [7, 8]
    assert targets(follow(by, (10, 11))) == [9, 9]
    assert solve(frame(12), settings=KEYFRAME, by=by).keyframes == 6


@pytest.mark.parametrize(("degrees", "expected"), [(11.0, [1, 2]), (12.0, [1, 1])])
def test_rotation_is_in_degrees(monkeypatch, degrees, expected):
    answering(monkeypatch, lambda s, t: PoseEstimate(Status.CONVERGED, "", moved(0, 0.2), COVARIANCE, overlap=0.9))
    assert targets(follow(JobRunner(print), (1, 2, 3), replace(KEYFRAME, keyframe_rotation=degrees))) == expected


def test_settings_of_the_calibration_take_effect_and_are_said(calls):
    lines, P = [], np.hstack([np.diag([80.0, 80, 1]), np.zeros((3, 1))])
    by, frames = JobRunner(lines.append), (frame(1, P=P), frame(1, "target", P=P))
    for rectified, focal in (("auto", 50), ("rectified", 80), ("raw", 50)):
        solve(*frames, by=by, settings=replace(SETTINGS, rectified=rectified))
        assert {view.K[0, 0] for view in calls[-1][:2]} == {focal}, rectified
    assert len(lines) == 6 and lines[0].startswith("/source/image: ") and lines[1].startswith("/target/image: ")
    large = camera_info("rosbags", (128, 96), D=[0] * 5, model="plumb_bob", frame_id="source_optical")
    resized = replace(frames[0], info=large), frames[1]
    assert solve(*resized, by=by).outcomes[0].row.status == "malformed_message"
    assert solve(*resized, by=by, settings=replace(SETTINGS, allow_resized=True)).outcomes[0].T is not None


def test_stage_and_times_are_those_of_the_work(monkeypatch):
    stages, clock = [], CountedTime()
    monkeypatch.setattr(jobs, "time", clock)

    def estimate(source, target):
        stages.append(by.stage)
        clock.sleep(0.125)
        return recordings.estimate(source, target, bad=(3,))

    answering(monkeypatch, estimate)
    cloud = jobs.coloured_points
    monkeypatch.setattr(jobs, "coloured_points", lambda *given: (stages.append(by.stage), cloud(*given))[1])
    by = JobRunner(lambda _: stages.append(by.stage))
    assert by.stage == ""
    result = solve(*pair(), by=by, clouds=True)
    assert result.began_s == clock.now_s - 0.125
    assert stages == ["decode", "decode", "estimate", "clouds", "clouds"] and by.stage == ""
    assert result.core_s == 0.125
    results = [solve(frame(i), settings=KEYFRAME, by=by) for i in (1, 2, 3)]
    assert [len(r.outcomes) for r in results] == [1, 1, 2] and by.stage == ""
    assert [r.core_s for r in results] == [0.0, 0.125, 0.25], "all attempts together"


def off_the_surface(cloud):
    """Median distance along z of points in the world's frame from the wavy surface, m."""
    x, y, z = cloud.points.T.astype(float)
    return np.median(np.abs(z - height(x, y)))


def test_the_source_cloud_lies_on_the_target_cloud(monkeypatch):
    answering(monkeypatch, lambda s, t: PoseEstimate(Status.CONVERGED, "", TRUTH, COVARIANCE, overlap=0.9))
    result = solve(seen(look(TRUTH), 1), seen(look(), 1, "target"), clouds=True)
    source, target = result.clouds
    assert np.median(cKDTree(target.points).query(source.points)[0]) < 0.02
    back = source.points.astype(float) @ TRUTH[:3, :3] - TRUTH[:3, 3] @ TRUTH[:3, :3]
    assert np.median(cKDTree(target.points).query(back)[0]) > 0.05, "as seen by its own camera it does not"
    for cloud in (source, target):
        assert off_the_surface(cloud) < 0.005 and len(cloud.points) > 1000
        assert cloud.points.dtype == np.float32 and cloud.colours.dtype == np.uint8
        assert cloud.colours.shape == cloud.points.shape == (len(cloud.points), 3)
        true = 255 * colours_at(*cloud.points[:, :2].T.astype(float))
        assert np.median(np.abs(cloud.colours - true)) < 6


def test_with_a_keyframe_both_clouds_lie_in_the_frame_of_the_first(monkeypatch):
    poses = {frame(i).stamp_ns: np.linalg.matrix_power(TRUTH, i - 1) for i in (1, 2, 3)}

    def estimate(source, target):
        T = se3_inverse(poses[target.stamp_ns]) @ poses[source.stamp_ns]
        return PoseEstimate(Status.CONVERGED, "", T, COVARIANCE, overlap=0.9)

    answering(monkeypatch, estimate)
    by, settings = JobRunner(print), replace(KEYFRAME, keyframe_motion=0.01)
    results = [solve(seen(look(poses[frame(i).stamp_ns]), i), settings=settings, by=by, clouds=True) for i in (1, 2, 3)]
    assert results[0].clouds is None and targets(results[2].outcomes) == [2]
    for cloud in (*results[1].clouds, *results[2].clouds):
        assert off_the_surface(cloud) < 0.005
    assert not np.array_equal(results[2].clouds[0].points, results[2].clouds[1].points)


def test_clouds_are_made_when_asked_for_and_when_there_is_a_pose(monkeypatch, calls):
    assert solve(*pair()).clouds is None and solve(*pair(), clouds=True).clouds is not None
    cloud = jobs.coloured_points
    monkeypatch.setattr(jobs, "coloured_points", None)  # would be an error that nobody expected
    broken = solve(*pair(), clouds=True)
    assert broken.clouds is None and "TypeError" in broken.trace and broken.outcomes[0].T is not None
    monkeypatch.setattr(jobs, "coloured_points", cloud)
    answering(monkeypatch, lambda *_: PoseEstimate(Status.POOR_FIT, "no", moved(0.1), COVARIANCE))
    bad = solve(*pair(), clouds=True)
    assert (bad.clouds, bad.trace, bad.outcomes[0].row.status) == (None, "", "poor_fit")


def test_clouds_are_of_the_attempt_that_found_a_pose(monkeypatch):
    answering(monkeypatch, lambda s, t: recordings.estimate(s, t, bad=(3,) if recordings.index_of(t) == 1 else ()))
    follow(by := JobRunner(print), (1, 2))
    result = solve(frame(3), settings=KEYFRAME, by=by, clouds=True)
    assert [o.T is None for o in result.outcomes] == [True, False] and result.clouds is not None


@pytest.mark.parametrize("told", ["features contradict it", "mast3r contradicts it", "given_by_marker contradicts it"])
def test_a_prior_that_the_estimate_did_not_start_from_is_not_called_used(monkeypatch, told):
    start = Prior(np.eye(4), COVARIANCE, told.split()[0])
    answering(monkeypatch, lambda *views: replace(recordings.estimate(*views), initial=start))
    assert solve(*pair(), prior=given("target_optical")).prior == f"not used: {told}"


def test_frame_names_that_cannot_be_right_are_warnings(calls):
    assert solve(*pair()).warnings == []
    (warning,) = solve(frame(1), frame(1, "target", frame_id="")).warnings
    assert "frame_id 'source_optical', ''" in warning and "set source_frame and target_frame" in warning
    (warning,) = solve(frame(1), frame(1, "target", frame_id="source_optical")).warnings
    assert "topics name the frames" in warning
    named = {"settings": replace(SETTINGS, source_frame="a", target_frame="b")}
    assert solve(frame(1), frame(1, "target", frame_id=""), **named).warnings == []
    other = camera_info(D=[0] * 5, model="plumb_bob", frame_id="other")
    (warning,) = solve(frame(1), replace(frame(1, "target"), info=other)).warnings
    assert warning.startswith("/target/image: camera_info is of frame 'other'")
