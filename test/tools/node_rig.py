# SPDX-License-Identifier: Apache-2.0
"""Tools of the tests of a running node: node and peer, two cameras, the offline result to compare with."""

import time
from contextlib import contextmanager

import numpy as np
import pytest
from graph import PATIENCE_S, SECOND, Camera, NodeProcess, Peer, room_pair

from garps_core import Config, Status, estimate_relative_pose
from garps_core.config.text import changed_config
from garps_ros.frames.frame import view_from_messages
from msg_adapters import header_stamp_ns, pose_from_message

pytest.importorskip("rclpy")
from geometry_msgs.msg import PoseStamped
from nav_msgs.msg import Odometry

NODE = "/pose_node"
EQUAL = 1e-6
"""Largest difference of the live pose from the offline one, m, rad and their squares."""
CHEAP = ["lifting.stride=4", "start.max_features=1000"]


@contextmanager
def running(domain, tmp_path, settings=(), remaps=()):
    """A node with settings like "pairing=keyframe", and a peer; both end in good order.

    Its subscriptions are reliable, so that no message is lost on a loaded machine, unless a setting says otherwise.
    """
    words = [
        word for setting in [*CHEAP, "image_qos=reliable", *settings] for word in ("-p", setting.replace("=", ":=", 1))
    ]
    words += [word for remap in remaps for word in ("-r", remap)]
    with (
        NodeProcess(["--ros-args", *words], domain.environment, tmp_path / "node.log") as node,
        Peer(domain) as peer,
    ):
        yield node, peer


class Rig:
    """Two cameras of a room pair, and the poses that come back."""

    def __init__(self, peer, pair=None, **how):
        self.peer = peer
        self.cameras = [Camera(peer, side, pair or room_pair(), **how) for side in ("source", "target")]
        self.poses = peer.collect(PoseStamped, f"{NODE}/pose")
        self.odometry = peer.collect(Odometry, f"{NODE}/odometry")
        self._stamp_ns = 1_700_000_000 * SECOND

    def ready(self):
        """The node hears every topic, and somebody hears the node."""
        for camera in self.cameras:
            self.peer.matched(*camera.publishers)
        self.peer.wait(lambda: self.peer.node.count_publishers(f"{NODE}/pose"), what="the node's publisher")
        return self

    def send(self, stamp_ns=None):
        """Publish a pair; returns its stamp and the two shots."""
        self._stamp_ns = self._stamp_ns + SECOND // 10 if stamp_ns is None else stamp_ns
        shots = [camera.shot(self._stamp_ns) for camera in self.cameras]
        for camera, shot in zip(self.cameras, shots, strict=True):
            camera.send(shot)
        return self._stamp_ns, shots

    def answers(self, stamp_ns):
        return [message for _, message in self.odometry if header_stamp_ns(message) == stamp_ns]

    def answer(self, seconds=PATIENCE_S):
        """Send pairs until one is answered; returns its shots, PoseStamped and Odometry.

        The first messages after a match may be lost, as on every graph; that is why pairs are sent again.
        """
        end, sent = time.monotonic() + seconds, {}
        while time.monotonic() < end:
            stamp_ns, shots = self.send()
            sent[stamp_ns] = shots
            again = time.monotonic() + 1.0
            while time.monotonic() < again:
                self.peer.spin(0.02)
                for _, odometry in self.odometry:
                    stamp_ns = header_stamp_ns(odometry)
                    poses = [m for _, m in self.poses if header_stamp_ns(m) == stamp_ns]
                    if stamp_ns in sent and poses:
                        return sent[stamp_ns], poses[0], odometry
        pytest.fail(f"no pose for any pair; diagnostics: {self.peer.diagnostics()}")


def offline(shots, settings=(), prior=None, preset="default"):
    config = changed_config(Config.preset(preset), [*CHEAP, *settings])
    views = [view_from_messages(shot.image, shot.camera_info, shot.depth)[0] for shot in shots]
    return estimate_relative_pose(*views, config, prior)


def assert_equal(message, estimate):
    T, covariance = pose_from_message(message)
    assert estimate.status is Status.CONVERGED
    np.testing.assert_allclose(T, estimate.T_target_source, atol=EQUAL)
    if covariance is not None:
        np.testing.assert_allclose(covariance, estimate.covariance, atol=EQUAL, rtol=EQUAL)


def values(peer, name):
    return peer.diagnostics().get(f"pose_node: {name}", (0, "", {}))[2]


def count(peer, name, key):
    return int(values(peer, name).get(key, 0))


def check(peer, name, text):
    """Wait until a status holds a text; return its level."""
    peer.wait(lambda: text in peer.diagnostics().get(f"pose_node: {name}", (0, "", {}))[1], what=f"{name}: {text!r}")
    return peer.diagnostics()[f"pose_node: {name}"][0]
