# SPDX-License-Identifier: Apache-2.0
"""The publishers of the live node: pose, odometry, transform, clouds, diagnostics; for the executor's thread only."""

from __future__ import annotations

import functools
import importlib
from collections.abc import Iterable
from functools import partial
from typing import Any

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from geometry_msgs.msg import PoseStamped
from nav_msgs.msg import Odometry
from rclpy.node import Node
from rclpy.qos import QoSProfile
from sensor_msgs.msg import PointCloud2

from garps_core.checks import Float64Array
from garps_ros.estimates.outcomes import Outcome
from garps_ros.live.clouds import ColouredPoints
from garps_ros.live.diagnostics import Check
from garps_ros.live.inputs import SIDES
from garps_ros.live.log import Log
from garps_ros.live.transforms import Transforms
from msg_adapters import CloudWriter, MessageError, PoseWriter

QOS = QoSProfile(depth=10)  # reliable, keep last, volatile: what navigation subscribes to
CLOUD_QOS = QoSProfile(depth=1)


@functools.cache
def message_class(name: str) -> Any:
    """Return the rclpy class of a full message name, e.g. "geometry_msgs/msg/Pose"."""
    package, _, kind = name.split("/")
    return getattr(importlib.import_module(f"{package}.msg"), kind)


class Publishers:
    """The node's publishers.

    Args:
        node: to publish with.
        transforms: also publish on /tf.
        log: told about clouds and transforms that are not published.
    """

    def __init__(self, node: Node, transforms: bool, log: Log) -> None:
        self._node, self._log = node, log
        self._pose = node.create_publisher(PoseStamped, "~/pose", QOS)
        self._odometry = node.create_publisher(Odometry, "~/odometry", QOS)
        self._clouds = [node.create_publisher(PointCloud2, f"~/{name}_cloud", CLOUD_QOS) for name in SIDES]
        self._diagnostics = node.create_publisher(DiagnosticArray, "/diagnostics", QOS)
        self._poses, self._points = PoseWriter(message_class), CloudWriter(message_class)
        self._transforms: Transforms | None = None
        self.transform = "off"
        """State of the transform, in words: "off", "waiting", "published", or why it was not published."""
        if transforms:
            try:
                self._transforms = Transforms(node, self._poses, partial(log.warn, "tf"))
                self.transform = "waiting"
            except ImportError as error:
                log.warn("tf", f"publish_tf has no effect: {error}; install tf2_msgs (apt: ros-jazzy-tf2-msgs)")

    @property
    def wanted(self) -> bool:
        """True while somebody subscribes to a result."""
        publishers = (self._pose, self._odometry, *self._clouds)
        return self._transforms is not None or any(p.get_subscription_count() for p in publishers)

    @property
    def clouds_wanted(self) -> bool:
        """True while somebody subscribes to a cloud."""
        return any(publisher.get_subscription_count() for publisher in self._clouds)

    def publish(self, outcome: Outcome, T: Float64Array, covariance: Float64Array) -> None:
        """Publish a pose (4x4, m) with its covariance (6x6, ROS meaning), stamped with the source image's time.

        Raises:
            MessageError: a pose or covariance that must not be published; nothing is published then.
        """
        stamp_ns, frame_id = outcome.row.source_stamp_ns, outcome.frame_id
        odometry = self._poses.odometry(T, covariance, stamp_ns, frame_id, outcome.child_frame_id)
        self._pose.publish(self._poses.pose_stamped(T, stamp_ns, frame_id))
        self._odometry.publish(odometry)
        if self._transforms is not None:
            self.transform = self._transforms.send(T, stamp_ns, frame_id, outcome.child_frame_id) or "published"

    def publish_clouds(self, clouds: tuple[ColouredPoints, ColouredPoints], outcome: Outcome) -> None:
        """Publish the source and the target cloud, each if somebody subscribes to it."""
        stamp_ns = outcome.row.source_stamp_ns
        for publisher, cloud in zip(self._clouds, clouds, strict=True):
            if not publisher.get_subscription_count():
                continue
            try:
                message = self._points.point_cloud(cloud.points, cloud.colours, stamp_ns, outcome.frame_id)
            except MessageError as error:
                self._log.warn("clouds", f"no cloud: {error}; raise lifting.stride")
                continue
            publisher.publish(message)

    def publish_checks(self, checks: Iterable[Check]) -> None:
        """Publish checks on /diagnostics, each named after the node."""
        name = self._node.get_fully_qualified_name().lstrip("/")
        message = DiagnosticArray()
        message.header.stamp = self._node.get_clock().now().to_msg()
        message.status = [_status(f"{name}: {check.name}", name, check) for check in checks]
        self._diagnostics.publish(message)


def _status(full_name: str, hardware: str, check: Check) -> DiagnosticStatus:
    values = [KeyValue(key=str(key), value=str(value)) for key, value in check.values.items()]
    return DiagnosticStatus(
        level=bytes([int(check.level)]),
        name=full_name,
        message=str(check.message),
        hardware_id=hardware,
        values=values,
    )
