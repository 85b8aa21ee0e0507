# SPDX-License-Identifier: Apache-2.0
"""The parts of the replay by themselves: pairing by stamp, choice of topics, keyframes, views."""

from dataclasses import replace
from functools import partial
from types import SimpleNamespace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from recordings import COVARIANCE, answering, estimate, frames, moved, picture, write
from ros_messages import LIBRARIES, camera_info, image
from scipy.spatial.transform import Rotation

from garps_core.errors import InputError, ReconstructionError
from garps_core.geometry import se3_inverse
from garps_core.types import View
from garps_ros import replay
from garps_ros.estimates.keyframes import KeyframeRule, KeyframeTracker, composed_covariance
from garps_ros.frames.frame import CameraTopics, frame_warning, view_from_messages
from garps_ros.frames.stamps import MAX_WAITING, Pairer
from garps_ros.recording.bags import BagError
from garps_ros.recording.topics import choose_cameras
from msg_adapters import MessageError


def paired(slop, left, right):
    """Pairs of stamps when both streams are recorded in order of their stamps."""
    pairer = Pairer(slop)
    found = []
    for stamp, stream in sorted([(t, 0) for t in left] + [(t, 1) for t in right]):
        found += pairer.add(stream, stamp, stamp)
    return found + pairer.finish(), pairer


@pytest.mark.parametrize(
    ("left", "right", "expected"),
    [
        ([10, 20, 30], [10, 20, 30], [(10, 10), (20, 20), (30, 30)]),
        ([10, 20, 30], [12, 21, 33], [(10, 12), (20, 21), (30, 33)]),
        ([10, 20, 30], [7, 18, 26], [(10, 7), (20, 18), (30, 26)]),
        ([10, 11], [11], [(11, 11)]),  # exact before nearest
        ([10, 13], [12], [(13, 12)]),  # nearest before first
        ([10], [9, 11], [(10, 9)]),  # at equal distance the earlier one
        ([10, 20], [16], [(20, 16)]),
        ([10], [16], []),  # beyond the slop
        ([10, 12, 14, 16], [13], [(12, 13)]),
        ([], [1, 2], []),
    ],
)
def test_pairs_of_two_streams(left, right, expected):
    assert paired(5, left, right)[0] == expected


STAMPS = st.lists(st.integers(0, 400), unique=True, max_size=40).map(sorted)


@given(STAMPS, STAMPS, st.integers(0, 30))
def test_pairing_is_within_the_slop_once_each_and_never_misses_an_exact_one(left, right, slop):
    pairs, pairer = paired(slop, left, right)
    assert all(abs(a - b) <= slop for a, b in pairs)
    assert len({a for a, _ in pairs}) == len({b for _, b in pairs}) == len(pairs)
    assert pairs == sorted(pairs) and [b for _, b in pairs] == sorted(b for _, b in pairs)
    assert {(t, t) for t in set(left) & set(right)} <= set(pairs)
    assert sum(pairer.unpaired) == len(left) + len(right) - 2 * len(pairs)


@given(STAMPS, STAMPS, st.integers(0, 30))
def test_the_order_of_arrival_between_streams_does_not_matter(left, right, slop):
    pairer = Pairer(slop)
    found = [pair for t in left for pair in pairer.add(0, t, t)]
    found += [pair for t in right for pair in pairer.add(1, t, t)]
    assert found + pairer.finish() == paired(slop, left, right)[0]


def test_mutual_nearest_neighbours_are_paired():
    rng = np.random.default_rng(0)
    for _ in range(50):
        left, right = (sorted(rng.choice(1000, 20, replace=False).tolist()) for _ in range(2))
        pairs = set(paired(15, left, right)[0])
        for a in left:
            nearest = sorted(right, key=lambda b: abs(a - b))
            back = sorted(left, key=lambda x: abs(x - nearest[0]))
            unique = abs(a - nearest[0]) < abs(a - nearest[1]) and abs(back[0] - nearest[0]) < abs(back[1] - nearest[0])
            if unique and back[0] == a and abs(a - nearest[0]) <= 15:
                assert (a, nearest[0]) in pairs


