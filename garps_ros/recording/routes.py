# SPDX-License-Identifier: Apache-2.0
"""The publishers of a recording's topics in a live graph. Needs rclpy."""

from __future__ import annotations

import importlib
import re
from dataclasses import dataclass
from typing import Any

from rclpy.duration import Duration
from rclpy.exceptions import InvalidTopicNameException
from rclpy.node import Node
from rclpy.publisher import Publisher
from rclpy.qos import DurabilityPolicy, HistoryPolicy, QoSProfile, ReliabilityPolicy
from rclpy.serialization import deserialize_message, serialize_message

from garps_ros.recording.bags import BagError
from garps_ros.recording.raw_bags import RawBag
from msg_adapters import MessageError

CLOCK_TOPIC = "/clock"
DEPTH, LARGEST_DEPTH = 10, 1000
"""Number of messages that a publisher keeps; more if the recorded publishers kept more for late subscribers."""
KIND = re.compile(r"([a-zA-Z]\w*)/msg/([A-Z]\w*)")


@dataclass
class Route:
    """A topic being played.

    Args:
        topic: its name.
        kind: its type, e.g. "sensor_msgs/msg/Image".
        message_class: that type as it is installed here.
        publisher: sends serialised messages.
    """

    topic: str
    kind: str
    message_class: Any
    publisher: Publisher
    sent: int = 0
    refused: int = 0
    reason: str = ""
    """Reason why the first message was refused."""
    fits: bool = False
    """A message has been decoded as the installed type."""

    def send(self, raw: bytes | MessageError) -> None:
        """Publish a serialised message, or count it as refused.

        Messages are decoded until one fits the installed type: definitions change between distributions (Range and
        BatteryState did after ROS 1), and a subscriber takes the wrong one for garbage, or ends.
        """
        misfit = str(raw) if isinstance(raw, MessageError) else "" if self.fits else self._misfit(raw)
        if misfit:
            self.refused += 1
            self.reason = self.reason or misfit
            return
        self.fits = True
        self.publisher.publish(raw)
        self.sent += 1

    def _misfit(self, raw: bytes) -> str:
        wrong = "does not fit the type installed here"
        try:
            size = len(serialize_message(deserialize_message(raw, self.message_class)))
        except Exception as error:  # what the middleware raises on bytes of another type is not documented
            return f"{wrong}: {type(error).__name__}"
        padded = (size + 3) // 4 == (len(raw) + 3) // 4  # some middlewares fill up to four bytes
        return "" if padded else f"{wrong}: {len(raw)} bytes, expected {size}"

    def listeners(self) -> int:
        """Return the number of subscriptions that are matched now."""
        return int(self.publisher.get_subscription_count())

    def delivered(self, timeout: Duration) -> bool:
        """Wait until all subscribers have acknowledged everything; False after the timeout."""
        return bool(self.publisher.wait_for_all_acked(timeout))


def open_routes(node: Node, bag: RawBag, topics: list[str]) -> tuple[dict[str, Route], dict[str, str]]:
    """Open publishers of the topics that can be played; return also the reasons why the others cannot.

    Args:
        node: the publishers' node.
        bag: an open recording.
        topics: what was asked for; empty for everything.
    Returns:
        topic -> route, topic -> reason; a topic that was asked for is never left out.
    Raises:
        BagError: a topic that was asked for cannot be played, or none can.
    """
    for topic in topics:
        if topic not in bag.types:
            raise BagError(f"topic {topic} is not in the recording: expected one of {bag.listing()}")
    routes, left_out = {}, {}
    for topic in dict.fromkeys(topics) or sorted(bag.types):
        route = _open(node, bag, topic)
        if isinstance(route, Route):
            routes[topic] = route
        else:
            left_out[topic] = route
    reasons = "; ".join(f"{topic} ({why})" for topic, why in left_out.items())
    if left_out and (topics or not routes):
        raise BagError(f"cannot play {reasons}: expected topics whose type is installed; topics: {bag.listing()}")
    return routes, left_out


def _open(node: Node, bag: RawBag, topic: str) -> Route | str:
    """Open a route, or return why there can be none."""
    kind = bag.types[topic]
    if topic == CLOCK_TOPIC:
        return "the clock is made from the recording times"
    message_class = _message_class(kind)
    if message_class is None:
        return f"{kind} is not installed"
    latched = bag.latched(topic)
    quality = QoSProfile(
        history=HistoryPolicy.KEEP_LAST,
        depth=min(max(DEPTH, latched), LARGEST_DEPTH),
        reliability=ReliabilityPolicy.RELIABLE,  # suits every subscriber, best effort or not
        durability=DurabilityPolicy.TRANSIENT_LOCAL if latched else DurabilityPolicy.VOLATILE,
    )
    try:
        return Route(topic, kind, message_class, node.create_publisher(message_class, topic, quality))
    except InvalidTopicNameException:
        return "no valid name in ROS 2"


def _message_class(kind: str) -> Any:
    """Return the class of a message type, None when its package is not installed or has no such message."""
    match = KIND.fullmatch(kind)
    if match is None:
        return None
    try:
        return getattr(importlib.import_module(f"{match[1]}.msg"), match[2], None)
    except ImportError:
        return None
