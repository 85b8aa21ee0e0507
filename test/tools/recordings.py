# SPDX-License-Identifier: Apache-2.0
"""Small recordings for tests, written with rosbags, and an estimator that answers at once."""

from pathlib import Path

import numpy as np
from ros_messages import ROS1, ROS2, camera_info, image
from rosbags.rosbag1 import Writer as Writer1
from rosbags.rosbag2 import StoragePlugin, Writer
from scipy.spatial.transform import Rotation

from garps_core.align import Estimator
from garps_core.types import PoseEstimate, Status

SECOND = 10**9
START = 1_600_000_000 * SECOND
PERIOD = SECOND // 10
SIZE = (64, 48)
STORAGES = ("sqlite3", "mcap", "ros1")
COVARIANCE = np.diag([1e-4] * 3 + [1e-6] * 3)


def picture(index, seed=0):
    """A 64x48 image with texture whose first pixel says which frame it is."""
    pixels = np.random.default_rng(seed).integers(0, 256, (SIZE[1], SIZE[0], 3), dtype=np.uint8)
    pixels[0, 0] = index
    return pixels


def index_of(view):
    return int(view.rgb[0, 0, 0])


def camera(prefix, index, library, offset_ns=0, frame_id=None, calibrated=True):
    """The three messages of one frame of a camera as (topic, message)."""
    stamp_ns = START + index * PERIOD + offset_ns
    head = {"stamp_ns": stamp_ns, "frame_id": frame_id or f"{prefix.strip('/')}_optical"}
    millimetres = np.full((SIZE[1], SIZE[0]), 2000, np.uint16)
    K = None if calibrated else np.zeros((3, 3))
    return [
        (f"{prefix}/camera_info", camera_info(library, SIZE, K=K, D=[0] * 5, model="plumb_bob", **head)),
        (f"{prefix}/image_raw", image(picture(index), "rgb8", library, **head)),
        (f"{prefix}/depth/image_raw", image(millimetres, "16UC1", library, **head)),
    ]


def frames(prefixes, count, library, offsets=(0, 0)):
    """Messages of some cameras over time."""
    return [
        pair
        for index in range(1, count + 1)
        for prefix, offset in zip(prefixes, offsets, strict=False)
        for pair in camera(prefix, index, library, offset)
    ]


def library_of(storage):
    return "rosbags_ros1" if storage == "ros1" else "rosbags"


def write(folder: Path, storage, messages, name="walk"):
    """Write (topic, message) with the header stamp as recording time; `message` may be (type, raw bytes, time)."""
    store = ROS1 if storage == "ros1" else ROS2
    path = folder / (f"{name}.bag" if storage == "ros1" else name)
    plugin = StoragePlugin.SQLITE3 if storage == "sqlite3" else StoragePlugin.MCAP
    writer = Writer1(path) if storage == "ros1" else Writer(path, version=9, storage_plugin=plugin)
    serialize = store.serialize_ros1 if storage == "ros1" else store.serialize_cdr
    connections = {}
    latest = START
    with writer:
        for topic, message in messages:
            if isinstance(message, tuple):
                kind, raw, latest = message
            else:
                kind, raw = message.__msgtype__, serialize(message, message.__msgtype__)
                latest = max(latest, message.header.stamp.sec * SECOND + message.header.stamp.nanosec)
            if topic not in connections:
                connections[topic] = writer.add_connection(topic, kind, typestore=store)
            writer.write(connections[topic], latest, bytes(raw))
    return path


def moved(x, angle=0.0):
    T = np.eye(4)
    T[:3, :3] = Rotation.from_euler("y", angle).as_matrix()
    T[0, 3] = x
    return T


def estimate(source, target, config=None, prior=None, *, bad=(), covariance=COVARIANCE, overlap=0.9):
    """The camera moves 0.1 m to the right per frame and the rig is 0.25 m wide; frames in `bad` have no pose."""
    if index_of(source) in bad or index_of(target) in bad:
        return PoseEstimate(Status.LOW_OVERLAP, "made to fail")
    x = 0.1 * (index_of(source) - index_of(target))
    x += 0.25 if source.frame_id != target.frame_id else 0.0
    return PoseEstimate(Status.CONVERGED, "", moved(x), covariance, overlap=overlap)


def answering(estimate):
    """Return a class in place of `Estimator` that answers with estimate(source, target, config, prior).

    That function returns a PoseEstimate, or one with both mixtures as a pair.
    """

    class Answering(Estimator):
        def estimate_with_mixtures(self, source, target, prior=None, maps=None):
            found = estimate(source, target, self.config, prior)
            return found if isinstance(found, tuple) else (found, None)

    return Answering