def test_stamps_that_do_not_grow_are_refused():
    pairer = Pairer(5)
    assert pairer.add(0, 10, "a") == []
    assert pairer.add(0, 10, "b") is None and pairer.add(0, 9, "c") is None
    assert pairer.add(1, 10, "d") == [("a", "d")]


def test_a_stream_without_partner_does_not_fill_the_memory():
    pairer = Pairer(5)
    for stamp in range(1000):
        pairer.add(0, stamp, bytes(10))
    assert pairer.unpaired[0] == 1000 - MAX_WAITING and len(pairer._waiting[0]) == MAX_WAITING


def layout(**topics):
    """A stand-in for a recording: topic -> what its first message says ("info" = CameraInfo, "points" = neither)."""
    kinds = {"info": "sensor_msgs/msg/CameraInfo", "points": "sensor_msgs/msg/PointCloud2"}
    types, first = {}, {}
    for topic, told in topics.items():
        compressed = "compressed" in topic
        types[topic] = kinds.get(told, f"sensor_msgs/msg/{'CompressedImage' if compressed else 'Image'}")
        first[topic] = SimpleNamespace(**{"format" if compressed else "encoding": told})
    return SimpleNamespace(types=types, counts=dict.fromkeys(types, 1), first=first.get, listing=lambda: str(types))


REALSENSE = {
    "/camera/color/image_raw": "rgb8",
    "/camera/color/image_raw/compressed": "rgb8; jpeg compressed bgr8",
    "/camera/color/camera_info": "info",
    "/camera/depth/image_rect_raw": "16UC1",
    "/camera/depth/camera_info": "info",
    "/camera/aligned_depth_to_color/image_raw": "16UC1",
    "/camera/aligned_depth_to_color/image_raw/compressedDepth": "16UC1; compressedDepth png",
    "/camera/aligned_depth_to_color/camera_info": "info",
    "/camera/depth/points": "points",
}
KINECT = {
    "/rgb/image_raw": "bgra8",
    "/rgb/camera_info": "info",
    "/depth/image_raw": "16UC1",
    "/depth/camera_info": "info",
    "/depth_to_rgb/image_raw": "16UC1",
    "/depth_to_rgb/camera_info": "info",
}
OPENNI = {
    "/camera/rgb/image_rect_color": "rgb8",
    "/camera/rgb/image_raw": "bayer_grbg8",
    "/camera/rgb/camera_info": "info",
    "/camera/depth_registered/image": "32FC1",
}
TWO = {f"/{side}{topic}": told for side in ("front", "rear") for topic, told in REALSENSE.items()}
COMPRESSED = {
    "/cam/image_raw/compressed": "jpeg",
    "/cam/camera_info": "info",
    "/cam/depth/image_raw/compressedDepth": "16UC1; compressedDepth png",
}
GUESSES = {
    "realsense": (
        REALSENSE,
        ["/camera/color/image_raw /camera/color/camera_info /camera/aligned_depth_to_color/image_raw"],
    ),
    "kinect": (KINECT, ["/rgb/image_raw /rgb/camera_info /depth_to_rgb/image_raw"]),
    "openni": (
        OPENNI,
        ["/camera/rgb/image_rect_color /camera/rgb/camera_info /camera/depth_registered/image"],
    ),
    "compressed": (COMPRESSED, ["/cam/image_raw/compressed /cam/camera_info /cam/depth/image_raw/compressedDepth"]),
    "mono16 depth": (
        {"/c/image": "mono8", "/c/camera_info": "info", "/c/depth": "mono16"},
        ["/c/image /c/camera_info /c/depth"],
    ),
    "two": (
        TWO,
        [
            f"/{side}/camera/color/image_raw /{side}/camera/color/camera_info"
            f" /{side}/camera/aligned_depth_to_color/image_raw"
            for side in ("rear", "front")
        ],
    ),
}


