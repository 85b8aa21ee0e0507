# SPDX-License-Identifier: Apache-2.0
"""Messages of four libraries for tests: rclpy, rosbags (ROS 2 and ROS 1) and plain namespaces."""

import array
import importlib
from types import SimpleNamespace

import numpy as np
import pytest
from rosbags.typesys import Stores, get_typestore

LIBRARIES = ("namespace", "rosbags", "rosbags_ros1", "rclpy")
ROS2, ROS1 = get_typestore(Stores.ROS2_JAZZY), get_typestore(Stores.ROS1_NOETIC)


def rclpy_class(name):
    package, _, kind = name.split("/")
    return getattr(importlib.import_module(f"{package}.msg"), kind)


def message_class(library):
    """Return a function from a full message name to a library's class; skip where rclpy is not installed."""
    if library == "rclpy":
        pytest.importorskip("rclpy")
        return rclpy_class
    stores = {"rosbags": ROS2, "rosbags_ros1": ROS1}
    return stores[library].types.__getitem__ if library in stores else lambda name: SimpleNamespace


def header(library, stamp_ns=5_000_000_007, frame_id="cam"):
    make = message_class(library)
    extra = {"seq": 1} if library == "rosbags_ros1" else {}
    stamp = make("builtin_interfaces/msg/Time")(sec=stamp_ns // 10**9, nanosec=stamp_ns % 10**9)
    return make("std_msgs/msg/Header")(stamp=stamp, frame_id=frame_id, **extra)


def octets(library, data):
    """Bytes as the library would hand them out: read-only numpy from rosbags, array('B') from rclpy."""
    if library == "rclpy":
        return array.array("B", data)
    return np.frombuffer(data, np.uint8) if library.startswith("rosbags") else data


def image(pixels, encoding, library="namespace", step=None, bigendian=False, **head):
    """A sensor_msgs/Image of an HxW or HxWxC array, rows padded with 0xAA up to `step` bytes."""
    pixels = np.ascontiguousarray(pixels)
    rows = pixels.astype(pixels.dtype.newbyteorder(">" if bigendian else "<")).reshape(len(pixels), -1)
    rows = rows.view(np.uint8).reshape(len(pixels), -1)
    step = rows.shape[1] if step is None else step
    padded = np.full((len(pixels), step), 0xAA, np.uint8)
    padded[:, : rows.shape[1]] = rows
    return message_class(library)("sensor_msgs/msg/Image")(
        header=header(library, **head),
        height=pixels.shape[0],
        width=pixels.shape[1],
        encoding=encoding,
        is_bigendian=int(bigendian),
        step=step,
        data=octets(library, padded.tobytes()),
    )


def compressed(data, kind, library="namespace", **head):
    """A sensor_msgs/CompressedImage."""
    make = message_class(library)("sensor_msgs/msg/CompressedImage")
    return make(header=header(library, **head), format=kind, data=octets(library, bytes(data)))


def camera_info(library="namespace", size=(64, 48), K=None, P=None, R=None, D=(), model="", roi=(0, 0, 0, 0), **more):
    """A sensor_msgs/CameraInfo; `size` and `roi` are width first."""
    make = message_class(library)
    head = {name: more.pop(name) for name in ("stamp_ns", "frame_id") if name in more}
    K = np.array([[50.0, 0, 31.5], [0, 52.0, 23.5], [0, 0, 1]]) if K is None else np.asarray(K, float)
    P = np.hstack([K, np.zeros((3, 1))]) if P is None else np.asarray(P, float)
    matrices = {"k": K.ravel(), "p": P.ravel(), "r": np.eye(3).ravel() if R is None else np.asarray(R, float).ravel()}
    matrices["d"] = np.array(D, float)
    if library == "rosbags_ros1":
        matrices = {name.upper(): value for name, value in matrices.items()}
    if library == "rclpy":
        matrices["d"] = array.array("d", matrices["d"])
    binning = {"binning_x": more.pop("binning_x", 0), "binning_y": more.pop("binning_y", 0)}
    window = make("sensor_msgs/msg/RegionOfInterest")(
        x_offset=roi[0], y_offset=roi[1], width=roi[2], height=roi[3], do_rectify=False
    )
    return make("sensor_msgs/msg/CameraInfo")(
        header=header(library, **head),
        width=size[0],
        height=size[1],
        distortion_model=model,
        roi=window,
        **binning,
        **matrices,
    )


def changed(message, **fields):
    """A namespace copy of a namespace message with fields replaced; `...` removes one."""
    values = {**vars(message), **fields}
    return SimpleNamespace(**{name: value for name, value in values.items() if value is not ...})
