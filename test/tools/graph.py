# SPDX-License-Identifier: Apache-2.0
"""A real ROS graph for tests: a domain of one's own, a peer that talks to the node, and cameras.

`with private_domain(folder) as domain, NodeProcess([...], domain.environment, log) as node, Peer(domain) as peer:`
"""

import os
import socket
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any
from unittest import mock

import cv2
import numpy as np
import pytest
import ros_messages
from node_process import PATIENCE_S, ROOT, NodeProcess, Nursery

from bench.rooms import RoomPair, make_pair

if os.environ.get("GARPS_REQUIRE_ROS") != "1":
    pytest.importorskip("rclpy")  # skips the module that imports this one

import rclpy
from diagnostic_msgs.msg import DiagnosticArray
from rcl_interfaces.srv import SetParameters
from rclpy.executors import SingleThreadedExecutor
from rclpy.parameter import Parameter
from rclpy.qos import QoSProfile, ReliabilityPolicy
from sensor_msgs.msg import CameraInfo, CompressedImage, Image

__all__ = [
    "PATIENCE_S", "SECOND", "SIZE", "Camera", "Domain", "NodeProcess", "Nursery", "Peer", "Rig", "Shot",
    "private_domain", "room_pair",
]  # fmt: skip

FIRST_PORT = 21000
"""Base of the ports: a domain is held by a socket bound to this port + its number."""
DOMAINS = range(1, 102)  # beyond, DDS would use ports that Linux hands out to anybody
SIZE = (320, 240)
SECOND = 1_000_000_000


@dataclass(frozen=True)
class Domain:
    """A ROS domain that nobody else on this machine uses, and the environment of processes in it."""

    number: int
    environment: dict[str, str]


@contextmanager
def private_domain(folder: Path) -> Iterator[Domain]:
    """Hold a free domain; this process has its environment meanwhile. Logs of ROS go to `folder`."""
    with _held_number() as number:
        ours = {
            "ROS_DOMAIN_ID": str(number),
            "ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST",
            "ROS_LOG_DIR": str(folder),
            "ROS_PYTHON_CHECK_FIELDS": "1",
        }
        theirs = {"OMP_NUM_THREADS": "1", "PYTHONPATH": str(ROOT), "PYTHONFAULTHANDLER": "1"}
        with mock.patch.dict(os.environ, ours):
            os.environ.pop("ROS_LOCALHOST_ONLY", None)  # it would override the range
            yield Domain(number, {**os.environ, **theirs})


@contextmanager
def _held_number() -> Iterator[int]:
    start = os.getpid() % len(DOMAINS)
    for number in (*DOMAINS[start:], *DOMAINS[:start]):
        with socket.socket() as holder:
            try:
                holder.bind(("127.0.0.1", FIRST_PORT + number))
            except OSError:
                continue
            yield number
            return
    pytest.fail(f"no free ROS domain: all ports {FIRST_PORT + 1}..{FIRST_PORT + len(DOMAINS)} are taken")