@pytest.mark.parametrize("name", GUESSES)
def test_topics_are_guessed_from_the_usual_layouts(name):
    topics, expected = GUESSES[name]
    for order in (list(topics), sorted(topics), sorted(topics, reverse=True)):
        bag = layout(**{topic: topics[topic] for topic in order})
        cameras = choose_cameras(bag, CameraTopics(), CameraTopics(), "auto")
        assert [f"{c.image} {c.info} {c.depth}" for c in cameras] == expected


def test_what_is_asked_for_is_kept_and_the_rest_is_guessed():
    asked = CameraTopics(image="/rear/camera/color/image_raw")
    rear = choose_cameras(layout(**TWO), asked, CameraTopics(), "auto")
    assert [c.depth for c in rear] == ["/rear/camera/aligned_depth_to_color/image_raw"]
    both = choose_cameras(layout(**TWO), CameraTopics(), asked, "auto")
    assert [c.image for c in both] == ["/front/camera/color/image_raw", asked.image]
    other = CameraTopics(depth="/camera/depth/image_rect_raw", info="/camera/depth/camera_info")
    (camera,) = choose_cameras(layout(**REALSENSE), other, CameraTopics(), "keyframe")
    assert (camera.image, camera.info, camera.depth) == ("/camera/color/image_raw", other.info, other.depth)


def test_a_stereo_pair_with_one_depth_is_one_camera_with_depth():
    topics = {"/l/image": "mono8", "/l/camera_info": "info", "/r/image": "mono8", "/r/camera_info": "info"}
    with pytest.raises(BagError, match="no depth found"):
        choose_cameras(layout(**topics), CameraTopics(), CameraTopics(), "auto")
    topics["/l/depth"] = "16UC1"
    (camera,) = choose_cameras(layout(**topics), CameraTopics(), CameraTopics(), "auto")
    assert camera.image == "/l/image"


def view(index, share=1.0):
    """A view with depth in a share of its pixels."""
    depth = np.full((48, 64), np.nan, np.float32)
    depth.flat[: round(share * depth.size)] = 2
    return View(rgb=picture(index), K=np.array([[50.0, 0, 32], [0, 50, 24], [0, 0, 1]]), depth=depth, stamp_ns=index)


def followed(tracker, views):
    """Return one word per view: "begins", "pose", "none" or the error."""
    said = []
    for each in views:
        try:
            said.append("begins" if tracker.begins(each) else ["none", "pose"][_located(tracker.follow(each))])
        except ReconstructionError as error:
            said.append(str(error))
    return said


def _located(attempts):
    return any(attempt.T_start_source is not None for attempt in attempts)


def test_small_overlap_and_rotation_also_take_a_keyframe():
    for rule, answer in (
        (KeyframeRule(min_overlap=0.95, max_motion_m=9), estimate),
        (KeyframeRule(max_motion_m=9, max_rotation_rad=0.1), lambda s, t: turned(s, t)),
    ):
        tracker = KeyframeTracker(answer, rule)
        assert tracker.begins(view(1)) and not tracker.begins(view(2))
        targets = [attempt.target.stamp_ns for index in (2, 3) for attempt in tracker.follow(view(index))]
        assert targets == [1, 2] and tracker.keyframes == 3


@pytest.mark.parametrize("blank", [0.0, 0.0199, None])
def test_only_a_view_with_depth_begins_a_trajectory(blank):
    tracker = KeyframeTracker(estimate, KeyframeRule())
    covered = view(1, blank or 0) if blank is not None else replace(view(1), depth=None)
    refused, *rest = followed(tracker, [covered, view(2, 0.021), view(3)])
    told = f"{100 * (blank or 0):.1f}%"
    assert (
        refused.startswith(f"the view has depth at {told} of its pixels: expected at least 2%") and "topic" in refused
    )
    assert rest == ["begins", "pose"] and tracker.segment == 1


