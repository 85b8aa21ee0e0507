# SPDX-License-Identifier: Apache-2.0
"""The pose as a transform on /tf, published only if nobody else publishes where the camera is."""

from __future__ import annotations

import importlib
from collections.abc import Callable
from typing import Any

from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile

from garps_core.checks import Float64Array
from msg_adapters import PoseWriter

QOS = QoSProfile(depth=100)  # as tf2_ros
STATIC_QOS = QoSProfile(depth=100, durability=DurabilityPolicy.TRANSIENT_LOCAL)
MOST_FRAMES = 10_000
RECENT = 1000
"""Number of transforms kept whose echo on /tf may still be under way; queues hold 100."""


class Transforms:
    """Publishes transforms on /tf and listens there, so that no frame gets a second publisher or parent and no loop.

    Args:
        node: to publish with.
        poses: makes the messages.
        say: called with a line when a transform is not published.
    Raises:
        ImportError: tf2_msgs is not installed.
    """

    def __init__(self, node: Node, poses: PoseWriter, say: Callable[[str], None]) -> None:
        kind = importlib.import_module("tf2_msgs.msg").TFMessage  # part of ROS, but not of every installation
        self._message, self._poses, self._say = kind, poses, say
        self._parents: dict[str, str] = {}
        """Child -> parent, as others have published."""
        self._sent: dict[tuple[str, str, int], None] = {}
        """Parent, child and stamp (ns) of the transforms sent from here, oldest first; they come back on /tf."""
        self._publisher = node.create_publisher(kind, "/tf", QOS)
        node.create_subscription(kind, "/tf", self._heard, QOS)
        node.create_subscription(kind, "/tf_static", self._heard_static, STATIC_QOS)

    def send(self, T: Float64Array, stamp_ns: int, frame_id: str, child_frame_id: str) -> str:
        """Publish T (4x4, m) as frame_id -> child_frame_id; return "" or the reason why it is not published."""
        reason = self._objection(frame_id, child_frame_id)
        if reason:
            self._say(reason)
            return reason
        transform = self._poses.transform_stamped(T, stamp_ns, frame_id, child_frame_id)
        self._remember((frame_id, child_frame_id, stamp_ns))
        self._publisher.publish(self._message(transforms=[transform]))
        return ""

    def _objection(self, frame_id: str, child: str) -> str:
        """Return why the transform would break the tree; "" when it would not.

        A parent of the same name breaks it too, because the child would have two poses.
        """
        parent = self._parents.get(child)
        if parent is not None:
            why = f"{child} already has the parent {parent}, as somebody else publishes"
        elif child in self._upwards(frame_id):
            why = f"{frame_id} already hangs below {child}"
        else:
            return ""
        return f"{why}: not published with the parent {frame_id}; set source_frame to another name"

    def _upwards(self, frame_id: str) -> list[str]:
        """Return a frame, its parent, the parent's parent and so on, as far as others have published."""
        chain = [frame_id]
        while (parent := self._parents.get(chain[-1])) is not None and parent not in chain:
            chain.append(parent)
        return chain

    def _remember(self, sent: tuple[str, str, int]) -> None:
        self._sent[sent] = None
        if len(self._sent) > RECENT:
            del self._sent[next(iter(self._sent))]

    def _heard(self, message: Any) -> None:
        for transform in message.transforms:
            stamp_ns = transform.header.stamp.sec * 1_000_000_000 + transform.header.stamp.nanosec
            if (transform.header.frame_id, transform.child_frame_id, stamp_ns) not in self._sent:
                self._learn(transform)

    def _heard_static(self, message: Any) -> None:
        for transform in message.transforms:  # nothing is sent there from here, so none is an echo
            self._learn(transform)

    def _learn(self, transform: Any) -> None:
        child = transform.child_frame_id
        if child in self._parents or len(self._parents) < MOST_FRAMES:
            self._parents[child] = transform.header.frame_id