class Peer:
    """A node of the test, in its own context and executor; it listens to /diagnostics from the start."""

    def __init__(self, domain: Domain, name: str = "peer") -> None:
        self._context = rclpy.Context()
        self._context.init(args=[], domain_id=domain.number)
        self.node = rclpy.create_node(name, context=self._context, start_parameter_services=False)
        self._executor = SingleThreadedExecutor(context=self._context)
        self._executor.add_node(self.node)
        self._diagnostics: dict[str, tuple[int, str, dict[str, str]]] = {}
        self.node.create_subscription(DiagnosticArray, "/diagnostics", self._diagnosed, 50)

    def __enter__(self) -> "Peer":
        return self

    def __exit__(self, *_: object) -> None:
        self._executor.shutdown()
        self.node.destroy_node()
        self._context.try_shutdown()

    def publisher(self, kind: type, topic: str, reliable: bool = True, depth: int = 10) -> Any:
        return self.node.create_publisher(kind, topic, _quality(reliable, depth))

    def collect(self, kind: type, topic: str, reliable: bool = True, depth: int = 50) -> list[tuple[float, Any]]:
        """A list that grows by (steady time of arrival, message) while this peer waits."""
        collected: list[tuple[float, Any]] = []
        self.node.create_subscription(
            kind, topic, lambda message: collected.append((time.monotonic(), message)), _quality(reliable, depth)
        )
        return collected

    def spin(self, seconds: float) -> None:
        """Receive for a while."""
        end = time.monotonic() + seconds
        while (left := end - time.monotonic()) > 0:
            self._executor.spin_once(timeout_sec=left)

    def wait(self, condition: Callable[[], Any], seconds: float = PATIENCE_S, what: str = "a condition") -> Any:
        """Receive until the condition is true, and return its value; the test fails when that takes too long."""
        end = time.monotonic() + seconds
        while not (value := condition()):
            if time.monotonic() > end:
                pytest.fail(f"waited {seconds:g} s for {what}; diagnostics last seen:\n{self._described()}")
            self._executor.spin_once(timeout_sec=0.05)
        return value

    def matched(self, *publishers: Any, count: int = 1) -> None:
        """Wait until each publisher has that number of subscriptions.

        The subscriber may know of the publisher a little later: a best-effort message sent now can still be lost.
        """
        for publisher in publishers:
            self.wait(
                lambda publisher=publisher: publisher.get_subscription_count() >= count,
                what=f"{count} subscription(s) on {publisher.topic_name}",
            )

    def call(self, kind: type, service: str, request: Any, seconds: float = PATIENCE_S) -> Any:
        """The response of a service."""
        client = self.node.create_client(kind, service)
        try:
            self.wait(client.service_is_ready, seconds, f"service {service}")
            future = client.call_async(request)
            self.wait(future.done, seconds, f"an answer of {service}")
            return future.result()
        finally:
            self.node.destroy_client(client)

    def set_parameter(self, node: str, name: str, value: Any) -> tuple[bool, str]:
        """(successful, reason) of setting a parameter of another node."""
        request = SetParameters.Request(parameters=[Parameter(name, value=value).to_parameter_msg()])
        (result,) = self.call(SetParameters, f"{node}/set_parameters", request).results
        return result.successful, result.reason

    def diagnostics(self) -> dict[str, tuple[int, str, dict[str, str]]]:
        """Return the last of each status: name -> (level, message, values)."""
        return self._diagnostics

    def _diagnosed(self, message: DiagnosticArray) -> None:
        for status in message.status:
            values = {pair.key: pair.value for pair in status.values}
            self._diagnostics[status.name] = (int.from_bytes(status.level, "big"), status.message, values)

    def _described(self) -> str:
        lines = [f"{name} [{level}] {text} {values}" for name, (level, text, values) in self._diagnostics.items()]
        return "\n".join(lines) or "none"


def _quality(reliable: bool, depth: int) -> QoSProfile:
    reliability = ReliabilityPolicy.RELIABLE if reliable else ReliabilityPolicy.BEST_EFFORT
    return QoSProfile(depth=depth, reliability=reliability)


@cache
def room_pair(seed: int = 1, level: int = 1) -> RoomPair:
    """Two views of a room as a depth camera sees them, small enough for a loaded machine."""
    return make_pair(seed, level, width=SIZE[0], height=SIZE[1], depth_noise="sensor")


@dataclass
class Shot:
    """The three messages of a camera at one time; tests spoil them."""

    image: Any
    camera_info: Any
    depth: Any