def test_a_hand_over_the_lens_does_not_end_the_trajectory():
    """A cover may last for any time, also where it made usable views fail before."""
    bad = {*range(3, 6), *range(10, 40)}
    tracker = KeyframeTracker(lambda s, t: estimate(s, t, bad=bad), KeyframeRule(max_motion_m=99, lost_after=3))
    hand = {4, *range(12, 40)}
    said = followed(tracker, [view(index, 0.0 if index in hand else 1.0) for index in range(1, 45)])
    assert said.count("begins") == 1 and said[0] == "begins" and set(said[39:]) == {"pose"}
    assert tracker.segment == tracker.keyframes == 1


@pytest.mark.parametrize("lost_after", [1, 3, 5])
def test_a_trajectory_begins_after_as_many_usable_views_as_asked_for(lost_after):
    for failing, expected in ((lost_after - 1, "pose"), (lost_after, "begins")):
        bad = range(2, 2 + failing)
        rule = KeyframeRule(0, 99, 9, lost_after)
        tracker = KeyframeTracker(lambda s, t, bad=bad: estimate(s, t, bad=bad), rule)
        said = followed(tracker, map(view, range(1, 3 + failing)))
        assert said == ["begins", *["none"] * failing, expected]


@pytest.mark.parametrize(("lost_after", "segments"), [(2, 2), (3, 1)])
def test_the_replay_is_told_after_how_many(tmp_path, monkeypatch, lost_after, segments):
    monkeypatch.setattr(replay, "Estimator", answering(partial(estimate, bad=(3, 4))))
    bag, out = write(tmp_path, "mcap", frames(["/cam"], 6, "rosbags")), tmp_path / "out"
    assert replay.main([str(bag), "--out", str(out), "--keyframe-lost-after", str(lost_after)]) == 0
    assert len(list(out.glob("trajectory*.tum"))) == segments


def test_a_keyframe_in_view_again_after_a_blank_view_goes_before_a_new_trajectory():
    for bad, last in (((2, 3), "pose"), ((2, 3, 5, 7), "begins")):
        tracker = KeyframeTracker(lambda s, t, bad=bad: estimate(s, t, bad=(4, 6, *bad)), KeyframeRule(0, 99, 9, 2))
        said = followed(tracker, [view(1), view(2), view(3), view(4, 0), view(5), view(6, 0), view(7)])
        assert said[:4] == ["begins", "none", "none", "none"] and said[-1] == last, "one more try, not for ever"


def test_segments_go_on_from_an_earlier_tracker():
    tracker = KeyframeTracker(estimate, KeyframeRule(), segment=4)
    assert tracker.segment == 4 and tracker.begins(view(1)) and tracker.segment == 5


def turned(source, target):
    found = estimate(source, target)
    return type(found)(found.status, "", moved(0.0, 0.2), COVARIANCE, overlap=0.9)


def test_a_failure_is_tried_again_against_the_last_good_view():
    def near_only(source, target):
        bad = () if abs(source.stamp_ns - target.stamp_ns) <= 2 else (int(source.rgb[0, 0, 0]),)
        return estimate(source, target, bad=bad)

    tracker = KeyframeTracker(near_only, KeyframeRule(max_motion_m=9))
    tracker.begins(view(1))
    attempts = [attempt for index in (2, 3, 4) for attempt in tracker.follow(view(index))]
    assert [a.target.stamp_ns for a in attempts] == [1, 1, 1, 3]
    assert [a.T_start_source is None for a in attempts] == [False, False, True, False]
    np.testing.assert_allclose(attempts[-1].T_start_source[0, 3], 0.3)
    assert tracker.keyframe_stamp_ns == 3


def perturbed(T, noise):
    """The ROS meaning: position moves by noise[:3], the axes turn about the fixed axes by noise[3:]."""
    out = T.copy()
    out[:3, 3] += noise[:3]
    out[:3, :3] = Rotation.from_rotvec(noise[3:]).as_matrix() @ T[:3, :3]
    return out


