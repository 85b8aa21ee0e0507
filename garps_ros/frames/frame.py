# SPDX-License-Identifier: Apache-2.0
"""One camera's topics and messages, and how they become the core's View. Used offline and live."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from garps_core.types import View
from msg_adapters import camera_from_info, depth_image, header_frame_id, header_stamp_ns, rgb_image

FOR_THE_ADAPTER = {"auto": "auto", "rectified": "true", "raw": "false"}
"""Values of the setting `rectified` as `camera_from_info` takes them."""


@dataclass(frozen=True)
class CameraTopics:
    """The topics of one camera; an empty name is not known yet, or is a depth that a network gives."""

    image: str = ""
    info: str = ""
    depth: str = ""

    def __str__(self) -> str:
        return f"image {self.image}, info {self.info}, depth {self.depth or 'from a network'}"


@dataclass(frozen=True)
class Frame:
    """The messages of one camera at one time.

    Args:
        topics: the camera's.
        stamp_ns: of the image, ns.
        image: sensor_msgs/Image or CompressedImage.
        depth: sensor_msgs/Image or CompressedImage; None where a network gives the depth.
        info: sensor_msgs/CameraInfo.
    """

    topics: CameraTopics
    stamp_ns: int
    image: Any
    depth: Any
    info: Any


def view_from_messages(
    image: Any,
    info: Any,
    depth: Any = None,
    *,
    topic: str = "",
    rectified: str = "auto",
    allow_resized: bool = False,
) -> tuple[View, str]:
    """Make a View of an Image or CompressedImage, its CameraInfo and the depth registered to it.

    Args:
        image: sensor_msgs/Image or CompressedImage in colour or grey.
        info: sensor_msgs/CameraInfo of the image.
        depth: sensor_msgs/Image or CompressedImage, of the same size and lens as the image; None = no depth.
        topic: the image's topic, from which "auto" reads whether the image is rectified.
        rectified: "rectified" = P of the CameraInfo counts, "raw" = its K and D count, or "auto".
        allow_resized: accept an image that was scaled evenly against its CameraInfo.
    Returns:
        The view without distortion, stamp and frame those of the image; and a text that says which calibration was
        used and why, to be logged when it changes.
    Raises:
        MessageError: a message that is malformed, or does not fit the others.
        InputError: the messages are well formed, but make no view that the core can use.
    """
    rgb = rgb_image(image)
    camera = camera_from_info(
        info,
        (rgb.shape[1], rgb.shape[0]),
        topic=topic,
        rectified=FOR_THE_ADAPTER[rectified],
        allow_resized=allow_resized,
    )
    metres = None if depth is None else depth_image(depth)
    rgb, metres = camera.rectify(rgb, metres)
    view = View(rgb=rgb, K=camera.K, depth=metres, stamp_ns=header_stamp_ns(image), frame_id=header_frame_id(image))
    return view, camera.decision


def frame_warning(image: Any, info: Any, depth: Any = None) -> str:
    """Return a warning that calibration or depth may be another camera's; "" when their frame_id is the image's.

    It is no error, because some drivers set frame_id carelessly. Wrong remapping looks the same, but gives wrong poses.
    """
    frame_id = header_frame_id(image)
    warnings = []
    for name, message, question in (
        ("camera_info", info, "is it this camera's?"),
        ("depth", depth, "is it registered to the image?"),
    ):
        if message is not None and header_frame_id(message) != frame_id:
            warnings.append(f"{name} is of frame {header_frame_id(message)!r}, the image of {frame_id!r}: {question}")
    return "; ".join(warnings)
