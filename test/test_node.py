# SPDX-License-Identifier: Apache-2.0
"""pose_node as a process on a real graph: what goes in by topic comes out as the pose the offline path finds."""

import re
import time
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest
from graph import SECOND, Camera, NodeProcess, Peer, private_domain, room_pair
from ros_messages import ROS2, image

from garps_core import Config, Prior, Status, estimate_relative_pose
from garps_core.settings import changed_config
from garps_ros.views import view_from_messages
from msg_adapters import PoseWriter, header_stamp_ns, pose_from_message

pytest.importorskip("rclpy")
from geometry_msgs.msg import PoseStamped, PoseWithCovarianceStamped
from nav_msgs.msg import Odometry
from rosgraph_msgs.msg import Clock
from sensor_msgs.msg import PointCloud2
from std_srvs.srv import SetBool, Trigger

from garps_ros.publishing import message_class

NODE = "/pose_node"
EQUAL = 1e-6
"""m, rad and their squares: how close the live pose is to the offline one."""
CHEAP = ["lifting.stride=4", "start.max_features=1000"]


@pytest.fixture(scope="module")
def domain(tmp_path_factory):
    with private_domain(tmp_path_factory.mktemp("ros")) as held:
        yield held


@contextmanager
def running(domain, tmp_path, settings=(), remaps=()):
    """A node with settings like "pairing=keyframe", and a peer; both end in good order."""
    words = [word for setting in [*CHEAP, *settings] for word in ("-p", setting.replace("=", ":=", 1))]
    words += [word for remap in remaps for word in ("-r", remap)]
    with (
        NodeProcess(["--ros-args", *words], domain.environment, tmp_path / "node.log") as node,
        Peer(domain) as peer,
    ):
        yield node, peer


class Rig:
    """Two cameras of a room pair, and the poses that come back."""

    def __init__(self, peer, pair=None, **how):
        self.peer = peer
        self.cameras = [Camera(peer, side, pair or room_pair(), **how) for side in ("source", "target")]
        self.poses = peer.collect(PoseStamped, f"{NODE}/pose")
        self.odometry = peer.collect(Odometry, f"{NODE}/odometry")
        self._stamp_ns = 1_700_000_000 * SECOND

    def ready(self):
        """The node hears every topic, and somebody hears the node."""
        for camera in self.cameras:
            self.peer.matched(*camera.publishers)
        self.peer.wait(lambda: self.peer.node.count_publishers(f"{NODE}/pose"), what="the node's publisher")
        return self

    def send(self, stamp_ns=None):
        """Publish a pair; returns its stamp and the two shots."""
        self._stamp_ns = self._stamp_ns + SECOND // 10 if stamp_ns is None else stamp_ns
        shots = [camera.shot(self._stamp_ns) for camera in self.cameras]
        for camera, shot in zip(self.cameras, shots, strict=True):
            camera.send(shot)
        return self._stamp_ns, shots

    def answers(self, stamp_ns):
        return [message for _, message in self.odometry if header_stamp_ns(message) == stamp_ns]

    def answer(self, seconds=30.0):
        """Send pairs until one is answered; returns its shots, PoseStamped and Odometry.

        The first messages after a match may be lost, as on every graph; that is why pairs are sent again.
        """
        end, sent = time.monotonic() + seconds, {}
        while time.monotonic() < end:
            stamp_ns, shots = self.send()
            sent[stamp_ns] = shots
            again = time.monotonic() + 1.0
            while time.monotonic() < again:
                self.peer.spin(0.02)
                for _, odometry in self.odometry:
                    stamp_ns = header_stamp_ns(odometry)
                    poses = [m for _, m in self.poses if header_stamp_ns(m) == stamp_ns]
                    if stamp_ns in sent and poses:
                        return sent[stamp_ns], poses[0], odometry
        pytest.fail(f"no pose for any pair; diagnostics: {self.peer.diagnostics()}")


