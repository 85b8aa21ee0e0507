# SPDX-License-Identifier: Apache-2.0
"""The parts of `make demo`: depth of both cameras, the bag they are written to, and the node it is played into."""

import sys
from pathlib import Path

import cv2
import numpy as np
import pytest
from rosbags.highlevel import AnyReader

from bench.demo import __main__ as demo
from bench.demo.bag import stamp_ns_of, write_bag
from bench.pairs.stereo import StereoPair, depth_of_both
from msg_adapters import depth_image, rgb_image

K = np.array([[300.0, 0, 159.5], [0, 300.0, 119.5], [0, 0, 1]])
BASELINE_M = 0.1


def fronto_parallel(disparity: int) -> StereoPair:
    """A wall of random blobs at f B / disparity."""
    rng = np.random.default_rng(0)
    noise = cv2.GaussianBlur(rng.uniform(0, 255, (240, 400, 3)).astype(np.float32), (0, 0), 1.5)
    wall = cv2.normalize(noise, np.empty_like(noise), 0, 255, cv2.NORM_MINMAX).astype(np.uint8)
    left, right = wall[:, 40:360], wall[:, 40 + disparity : 360 + disparity]
    return StereoPair("wall", np.ascontiguousarray(left), np.ascontiguousarray(right), K, BASELINE_M)


def test_both_cameras_see_the_wall_where_it_is() -> None:
    pair = fronto_parallel(12)
    for depth in depth_of_both(pair):
        assert np.isfinite(depth).mean() > 0.8
        np.testing.assert_allclose(np.nanmedian(depth), 300 * BASELINE_M / 12, rtol=0.01)
    left, right = depth_of_both(pair)
    assert np.isnan(left[:, :11]).all(), "what only the left camera sees has no depth"
    assert np.isnan(right[:, -11:]).all(), "what only the right camera sees has no depth"


def test_the_bag_holds_what_was_put_in(tmp_path: Path) -> None:
    pair = fronto_parallel(12)
    left, right = depth_of_both(pair)
    write_bag(tmp_path / "bag", [(pair, left, right), (pair, left, right)])
    with AnyReader([tmp_path / "bag"]) as bag:
        found = [(c.topic, stamp, bag.deserialize(raw, c.msgtype)) for c, stamp, raw in bag.messages()]
    assert len(found) == 12
    assert {stamp for _, stamp, _ in found} == {stamp_ns_of(0), stamp_ns_of(1)}
    messages = {topic: message for topic, _, message in found}
    np.testing.assert_array_equal(rgb_image(messages["/right/image_rect"]), pair.right)
    np.testing.assert_array_equal(depth_image(messages["/left/depth"]), left)
    info = messages["/right/camera_info"]
    np.testing.assert_allclose(info.k.reshape(3, 3), K)
    assert info.p[3] == -300 * BASELINE_M
    assert messages["/left/camera_info"].header.frame_id == "left_optical"


def test_the_node_finds_the_baseline_live_and_ends_well(tmp_path: Path) -> None:
    pytest.importorskip("rclpy")
    from bench.demo.live import run_live

    pair = fronto_parallel(12)
    depths = depth_of_both(pair)
    write_bag(tmp_path / "bag", [(pair, *depths)] * 4)
    poses, code = run_live(tmp_path / "bag", tmp_path / "live.log")
    log = (tmp_path / "live.log").read_text(encoding="utf-8")
    assert code == 0 and "Traceback" not in log, log
    assert poses and set(poses) <= {stamp_ns_of(index) for index in range(4)}, log
    for pose in poses.values():
        np.testing.assert_allclose(pose.T, pair.T_right_left, atol=0.01)
        assert not pose.latency_s <= 0  # NaN where the listener joined after the first message of the pair
    assert np.nanmedian([pose.latency_s for pose in poses.values()]) < 10


def test_a_machine_without_ros_leaves_the_live_part_out(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.delitem(sys.modules, "bench.demo.live", raising=False)
    for name in ("rclpy", "geometry_msgs.msg"):
        monkeypatch.setitem(sys.modules, name, None)
    assert demo.live_part(tmp_path, 12)
    shown = capsys.readouterr().out
    assert "skipped:" in shown and "ROS 2 is not installed" in shown
