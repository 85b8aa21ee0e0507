# SPDX-License-Identifier: Apache-2.0
"""Messages to numpy and back by attribute access: works on rclpy, rosbags (ROS 1 and 2) and look-alike objects."""

from msg_adapters.cameras import Camera, camera_from_info
from msg_adapters.clouds import CloudWriter
from msg_adapters.errors import MessageError
from msg_adapters.fields import NANOSECONDS, header_frame_id, header_stamp_ns, ns_to_stamp, stamp_to_ns
from msg_adapters.images import depth_image, is_compressed, rgb_image
from msg_adapters.poses import PoseWriter, checked_covariance, pose_from_message

__all__ = [
    "NANOSECONDS",
    "Camera",
    "CloudWriter",
    "MessageError",
    "PoseWriter",
    "camera_from_info",
    "checked_covariance",
    "depth_image",
    "header_frame_id",
    "header_stamp_ns",
    "is_compressed",
    "ns_to_stamp",
    "pose_from_message",
    "rgb_image",
    "stamp_to_ns",
]