def offline(shots, settings=(), prior=None):
    config = changed_config(Config(), [*CHEAP, *settings])
    views = [view_from_messages(shot.image, shot.camera_info, shot.depth)[0] for shot in shots]
    return estimate_relative_pose(*views, config, prior)


def assert_equal(message, estimate):
    T, covariance = pose_from_message(message)
    assert estimate.status is Status.CONVERGED
    np.testing.assert_allclose(T, estimate.T_target_source, atol=EQUAL)
    if covariance is not None:
        np.testing.assert_allclose(covariance, estimate.covariance, atol=EQUAL, rtol=EQUAL)


def values(peer, name):
    return peer.diagnostics().get(f"pose_node: {name}", (0, "", {}))[2]


def count(peer, name, key):
    return int(values(peer, name).get(key, 0))


def finding(peer, name, text):
    """Wait until a status says a text; returns its level."""
    peer.wait(lambda: text in peer.diagnostics().get(f"pose_node: {name}", (0, "", {}))[1], what=f"{name}: {text!r}")
    return peer.diagnostics()[f"pose_node: {name}"][0]


TRANSPORTS = {
    "raw_reliable": ({"depth": "16UC1", "reliable": True}, []),
    "raw_best_effort": ({"depth": "32FC1", "reliable": False}, []),
    "asked_for_reliable": ({"depth": "16UC1", "reliable": True}, ["image_qos=reliable"]),
    "jpeg_and_compressed_depth": (
        {"colour": "jpeg", "depth": "compressedDepth"},
        ["image_transport=compressed", "depth_transport=compressedDepth"],
    ),
    "png_best_effort": (
        {"colour": "png", "depth": "png", "reliable": False},
        ["image_transport=compressed", "depth_transport=compressed"],
    ),
}


@pytest.mark.parametrize("name", TRANSPORTS)
def test_two_cameras_give_the_offline_pose(domain, tmp_path, name):
    how, settings = TRANSPORTS[name]
    with running(domain, tmp_path, settings) as (_, peer):
        rig = Rig(peer, **how).ready()
        shots, pose, odometry = rig.answer()
        estimate = offline(shots)
        assert_equal(pose, estimate)
        assert_equal(odometry, estimate)
        assert pose.header.frame_id == odometry.header.frame_id == "target_optical"
        assert odometry.child_frame_id == "source_optical"
        level = finding(peer, "inputs", "all inputs arrive")
        assert level == 0
        expected = "RELIABLE" if "image_qos=reliable" in settings else "BEST_EFFORT"
        assert expected in values(peer, "inputs")["source/image"]


def test_the_truth_is_found(domain, tmp_path):
    """Equal to the offline pose could be equally wrong."""
    with running(domain, tmp_path) as (_, peer):
        pair = room_pair(3)
        _, _, odometry = Rig(peer, pair).ready().answer()
        T, covariance = pose_from_message(odometry)
        assert np.linalg.norm(T[:3, 3] - pair.T_1_0[:3, 3]) < 0.01
        assert np.abs(T[:3, :3] - pair.T_1_0[:3, :3]).max() < 0.005
        assert (np.linalg.eigvalsh(covariance) > 0).all()


