# SPDX-License-Identifier: Apache-2.0
"""Transforms leave the tree whole: no second parent, no loop; without tf2_msgs the node writes one line and works.

tf2_msgs is part of ROS but of no package index, and a message class needs its compiled support. So its TFMessage and
the topics that carry it are stand-ins of the same shape here; the transforms in it are real ones.
"""

import sys
import time
from dataclasses import dataclass, field
from functools import partial
from types import ModuleType, SimpleNamespace

import numpy as np
import pytest

pytest.importorskip("rclpy", reason="needs ROS 2")

import rclpy
import recordings
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy
from recordings import START, camera, moved
from ros_messages import rclpy_class

from garps_ros.live import jobs
from garps_ros.live.intake import DEPTH, IMAGE
from garps_ros.live.log import Log
from garps_ros.live.node import PoseNode
from garps_ros.live.transforms import RECENT, Transforms
from msg_adapters import MessageError, PoseWriter


@dataclass
class TFMessage:
    """Shape of tf2_msgs/msg/TFMessage."""

    transforms: list = field(default_factory=list)


class Topics:
    """Stands in for a node: what is published on a topic comes back to all who listen there, also to the publisher."""

    def __init__(self):
        self.listeners, self.qos, self.sent = {}, {}, []

    def create_subscription(self, kind, topic, callback, qos):
        assert kind is TFMessage
        self.listeners[topic], self.qos[topic] = callback, qos

    def create_publisher(self, kind, topic, qos):
        assert kind is TFMessage and topic == "/tf"
        return SimpleNamespace(publish=self.publish)

    def publish(self, message):
        self.sent += message.transforms
        self.listeners["/tf"](message)

    def other(self, parent, child, topic="/tf_static", stamp_ns=START - 1):
        """Somebody else publishes a transform."""
        transform = PoseWriter(rclpy_class).transform_stamped(np.eye(4), stamp_ns, parent, child)
        self.listeners[topic](TFMessage([transform]))


@pytest.fixture
def topics(monkeypatch):
    module = ModuleType("tf2_msgs.msg")
    module.TFMessage = TFMessage
    monkeypatch.setitem(sys.modules, "tf2_msgs", ModuleType("tf2_msgs"))
    monkeypatch.setitem(sys.modules, "tf2_msgs.msg", module)
    return Topics()


@pytest.fixture
def said():
    return []


@pytest.fixture
def transforms(topics, said):
    return Transforms(topics, PoseWriter(rclpy_class), said.append)


