# SPDX-License-Identifier: Apache-2.0
"""Subscriptions whose QoS suits their publishers, with the reason why nothing arrives. Callbacks only store references.

Images are subscribed as best effort while they get through, and as reliable when they do not: beyond 0.5 MB Fast DDS
loses most of them in its default setting. Reliable is not for all: Fast DDS 2.14 can loop for ever in a reliable reader
that joins messages of more than 64 KB midway, about once in 150 starts, with more shared memory once in 10.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

from rclpy.event_handler import QoSRequestedIncompatibleQoSInfo, SubscriptionEventCallbacks
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, HistoryPolicy, QoSProfile, ReliabilityPolicy, qos_policy_name_from_kind

from garps_ros.live.arrivals import MANY_MISSING, Arrivals, InputState

QUEUE = 10
"""Number of messages that wait for the executor; a third of a second at 30 Hz."""
NOTHING_S = 3.0
"""Time without a message from an existing publisher after which messages count as lost, s."""


class Input:
    """One input topic.

    Args:
        node: to subscribe with.
        role: name for people, "source/image".
        kind: message class.
        topic: as the node would write it, before remapping; or a full name.
        reliability: "auto", "reliable" or "best_effort".
        received: called with every message.
        say: called with a line when QoS does not match.
        once: one message is enough (a calibration); then a latched one is asked for where it is offered.
        optional: its absence is no error.
    """

    def __init__(
        self,
        node: Node,
        role: str,
        kind: type,
        topic: str,
        reliability: str,
        received: Callable[[Any], None],
        say: Callable[[str], None],
        once: bool = False,
        optional: bool = False,
    ) -> None:
        self._node, self._role, self._kind, self._topic = node, role, kind, topic
        self._reliability, self._received, self._say = reliability, received, say
        self._once, self._optional = once, optional
        self.topic = node.resolve_topic_name(topic)
        self.arrivals = Arrivals()
        self._publishers = 0
        self._offered_since_s: float | None = None
        self._warning = ""
        # Until a publisher is there: best effort hears everyone.
        self._qos = _profile(reliability == "reliable", latched=False)
        self._subscription = self._subscribe()

    def follow_offers(self) -> None:
        """Subscribe anew where another QoS suits the publishers better. It is cheap and may be called often."""
        # By the name before remapping: rclpy remaps it here too, and would remap a remapped one once more.
        offers = self._node.get_publishers_info_by_topic(self._topic)
        self._publishers = len(offers)
        self._warning = self._type_warning(offers) or self._qos_warning(offers)
        if not offers:
            return
        offered = all(offer.qos_profile.reliability == ReliabilityPolicy.RELIABLE for offer in offers)
        latched = all(offer.qos_profile.durability == DurabilityPolicy.TRANSIENT_LOCAL for offer in offers)
        reliable = self._reliability == "reliable" or (self._reliability == "auto" and offered and self._needs_it())
        wanted = _profile(reliable, latched and reliable and self._once)
        if (wanted.reliability, wanted.durability) != (self._qos.reliability, self._qos.durability):
            self._node.destroy_subscription(self._subscription)
            self._qos = wanted
            self._subscription = self._subscribe()

    def _needs_it(self) -> bool:
        """Tell whether best effort is not enough: a calibration must not be lost, or images are being lost."""
        if self._once or self._qos.reliability == ReliabilityPolicy.RELIABLE:
            return True
        now_s = time.monotonic()
        self._offered_since_s = self._offered_since_s or now_s
        never = self.arrivals.count == 0 and now_s - self._offered_since_s > NOTHING_S
        return never or self.arrivals.missing() > MANY_MISSING

    def state(self) -> InputState:
        """Return the state for the diagnostics."""
        qos = self._qos.reliability.name + (", TRANSIENT_LOCAL" if _is_latched(self._qos) else "")
        return InputState(
            self._role, self.topic, self.arrivals, self._publishers, qos, self._warning, self._once, self._optional
        )

    def _subscribe(self) -> Any:
        events = SubscriptionEventCallbacks(incompatible_qos=self._incompatible)
        return self._node.create_subscription(self._kind, self._topic, self._arrived, self._qos, event_callbacks=events)

    def _arrived(self, message: Any) -> None:
        stamp = message.header.stamp
        stamp_ns = stamp.sec * 1_000_000_000 + stamp.nanosec
        self.arrivals.note(time.monotonic(), stamp_ns, self._node.get_clock().now().nanoseconds)
        self._received(message)

    def _incompatible(self, event: QoSRequestedIncompatibleQoSInfo) -> None:
        if self._reliability == "auto":
            return  # `follow_offers` is about to ask for less
        policy = qos_policy_name_from_kind(event.last_policy_kind)
        self._say(
            f"{self._role}: a publisher on {self.topic} offers less {policy} than image_qos:={self._reliability} asks "
            f"for ({event.total_count} so far): nothing will arrive from it; set image_qos to auto or best_effort"
        )

    def _qos_warning(self, offers: list[Any]) -> str:
        asked = self._qos.reliability == ReliabilityPolicy.RELIABLE and self._reliability == "reliable"
        weak = [offer for offer in offers if offer.qos_profile.reliability != ReliabilityPolicy.RELIABLE]
        if not (asked and weak):
            return ""
        return f"incompatible QoS: {weak[0].node_name} offers BEST_EFFORT, image_qos asks for RELIABLE; set it to auto"

    def _type_warning(self, offers: list[Any]) -> str:
        package, kind = self._kind.__module__.split(".")[0], self._kind.__name__
        wanted = f"{package}/msg/{kind}"
        others = [offer for offer in offers if offer.topic_type != wanted]
        if not others or len(others) < len(offers):
            return ""
        return (
            f"{others[0].node_name} publishes {others[0].topic_type}, expected {wanted}. "
            "Check the remapping, image_transport and depth_transport"
        )


def _profile(reliable: bool, latched: bool) -> QoSProfile:
    return QoSProfile(
        history=HistoryPolicy.KEEP_LAST,
        depth=QUEUE,
        reliability=ReliabilityPolicy.RELIABLE if reliable else ReliabilityPolicy.BEST_EFFORT,
        durability=DurabilityPolicy.TRANSIENT_LOCAL if latched else DurabilityPolicy.VOLATILE,
    )


def _is_latched(qos: QoSProfile) -> bool:
    return bool(qos.durability == DurabilityPolicy.TRANSIENT_LOCAL)
