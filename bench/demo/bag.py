# SPDX-License-Identifier: Apache-2.0
"""Stereo pairs with depth as a rosbag2 (version 9, MCAP), what a robot with a stereo camera would record."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
from rosbags.rosbag2 import StoragePlugin, Writer
from rosbags.typesys import Stores, get_typestore

from bench.pairs.stereo import StereoPair

STORE = get_typestore(Stores.ROS2_JAZZY)
FIRST_STAMP_S = 1_700_000_000
NANOSECONDS = 1_000_000_000
TOPICS = {
    "image_rect": "sensor_msgs/msg/Image",
    "camera_info": "sensor_msgs/msg/CameraInfo",
    "depth": "sensor_msgs/msg/Image",
}


def stamp_ns_of(index: int) -> int:
    """Pairs are one second apart."""
    return (FIRST_STAMP_S + index) * NANOSECONDS


def write_bag(path: Path, pairs: Iterable[tuple[StereoPair, npt.NDArray[Any], npt.NDArray[Any]]]) -> None:
    """Write (pair, depth of the left, depth of the right) as /left/... and /right/... topics to a new folder."""
    with Writer(path, version=9, storage_plugin=StoragePlugin.MCAP) as bag:
        connections = {
            (side, topic): bag.add_connection(f"/{side}/{topic}", kind, typestore=STORE)
            for side in ("left", "right")
            for topic, kind in TOPICS.items()
        }
        for index, (pair, left_depth, right_depth) in enumerate(pairs):
            for side, rgb, depth in (("left", pair.left, left_depth), ("right", pair.right, right_depth)):
                header = _header(index, f"{side}_optical")
                baseline = pair.baseline_m if side == "right" else 0.0
                messages = {
                    "camera_info": _camera_info(header, pair.K, rgb.shape, baseline),
                    "image_rect": _image(header, rgb, "rgb8"),
                    "depth": _image(header, depth.astype(np.float32), "32FC1"),
                }
                for topic, message in messages.items():
                    raw = STORE.serialize_cdr(message, TOPICS[topic])
                    bag.write(connections[side, topic], stamp_ns_of(index), raw)


def _header(index: int, frame_id: str) -> Any:
    stamp = STORE.types["builtin_interfaces/msg/Time"](sec=FIRST_STAMP_S + index, nanosec=0)
    return STORE.types["std_msgs/msg/Header"](stamp=stamp, frame_id=frame_id)


def _image(header: Any, pixels: npt.NDArray[Any], encoding: str) -> Any:
    height, width = pixels.shape[:2]
    raw = np.frombuffer(np.ascontiguousarray(pixels).tobytes(), np.uint8)
    return STORE.types["sensor_msgs/msg/Image"](
        header=header,
        height=height,
        width=width,
        encoding=encoding,
        is_bigendian=0,
        step=raw.size // height,
        data=raw,
    )


def _camera_info(header: Any, K: npt.NDArray[np.float64], shape: tuple[int, ...], baseline_m: float) -> Any:
    P = np.hstack([K, [[-K[0, 0] * baseline_m], [0.0], [0.0]]])
    roi = STORE.types["sensor_msgs/msg/RegionOfInterest"](0, 0, 0, 0, False)
    return STORE.types["sensor_msgs/msg/CameraInfo"](
        header=header,
        height=shape[0],
        width=shape[1],
        distortion_model="plumb_bob",
        d=np.zeros(5),
        k=K.ravel(),
        r=np.eye(3).ravel(),
        p=P.ravel(),
        binning_x=0,
        binning_y=0,
        roi=roi,
    )