def test_composed_covariance_is_that_of_many_composed_motions():
    rng = np.random.default_rng(5)
    T_ab, T_bc = np.eye(4), np.eye(4)
    T_ab[:3, :3], T_ab[:3, 3] = Rotation.from_rotvec([0.4, -0.7, 0.2]).as_matrix(), (1, -2, 5)
    T_bc[:3, :3], T_bc[:3, 3] = Rotation.from_rotvec([-0.3, 0.1, 0.9]).as_matrix(), (0.5, 3, -1)
    A, B = (1e-3 * rng.normal(size=(6, 6)) for _ in range(2))
    true = T_ab @ T_bc
    samples = []
    for a, b in zip(rng.normal(size=(4000, 6)), rng.normal(size=(4000, 6)), strict=True):
        T = perturbed(T_ab, A @ a) @ perturbed(T_bc, B @ b)
        turn = Rotation.from_matrix(T[:3, :3] @ se3_inverse(true)[:3, :3]).as_rotvec()
        samples.append(np.concatenate([T[:3, 3] - true[:3, 3], turn]))
    measured = np.cov(np.array(samples).T)
    C = composed_covariance(T_ab, A @ A.T, T_bc, B @ B.T)
    whiten = np.linalg.inv(np.linalg.cholesky(C))
    np.testing.assert_allclose(whiten @ measured @ whiten.T, np.eye(6), atol=0.12)
    exact = composed_covariance(T_ab, None, T_bc, B @ B.T)
    assert np.linalg.eigvalsh(C - exact).min() > 0


@pytest.mark.parametrize("library", LIBRARIES)
def test_messages_become_a_view(library):
    pixels, depth = picture(3), np.full((48, 64), 1500, np.uint16)
    head = {"stamp_ns": 12_000_000_034, "frame_id": "left"}
    made, decision = view_from_messages(
        image(pixels, "rgb8", library, **head),
        camera_info(library),
        image(depth, "16UC1", library, **head),
        topic="/left/image_raw",
    )
    np.testing.assert_array_equal(made.rgb, pixels)
    assert (made.depth == np.float32(1.5)).all() and made.depth.dtype == np.float32
    assert (made.stamp_ns, made.frame_id, made.K[0, 0]) == (12_000_000_034, "left", 50)
    assert decision.startswith("raw image (topic /left/image_raw)") and "registered" not in decision


def test_a_view_is_undistorted_together_with_its_depth():
    info = camera_info(D=(0.5, 0, 0, 0, 0), model="plumb_bob")
    made, _ = view_from_messages(image(picture(3) | 1, "rgb8"), info, image(np.ones((48, 64), np.float32), "32FC1"))
    assert np.isnan(made.depth[0, 0]) and made.depth[24, 32] == 1 and (made.rgb[0, 0] == 0).all()


def test_a_view_without_depth_has_none_and_foreign_depth_or_calibration_is_a_warning():
    rgb, depth = image(picture(3), "rgb8"), image(np.full((48, 64), 900, np.uint16), "16UC1", frame_id="ir")
    assert view_from_messages(rgb, camera_info())[0].depth is None
    assert frame_warning(rgb, camera_info()) == ""
    assert "depth is of frame 'ir', the image of 'cam'" in frame_warning(rgb, camera_info(), depth)
    assert "camera_info is of frame 'other'" in frame_warning(rgb, camera_info(frame_id="other"))


@pytest.mark.parametrize(
    ("messages", "error", "expected"),
    [
        ((image(picture(1), "rgb8"), camera_info(size=(32, 24))), MessageError, "image is 64x48 but camera_info"),
        (
            (image(picture(1), "rgb8"), camera_info(), image(np.ones((24, 32), np.uint16), "16UC1")),
            MessageError,
            "depth is 32x24: expected 64x48",
        ),
        ((image(picture(1), "rgb8", stamp_ns=0), camera_info()), MessageError, "header.stamp is zero"),
        (
            (image(picture(1), "rgb8"), camera_info(), image(np.full((48, 64), 1500, np.float32), "32FC1")),
            InputError,
            "looks like millimetres",
        ),
        (
            (image(picture(1), "rgb8"), camera_info(), image(np.full((48, 64), -1, np.float32), "32FC1")),
            InputError,
            "negative",
        ),
    ],
)
def test_what_is_no_view_is_refused(messages, error, expected):
    with pytest.raises(error, match=expected):
        view_from_messages(*messages)
