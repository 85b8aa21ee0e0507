# SPDX-License-Identifier: Apache-2.0
"""The inputs of the live node: topic and type of each, and the function that takes its messages."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Any

from geometry_msgs.msg import PoseWithCovarianceStamped
from rclpy.node import Node
from sensor_msgs.msg import CameraInfo, CompressedImage, Image

from garps_ros.frames.assembly import DEPTH, IMAGE
from garps_ros.frames.frame import CameraTopics
from garps_ros.live.subscriptions import Input
from garps_ros.parameters.settings import NodeSettings

SIDES = ("source", "target")


@dataclass(frozen=True)
class Takers:
    """The functions that take the messages; each only stores the reference.

    Args:
        image: called with camera (0 = source), IMAGE or DEPTH, and the message.
        info: called with camera and CameraInfo.
        prior: called with a PoseWithCovarianceStamped.
        say: called with kind and text of a complaint.
    """

    image: Callable[[int, int, Any], None]
    info: Callable[[int, Any], None]
    prior: Callable[[Any], None]
    say: Callable[[str, str], None]


def camera_topics(node: Node, settings: NodeSettings, depth: bool) -> list[CameraTopics]:
    """Return the topics of each camera after remapping; with a keyframe there is one camera."""
    parts = ("image", "camera_info", *(["depth"] if depth else []))
    return [CameraTopics(*(node.resolve_topic_name(f"{side}/{part}") for part in parts)) for side in _sides(settings)]


def subscribe(node: Node, settings: NodeSettings, depth: bool, takers: Takers) -> list[Input]:
    """Subscribe to everything that the settings ask for, and to depth where that is wanted."""
    inputs = []
    for index, side in enumerate(_sides(settings)):
        images = [("image", IMAGE, settings.image_transport), ("depth", DEPTH, settings.depth_transport)]
        for part, role, transport in images if depth else images[:1]:
            name = f"{side}/{part}"
            kind, topic = _transported(node, name, transport)
            taker = partial(takers.image, index, role)
            say = partial(takers.say, f"qos {name}")
            inputs.append(Input(node, name, kind, topic, settings.image_qos, taker, say))
        name = f"{side}/camera_info"
        taker, say = partial(takers.info, index), partial(takers.say, f"qos {name}")
        inputs.append(Input(node, name, CameraInfo, name, "auto", taker, say, once=True))
    say = partial(takers.say, "qos prior")
    prior = Input(node, "prior", PoseWithCovarianceStamped, "~/prior", "auto", takers.prior, say, True, True)
    return [*inputs, prior]


def _sides(settings: NodeSettings) -> tuple[str, ...]:
    return SIDES[:1] if settings.pairing == "keyframe" else SIDES


def _transported(node: Node, name: str, transport: str) -> tuple[Any, str]:
    """Return type and topic of an image in a transport; names are remapped without suffix, as image_transport does."""
    return (Image, name) if transport == "raw" else (CompressedImage, f"{node.resolve_topic_name(name)}/{transport}")
