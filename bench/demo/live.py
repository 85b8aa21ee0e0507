# SPDX-License-Identifier: Apache-2.0
"""The live part of the demo: the node in its own process, the bag played into it, its poses collected. Needs rclpy."""

from __future__ import annotations

import time
from dataclasses import dataclass
from pathlib import Path
from typing import IO, Any

import numpy.typing as npt
from geometry_msgs.msg import PoseStamped
from rclpy.node import Node
from rclpy.qos import QoSProfile
from sensor_msgs.msg import CameraInfo

from bench.live.graph import Listener, LiveError, end, listener, private_domain, start
from msg_adapters import pose_from_message, stamp_to_ns

POSE_TOPIC = "/pose_node/pose"
FIRST_MESSAGE = "/left/camera_info"
"""Sent first of each pair: latency counts from its arrival here, and so includes the way of all six messages."""
REMAPS = {
    f"{role}/{topic}": f"/{side}/{recorded}"
    for role, side in (("source", "left"), ("target", "right"))
    for topic, recorded in (("image", "image_rect"), ("camera_info", "camera_info"), ("depth", "depth"))
}
START_S, LAST_S = 60.0, 5.0
"""Patience with the node: until it is up, and for the last poses."""


@dataclass(frozen=True, eq=False)
class LivePose:
    """A pose as it came: T is 4x4 (source in target); latency in s, NaN where its first message was not heard."""

    T: npt.NDArray[Any]
    latency_s: float


def run_live(bag: Path, log: Path) -> tuple[dict[int, LivePose], int]:
    """Play a bag into a fresh node, as fast as it was recorded.

    Args:
        bag: with the topics of `bench.demo.bag`; the node drops pairs that it has no time for.
        log: takes what the node and the playback write.
    Returns:
        source stamp (ns) -> pose, and the exit code of the node after SIGINT.
    Raises:
        LiveError: the node or the playback failed.
    """
    with private_domain(), log.open("w", encoding="utf-8") as output, listener("demo") as heard:
        poses = _Poses(heard.ros)
        node = start("garps_ros.pose_node", ["--ros-args", *_remaps()], output)
        try:
            heard.wait(lambda: heard.ros.count_publishers(POSE_TOPIC) > 0 or node.poll() is not None, START_S)
            if node.poll() is not None or not heard.ros.count_publishers(POSE_TOPIC):
                raise LiveError(f"the node did not come up within {START_S:g} s: see {log}")
            _play(bag, output, heard)
            heard.wait(lambda: len(poses.found) >= len(poses.sent), LAST_S)
            return poses.found, end(node)
        finally:
            node.kill()


def _play(bag: Path, output: IO[str], heard: Listener) -> None:
    playback = start("garps_ros.replay", [str(bag), "--to-ros"], output)
    try:
        heard.wait(lambda: playback.poll() is not None)
    finally:
        playback.kill()
    if playback.wait():
        raise LiveError(f"playing ended with exit code {playback.returncode}: see {output.name}")


def _remaps() -> list[str]:
    return [word for name, topic in REMAPS.items() for word in ("-r", f"{name}:={topic}")]


class _Poses:
    """Listens to the poses, and to the first message of each pair."""

    def __init__(self, ros: Node) -> None:
        self.sent: dict[int, float] = {}
        self.found: dict[int, LivePose] = {}
        ros.create_subscription(CameraInfo, FIRST_MESSAGE, self._pair, QoSProfile(depth=10))
        ros.create_subscription(PoseStamped, POSE_TOPIC, self._pose, QoSProfile(depth=10))

    def _pair(self, message: CameraInfo) -> None:
        self.sent[stamp_to_ns(message.header.stamp)] = time.perf_counter()

    def _pose(self, message: PoseStamped) -> None:
        stamp_ns, now = stamp_to_ns(message.header.stamp), time.perf_counter()
        T, _ = pose_from_message(message)
        self.found[stamp_ns] = LivePose(T, now - self.sent.get(stamp_ns, float("nan")))
