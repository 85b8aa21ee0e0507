# SPDX-License-Identifier: Apache-2.0
"""garps-replay on real recordings, which are not part of the repository."""

import csv

import numpy as np
import places
import pytest
import recordings
from rosbags.highlevel import AnyReader

from garps_core.geometry import se3_inverse, so3_log
from garps_ros import replay
from msg_adapters import pose_from_message, stamp_to_ns

DATA = places.DATA / "bags"
RGBD, ROS1 = DATA / "hololens_rgbd", DATA / "ubiquity_aruco_images.bag"
pytestmark = pytest.mark.skipif(not DATA.is_dir(), reason=f"needs the recordings in {DATA.parent}, not committed")


def rows(out):
    with (out / "poses.csv").open(encoding="utf-8") as file:
        return list(csv.DictReader(file))


def ground_truth():
    """Camera in the world by stamp, from the recording itself."""
    with AnyReader([RGBD]) as reader:
        wanted = [c for c in reader.connections if c.topic == "/camera/ground_truth_pose"]
        messages = [reader.deserialize(raw, c.msgtype) for c, _, raw in reader.messages(connections=wanted)]
    return {stamp_to_ns(message.header.stamp): pose_from_message(message)[0] for message in messages}


def test_poses_of_an_rgbd_camera_are_those_of_its_ground_truth(tmp_path):
    """The whole chain with the real estimator; also fixes which way the transform goes."""
    code = replay.main([str(RGBD), "--out", str(tmp_path / "out"), "--limit", "3", "--set", "lifting.stride=4"])
    used = [row for row in rows(tmp_path / "out") if row["status"] == "converged"]
    assert code == 0 and used
    truth = ground_truth()
    with AnyReader([tmp_path / "out" / "poses"]) as reader:
        messages = [reader.deserialize(raw, c.msgtype) for c, _, raw in reader.messages() if "odom" in c.topic]
    assert len(messages) == len(used)
    for message in messages:
        T, _ = pose_from_message(message)
        expected = se3_inverse(truth[min(truth)]) @ truth[stamp_to_ns(message.header.stamp)]
        error = se3_inverse(expected) @ T
        assert np.linalg.norm(expected[:3, 3]) > 0.1  # m; the other direction would be wrong by more than is allowed
        assert np.linalg.norm(error[:3, 3]) < 0.03 and np.linalg.norm(so3_log(error[:3, :3])) < np.radians(1)


def test_every_frame_of_an_rgbd_camera_is_read(tmp_path, monkeypatch):
    monkeypatch.setattr(replay, "Estimator", recordings.answering(recordings.estimate))
    assert replay.main([str(RGBD), "--out", str(tmp_path / "out")]) == 0
    found = rows(tmp_path / "out")
    assert len(found) == 11 and {row["status"] for row in found} == {"converged"}
    assert {row["source_frame"] for row in found} == {"camera_color_optical_frame"}


def test_a_ros1_camera_without_depth_is_refused(tmp_path, capfd):
    assert replay.main([str(ROS1), "--out", str(tmp_path / "out")]) == 2
    assert "no depth found for /raspicam_node/image/compressed" in capfd.readouterr().err