class Camera:
    """Publishes one view of a room pair as a driver would.

    Args:
        peer: to publish with.
        side: "source" or "target": the topics' prefix, and which view (camera 0 or 1 of the pair).
        pair: what to show.
        colour: "raw", "jpeg" or "png".
        depth: "16UC1" or "32FC1" raw, "png" (16UC1), "compressedDepth" (16UC1); "" for a camera without.
        reliable: QoS of image and depth.
    """

    def __init__(
        self, peer: Peer, side: str, pair: RoomPair, colour: str = "raw", depth: str = "16UC1", reliable: bool = True
    ) -> None:
        index = ("source", "target").index(side)
        self._rgb, self._metres, self._K = [(pair.rgb0, pair.depth0, pair.K0), (pair.rgb1, pair.depth1, pair.K1)][index]
        self._side, self._colour, self._depth = side, colour, depth
        suffix = "" if colour == "raw" else "/compressed"
        depth_suffix = {"png": "/compressed", "compressedDepth": "/compressedDepth"}.get(depth, "")
        self.image = peer.publisher(CompressedImage if suffix else Image, f"{side}/image{suffix}", reliable)
        self.camera_info = peer.publisher(CameraInfo, f"{side}/camera_info")
        kind = CompressedImage if depth_suffix else Image
        self.depth = peer.publisher(kind, f"{side}/depth{depth_suffix}", reliable) if depth else None

    @property
    def publishers(self) -> tuple[Any, ...]:
        return self.image, self.camera_info, *([self.depth] if self.depth else [])

    def publish(self, stamp_ns: int) -> None:
        self.send(self.shot(stamp_ns))

    def send(self, shot: Shot) -> None:
        """Publish the messages of a shot that are not None, the calibration first."""
        for publisher, message in (
            (self.camera_info, shot.camera_info),
            (self.image, shot.image),
            (self.depth, shot.depth),
        ):
            if message is not None:
                publisher.publish(message)

    def shot(self, stamp_ns: int) -> Shot:
        """New messages of this camera's view."""
        head = {"stamp_ns": stamp_ns, "frame_id": f"{self._side}_optical"}
        info = ros_messages.camera_info("rclpy", SIZE, K=self._K, D=[0.0] * 5, model="plumb_bob", **head)
        return Shot(self._image(head), info, self._depth_image(head) if self._depth else None)

    def _image(self, head: dict[str, Any]) -> Any:
        if self._colour == "raw":
            return ros_messages.image(self._rgb, "rgb8", "rclpy", **head)
        name = {"jpeg": ".jpg", "png": ".png"}[self._colour]
        data = cv2.imencode(name, self._rgb[..., ::-1])[1]
        return ros_messages.compressed(data, f"rgb8; {self._colour} compressed bgr8", "rclpy", **head)

    def _depth_image(self, head: dict[str, Any]) -> Any:
        if self._depth == "32FC1":
            return ros_messages.image(self._metres, "32FC1", "rclpy", **head)
        millimetres = np.nan_to_num(np.rint(1000 * self._metres)).astype(np.uint16)
        if self._depth == "16UC1":
            return ros_messages.image(millimetres, "16UC1", "rclpy", **head)
        file = cv2.imencode(".png", millimetres)[1].tobytes()
        if self._depth == "png":
            return ros_messages.compressed(file, "16UC1; png compressed ", "rclpy", **head)
        return ros_messages.compressed(bytes(12) + file, "16UC1; compressedDepth png", "rclpy", **head)


class Rig:
    """A source and a target camera that see one room pair at the same times.

    Args:
        peer: to publish with.
        pair: what they see.
        **how: of both cameras, see `Camera`.
    """

    def __init__(self, peer: Peer, pair: RoomPair, **how: Any) -> None:
        self._peer = peer
        self.source, self.target = (Camera(peer, side, pair, **how) for side in ("source", "target"))
        self.stamp_ns = 1_700_000_000 * SECOND

    def next_stamp(self, period_ns: int = SECOND // 10) -> int:
        """A later time of acquisition."""
        self.stamp_ns += period_ns
        return self.stamp_ns

    def publish(self) -> int:
        """Publish a pair with a new stamp; returns that."""
        stamp_ns = self.next_stamp()
        self.source.publish(stamp_ns)
        self.target.publish(stamp_ns)
        return stamp_ns

    def publish_until(
        self, condition: Callable[[], Any], what: str, period_s: float = 0.1, seconds: float = PATIENCE_S
    ) -> Any:
        """Publish pair after pair until the condition is true; a first pair may meet no subscriber."""
        due_s = 0.0

        def published() -> Any:
            nonlocal due_s
            if time.monotonic() >= due_s:
                due_s = time.monotonic() + period_s
                self.publish()
            return condition()

        return self._peer.wait(published, seconds, what)