def test_stamps_within_the_slop_pair_and_the_pose_has_the_source_stamp(domain, tmp_path):
    with running(domain, tmp_path, ["sync_slop=0.02"]) as (_, peer):
        rig = Rig(peer).ready()
        rig.answer()
        offset, start = SECOND // 100, 1_800_000_000 * SECOND
        for step in range(4):  # the pair is certain once the next image has come
            stamp_ns = start + step * SECOND // 10
            rig.cameras[0].publish(stamp_ns)
            rig.cameras[1].publish(stamp_ns + offset)
            peer.spin(0.5)
        peer.wait(lambda: rig.answers(start + SECOND // 10), what="a pose with the source's stamp")


def test_a_prior_is_used_where_it_belongs(domain, tmp_path):
    with running(domain, tmp_path) as (_, peer):
        rig = Rig(peer).ready()
        priors = peer.publisher(PoseWithCovarianceStamped, f"{NODE}/prior")
        peer.matched(priors)
        rig.answer()
        T, covariance = room_pair().T_1_0.copy(), np.diag([0.05**2] * 3 + [0.03**2] * 3)
        T[:3, 3] += 0.03
        message = PoseWriter(message_class).pose_with_covariance_stamped(T, covariance, 1, "target_optical")
        message.header.stamp.nanosec = 0  # for all times
        priors.publish(message)
        peer.wait(lambda: rig.answer() and values(peer, "estimates").get("prior") == "used", what="the prior in use")
        shots, pose, _ = rig.answer()
        given = offline(shots, prior=Prior(*pose_from_message(message)))
        assert given.initial.origin == "given"
        assert_equal(pose, given)
        message.header.frame_id = "map"
        priors.publish(message)
        peer.wait(lambda: rig.answer() and "'map'" in values(peer, "estimates").get("prior", ""), what="a refusal")
        shots, pose, _ = rig.answer()
        assert_equal(pose, offline(shots))


def test_a_reset_drops_what_was_being_computed(domain, tmp_path):
    with running(domain, tmp_path) as (_, peer):
        rig = Rig(peer).ready()
        rig.answer()
        assert peer.set_parameter(NODE, "lifting.stride", 1)[0]  # long enough to be in the middle of it
        stamps = []
        for _ in range(5):
            stamps.append(rig.send()[0])
            peer.spin(0.05)
            response = peer.call(Trigger, f"{NODE}/reset", Trigger.Request())
            assert response.success and "anew" in response.message
            answered = len(rig.odometry)
            peer.spin(0.7)
            assert len(rig.odometry) == answered
        peer.wait(lambda: count(peer, "estimates", "dropped: stale: reset or settings changed") >= 4, what="drops")
        assert sum(len(rig.answers(stamp)) for stamp in stamps) <= 1
        rig.answer()


def test_a_changed_parameter_holds_from_the_next_pair_on(domain, tmp_path):
    with running(domain, tmp_path) as (_, peer):
        rig = Rig(peer).ready()
        shots, before, _ = rig.answer()
        stamp_ns, _ = rig.send()
        assert peer.set_parameter(NODE, "lifting.stride", 3) == (True, "")
        peer.spin(1.0)
        assert len(rig.answers(stamp_ns)) <= 1
        shots, pose, _ = rig.answer()
        assert_equal(pose, offline(shots, ["lifting.stride=3"]))
        assert not np.allclose(pose_from_message(pose)[0], pose_from_message(before)[0], atol=EQUAL)
        successful, reason = peer.set_parameter(NODE, "start.method", "guess")
        assert not successful and "expected one of auto, features, identity" in reason
        successful, reason = peer.set_parameter(NODE, "pairing", "keyframe")
        assert not successful
        shots, pose, _ = rig.answer()
        assert_equal(pose, offline(shots, ["lifting.stride=3"]))


def test_disabled_means_silent_and_lazy_means_idle(domain, tmp_path):
    with running(domain, tmp_path) as (_, peer):
        rig = Rig(peer).ready()
        rig.answer()
        assert peer.call(SetBool, f"{NODE}/enable", SetBool.Request(data=False)).success
        answered = len(rig.odometry)
        for _ in range(3):
            rig.send()
            peer.spin(0.3)
        assert len(rig.odometry) == answered
        finding(peer, "estimates", "disabled by ~/enable")
        peer.wait(lambda: count(peer, "estimates", "dropped: disabled by ~/enable") == 3, what="three dropped pairs")
        assert peer.call(SetBool, f"{NODE}/enable", SetBool.Request(data=True)).success
        rig.answer()
        for subscription in list(peer.node.subscriptions):
            if subscription.topic_name != "/diagnostics":
                peer.node.destroy_subscription(subscription)
        finding(peer, "estimates", "nobody subscribes")
        used = count(peer, "estimates", "poses used")
        rig.send()
        peer.wait(lambda: count(peer, "estimates", "dropped: nobody subscribes (lazy)"), what="a pair left alone")
        assert count(peer, "estimates", "poses used") == used


def test_clouds_show_the_alignment_to_whoever_subscribes(domain, tmp_path):
    with running(domain, tmp_path) as (_, peer):
        rig = Rig(peer).ready()
        rig.answer()
        clouds = [peer.collect(PointCloud2, f"{NODE}/{side}_cloud") for side in ("source", "target")]
        peer.wait(lambda: rig.answer() and all(clouds), what="both clouds")
        (_, source), (_, target) = clouds[0][-1], clouds[1][-1]
        assert source.header.frame_id == target.header.frame_id == "target_optical"
        a, b = (np.frombuffer(cloud.data, np.float32).reshape(-1, 4)[:, :3] for cloud in (source, target))
        assert min(len(a), len(b)) > 1000
        gaps = np.array([np.linalg.norm(b - point, axis=1).min() for point in a[::50]])
        assert np.median(gaps) < 0.04  # m; the cloud's own spacing, far less than between the cameras


def test_with_simulated_time_and_a_recording_that_begins_again(domain, tmp_path):
    with running(domain, tmp_path, ["use_sim_time=true"]) as (node, peer):
        rig = Rig(peer).ready()
        clock = peer.publisher(Clock, "/clock")
        peer.matched(clock)
        assert finding(peer, "inputs", "nothing has come on /clock") == 2
        start = 1_000 * SECOND

        def play(seconds):
            tick = Clock()
            tick.clock.sec, tick.clock.nanosec = divmod(start + round(seconds * SECOND), SECOND)
            clock.publish(tick)
            rig.send(start + round(seconds * SECOND))
            peer.spin(0.4)

        for step in range(6):
            play(step)
        peer.wait(lambda: rig.answers(start + 5 * SECOND), what="a pose while the clock runs")
        assert "anew" not in node.log()
        rig.odometry.clear()
        for step in range(4):
            play(step + 0.5)
        peer.wait(lambda: rig.answers(start + round(3.5 * SECOND)), what="a pose after the jump back")
        assert re.search(r"(went back|time went back) by .*beginning anew", node.log())
        peer.wait(lambda: "went back" in values(peer, "estimates")["began anew"], what="the restart in the diagnostics")


def test_wrong_qos_and_wrong_type_are_named(domain, tmp_path):
    with running(domain, tmp_path, ["image_qos=reliable"]) as (node, peer):
        Rig(peer, reliable=False)
        assert finding(peer, "inputs", "peer offers BEST_EFFORT, image_qos asks for RELIABLE") == 2
        text = "offers less RELIABILITY than image_qos:=reliable asks"
        peer.wait(lambda: text in node.log(), what="the event's line in the log")
    with running(domain, tmp_path) as (_, peer):
        peer.publisher(PointCloud2, "source/image")
        peer.publisher(PointCloud2, "source/depth")
        assert (
            finding(peer, "inputs", "peer publishes sensor_msgs/msg/PointCloud2, expected sensor_msgs/msg/Image") == 2
        )


@pytest.mark.parametrize("offered", ["RELIABLE", "BEST_EFFORT"])
def test_images_that_get_lost_are_asked_for_reliably_where_that_is_offered(domain, tmp_path, offered):
    from sensor_msgs.msg import Image

    with running(domain, tmp_path) as (_, peer):
        images = peer.publisher(Image, "source/image", reliable=offered == "RELIABLE")
        peer.matched(images)
        kept = [step for step in range(120) if np.random.default_rng(step).random() < 0.4]
        for step in kept:
            stamp_ns = 1_700_000_000 * SECOND + step * SECOND // 30
            images.publish(image(np.zeros((8, 8, 3), np.uint8), "rgb8", "rclpy", stamp_ns=stamp_ns))
            peer.spin(0.03)
        peer.wait(lambda: offered in values(peer, "inputs").get("source/image", ""), what=offered)
        peer.spin(1.2)
        assert offered in values(peer, "inputs")["source/image"]


def test_missing_inputs_are_named(domain, tmp_path):
    with running(domain, tmp_path, ["input_timeout=1.0"], ["source/depth:=/front/depth"]) as (_, peer):
        rig = Rig(peer)
        for camera in rig.cameras:
            peer.matched(camera.image)
        for _ in range(15):
            rig.send()
            peer.spin(0.1)
        assert finding(peer, "inputs", "nothing received yet: source/depth (/front/depth, 0 publisher(s))") == 2
        finding(peer, "inputs", "silent: ")


def test_images_that_never_belong_together_are_explained(domain, tmp_path):
    with running(domain, tmp_path, ["input_timeout=0.5"]) as (_, peer):
        rig = Rig(peer).ready()
        start = 1_700_000_000 * SECOND
        for step in range(40):
            rig.cameras[0].publish(start + step * SECOND // 10)
            rig.cameras[1].publish(start + step * SECOND // 10 + SECOND // 20)
            peer.spin(0.1)
        text = "none belong together within sync_slop = 0.02 s"
        assert any(text in message for _, message, _ in peer.diagnostics().values()), peer.diagnostics()


RECORDING = Path(__file__).resolve().parents[2] / "shared" / "data" / "bags" / "hololens_rgbd"


@pytest.mark.skipif(not RECORDING.is_dir(), reason=f"needs the recording {RECORDING}, not committed")
def test_one_camera_is_followed_as_offline(domain, tmp_path):
    from rosbags.highlevel import AnyReader
    from sensor_msgs.msg import CameraInfo, Image

    from garps_ros import replay

    topics = {"image": "/camera/color/image_raw", "camera_info": "/camera/color/camera_info"}
    topics["depth"] = "/camera/aligned_depth/image_raw"
    assert replay.main([str(RECORDING), "--out", str(tmp_path / "out"), *(w for s in CHEAP for w in ("--set", s))]) == 0
    with AnyReader([tmp_path / "out" / "poses"], default_typestore=ROS2) as reader:
        expected = [reader.deserialize(raw, c.msgtype) for c, _, raw in reader.messages() if "odom" in c.topic]
    remaps = [f"source/{part}:={topic}" for part, topic in topics.items()]
    with running(domain, tmp_path, ["pairing=keyframe"], remaps) as (node, peer):
        found = peer.collect(Odometry, f"{NODE}/odometry")
        publishers = {t: peer.publisher(CameraInfo if "info" in t else Image, t) for t in topics.values()}
        peer.matched(*publishers.values())
        peer.wait(lambda: peer.node.count_publishers(f"{NODE}/odometry"), what="the node's publisher")
        peer.spin(1.0)  # until the node has subscribed as reliable: the first frame is the origin
        with AnyReader([RECORDING], default_typestore=ROS2) as reader:
            connections = [c for c in reader.connections if c.topic in publishers]
            frames = {}
            for connection, _, raw in reader.messages(connections=connections):
                stamp_ns = header_stamp_ns(reader.deserialize(raw, connection.msgtype))
                frames.setdefault(stamp_ns, {})[connection.topic] = bytes(raw)
        stamps = [header_stamp_ns(message) for message in expected]
        for stamp_ns, messages in sorted(frames.items()):
            for topic in topics.values():
                publishers[topic].publish(messages[topic])
            if stamp_ns in stamps:
                peer.wait(lambda n=stamp_ns: any(header_stamp_ns(m) == n for _, m in found), what=f"pose at {stamp_ns}")
            else:
                peer.spin(1.5)
        assert "camera_color_optical_frame_start begins" in node.log()
    assert len(found) == len(expected) == 11
    for (_, live), recorded in zip(found, expected, strict=True):
        for a, b in zip(pose_from_message(live), pose_from_message(recorded), strict=True):
            np.testing.assert_allclose(a, b, atol=EQUAL)
        assert live.header.frame_id == recorded.header.frame_id and live.child_frame_id == recorded.child_frame_id
