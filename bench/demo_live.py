# SPDX-License-Identifier: Apache-2.0
"""The live part of the demo: the node in its own process, the bag played into it, its poses collected. Needs rclpy."""

from __future__ import annotations

import os
import random
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import IO, Any
from unittest import mock

import numpy.typing as npt
from geometry_msgs.msg import PoseStamped
from rclpy.context import Context
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rclpy.qos import QoSProfile
from sensor_msgs.msg import CameraInfo

from msg_adapters import pose_from_message, stamp_to_ns

POSE_TOPIC = "/pose_node/pose"
FIRST_MESSAGE = "/left/camera_info"
"""Sent first of each pair: latency counts from its arrival here, and so includes the way of all six messages."""
REMAPS = {
    f"{role}/{topic}": f"/{side}/{recorded}"
    for role, side in (("source", "left"), ("target", "right"))
    for topic, recorded in (("image", "image_rect"), ("camera_info", "camera_info"), ("depth", "depth"))
}
START_S, LAST_S, STOP_S = 60.0, 5.0, 10.0
"""Patience with the node: until it is up, for the last poses, until it has ended."""


class LiveError(Exception):
    """The node did not come up."""


@dataclass(frozen=True, eq=False)
class LivePose:
    """A pose as it came: T is 4x4 (source in target); latency in seconds."""

    T: npt.NDArray[Any]
    latency_s: float


def run_live(bag: Path, log: Path) -> tuple[dict[int, LivePose], int]:
    """Play a bag into a fresh node, as fast as it was recorded.

    Args:
        bag: with the topics of `bench.demo_bag`; the node drops pairs that it has no time for.
        log: takes what the node and the playback write.
    Returns:
        source stamp (ns) -> pose, and the exit code of the node after SIGINT.
    Raises:
        LiveError: the node or the playback failed.
    """
    with _private_domain(), log.open("w", encoding="utf-8") as output, _collector() as collector:
        node = _child(["garps_ros.pose_node", "--ros-args", *_remaps()], output)
        try:
            collector.wait(lambda: collector.node_is_up() or node.poll() is not None, START_S)
            if node.poll() is not None or not collector.node_is_up():
                raise LiveError(f"the node did not come up within {START_S:g} s: see {log}")
            _play(bag, output, collector)
            collector.wait(lambda: len(collector.poses) >= len(collector.sent), LAST_S)
            return collector.poses, _ended(node)
        finally:
            node.kill()


def _play(bag: Path, output: IO[str], collector: _Collector) -> None:
    playback = _child(["garps_ros.replay", str(bag), "--to-ros"], output)
    try:
        collector.wait(lambda: playback.poll() is not None)
    finally:
        playback.kill()
    if playback.wait():
        raise LiveError(f"playing ended with exit code {playback.returncode}: see {output.name}")


def _remaps() -> list[str]:
    return [word for name, topic in REMAPS.items() for word in ("-r", f"{name}:={topic}")]


def _child(arguments: list[str], output: IO[str]) -> subprocess.Popen[bytes]:
    return subprocess.Popen([sys.executable, "-m", *arguments], stdout=output, stderr=subprocess.STDOUT)


def _ended(node: subprocess.Popen[bytes]) -> int:
    """The exit code after SIGINT; after SIGKILL when that does nothing."""
    node.send_signal(signal.SIGINT)
    try:
        return node.wait(STOP_S)
    except subprocess.TimeoutExpired:
        node.kill()
        return node.wait()


@contextmanager
def _private_domain() -> Iterator[None]:
    """Nobody else's messages: this machine only, and a domain that is unlikely to be in use."""
    ours = {"ROS_DOMAIN_ID": str(random.randint(1, 101)), "ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST"}
    with mock.patch.dict(os.environ, ours):
        yield


class _Collector:
    """Listens to the poses, and to the first message of each pair."""

    def __init__(self, ros: Node, executor: SingleThreadedExecutor) -> None:
        self.ros, self._executor = ros, executor
        self.sent: dict[int, float] = {}
        self.poses: dict[int, LivePose] = {}
        ros.create_subscription(CameraInfo, FIRST_MESSAGE, self._pair, QoSProfile(depth=10))
        ros.create_subscription(PoseStamped, POSE_TOPIC, self._pose, QoSProfile(depth=10))

    def node_is_up(self) -> bool:
        """The node's pose topic is known here."""
        return bool(self.ros.count_publishers(POSE_TOPIC))

    def _pair(self, message: CameraInfo) -> None:
        self.sent[stamp_to_ns(message.header.stamp)] = time.perf_counter()

    def _pose(self, message: PoseStamped) -> None:
        stamp_ns, now = stamp_to_ns(message.header.stamp), time.perf_counter()
        T, _ = pose_from_message(message)
        self.poses[stamp_ns] = LivePose(T, now - self.sent.get(stamp_ns, float("nan")))

    def wait(self, done: Callable[[], bool], seconds: float = float("inf")) -> None:
        """Receive until `done`, at most so long."""
        end = time.monotonic() + seconds
        while not done() and time.monotonic() < end:
            self._executor.spin_once(timeout_sec=0.05)


@contextmanager
def _collector() -> Iterator[_Collector]:
    context = Context()
    context.init(args=[])
    try:
        ros = Node("demo", context=context)
        executor = SingleThreadedExecutor(context=context)
        executor.add_node(ros)
        yield _Collector(ros, executor)
        executor.shutdown()
        ros.destroy_node()
    finally:
        context.try_shutdown()