def test_a_free_frame_gets_the_pose_as_it_is(topics, transforms, said):
    assert transforms.send(moved(0.25, 0.1), START + 7, "left", "right") == ""
    (sent,) = topics.sent
    assert (sent.header.frame_id, sent.child_frame_id) == ("left", "right")
    assert (sent.header.stamp.sec, sent.header.stamp.nanosec) == (START // 10**9, 7)
    moves, turns = sent.transform.translation, sent.transform.rotation
    assert (moves.x, moves.y, moves.z) == (0.25, 0, 0)
    assert (turns.x, turns.y, turns.z, turns.w) == pytest.approx((0, np.sin(0.05), 0, np.cos(0.05)))
    assert said == []


def test_static_transforms_from_before_are_asked_for(topics, transforms):
    assert topics.qos["/tf_static"].durability == DurabilityPolicy.TRANSIENT_LOCAL
    assert topics.qos["/tf"].durability == DurabilityPolicy.VOLATILE and topics.qos["/tf"].depth >= 10


@pytest.mark.parametrize("topic", ["/tf", "/tf_static"])
def test_the_same_parent_by_somebody_else_is_a_second_answer(topics, transforms, said, topic):
    topics.other("left", "right", topic)
    reason = transforms.send(moved(0.25), START, "left", "right")
    assert topics.sent == [] and said == [reason]
    assert "right already has the parent left, as somebody else publishes" in reason and "source_frame" in reason


@pytest.mark.parametrize(("topic", "stamp_ns"), [("/tf", START + 1), ("/tf_static", START)])
def test_the_same_transform_as_ours_from_somebody_else_is_told_from_the_echo(topics, transforms, topic, stamp_ns):
    """An echo on /tf is known by its stamp; a latched transform may have the same stamp as ours."""
    assert transforms.send(moved(0.25), START, "left", "right") == ""
    topics.other("left", "right", topic, stamp_ns)
    assert "already has the parent left" in transforms.send(moved(0.25), START + 2, "left", "right")
    assert len(topics.sent) == 1


def test_an_echo_may_come_late_but_not_for_ever(topics, transforms):
    for index in range(RECENT):
        transforms.send(moved(0.25), START + index, "left", "right")
    topics.other("left", "right", "/tf", START)
    assert transforms.send(moved(0.25), START + RECENT, "left", "right") == "" and len(transforms._sent) == RECENT
    topics.other("left", "right", "/tf", START)
    assert transforms.send(moved(0.25), START + RECENT + 1, "left", "right") != ""


@pytest.mark.parametrize("topic", ["/tf", "/tf_static"])
def test_another_parent_is_respected(topics, transforms, said, topic):
    topics.other("base_link", "right", topic)
    reason = transforms.send(moved(0.25), START, "left", "right")
    assert topics.sent == [] and said == [reason]
    for word in ("right already has the parent base_link", "not published with the parent left", "source_frame"):
        assert word in reason
    assert transforms.send(moved(0.25), START, "left", "right_as_seen") == "", "another name is free"


def test_a_parent_that_comes_later_is_respected_from_then_on(topics, transforms):
    assert transforms.send(moved(0.25), START, "left", "right") == ""
    topics.other("base_link", "right")
    assert "base_link" in transforms.send(moved(0.25), START + 1, "left", "right")
    assert len(topics.sent) == 1


def test_our_own_transform_is_nobody_elses_claim(topics, transforms, said):
    """A new segment or another target_frame changes the parent; what we sent before comes back on /tf."""
    for parent in ("cam_start", "cam_start", "cam_start_2", "cam_start"):
        assert transforms.send(moved(0.25), START, parent, "cam") == ""
    assert len(topics.sent) == 4 and said == []


def test_no_loop_is_closed(topics, transforms, said):
    topics.other("right", "bracket")
    topics.other("bracket", "left")
    assert "left already hangs below right" in transforms.send(moved(0.25), START, "left", "right")
    assert transforms.send(moved(0.25), START, "left", "left") != "", "no frame is its own parent"
    assert topics.sent == [] and len(said) == 2
    assert transforms.send(moved(0.25), START, "bracket", "other") == ""


def test_a_loop_that_others_made_does_not_hang_us(topics, transforms):
    topics.other("a", "b")
    topics.other("b", "a")
    assert transforms.send(moved(0.25), START, "a", "c") == ""


def test_the_reason_is_written_once_and_not_with_every_pose(topics):
    lines = []
    log = Log(SimpleNamespace(warning=lines.append))
    transforms = Transforms(topics, PoseWriter(rclpy_class), partial(log.warn, "tf"))
    topics.other("base_link", "right")
    reasons = {transforms.send(moved(0.25), START + i, "left", "right") for i in range(50)}
    assert len(lines) == 1 and reasons == set(lines)


def test_what_cannot_be_a_transform_is_not_sent(topics, transforms):
    with pytest.raises(MessageError, match="frame_id"):
        transforms.send(moved(0.25), START, "", "right")
    assert topics.sent == []


def test_many_frames_do_not_fill_the_memory(topics, transforms, monkeypatch):
    monkeypatch.setattr("garps_ros.live.transforms.MOST_FRAMES", 5)
    for index in range(20):
        topics.other("map", f"f{index}")
    assert len(transforms._parents) == 5
    topics.other("odom", "f0")
    assert "odom" in transforms.send(moved(0.1), START, "map", "f0"), "what is known is kept current"


# --- a real node, without tf2_msgs ----------------------------------------------------------------------------------


@pytest.fixture
def ros(monkeypatch, tmp_path):
    monkeypatch.setenv("ROS_AUTOMATIC_DISCOVERY_RANGE", "OFF")
    monkeypatch.setenv("ROS_LOG_DIR", str(tmp_path))
    for name in ("tf2_msgs", "tf2_msgs.msg"):
        monkeypatch.setitem(sys.modules, name, None)  # also where it is installed
    context = rclpy.Context()
    words = [word for given in ("publish_tf:=true", "lazy:=false") for word in ("-p", given)]
    rclpy.init(args=["--ros-args", *words], context=context)
    node = Node("pose_node", context=context)
    yield node
    node.destroy_node()
    rclpy.try_shutdown(context=context)


def test_without_tf2_msgs_the_node_warns_once_and_works(ros, monkeypatch, capfd):
    monkeypatch.setattr(jobs, "Estimator", recordings.answering(recordings.estimate))
    node = PoseNode(ros)
    executor = SingleThreadedExecutor(context=ros.context)
    executor.add_node(ros)
    try:
        for frame in range(1, 4):
            for index, name in enumerate(("/source", "/target")):
                info, image, depth = (message for _, message in camera(name, frame, "rclpy"))
                node._intake.add_info(index, info)
                node._image(index, IMAGE, image)
                node._image(index, DEPTH, depth)
            limit = time.monotonic() + 20
            while node._counts.used < frame and time.monotonic() < limit:
                executor.spin_once(timeout_sec=0.05)
        assert node._counts.used == 3 and not node._counts.rejected and not node._counts.errors
        assert node._publishers.transform == "off"
    finally:
        assert node.stop(10)
        executor.shutdown()
    said = capfd.readouterr().err
    assert said.count("publish_tf has no effect") == 1 and "ros-jazzy-tf2-msgs" in said
    assert "WARN" in said and "Traceback" not in said
