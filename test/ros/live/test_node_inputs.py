# SPDX-License-Identifier: Apache-2.0
"""The checks of a running node on its inputs: missing, lost, of another type or QoS, never together; and time."""

import re

import numpy as np
import pytest
from graph import SECOND
from node_rig import Rig, check, running, values
from ros_messages import image

pytest.importorskip("rclpy")
from rosgraph_msgs.msg import Clock
from sensor_msgs.msg import PointCloud2


def test_with_simulated_time_and_a_recording_that_begins_again(domain, tmp_path):
    with running(domain, tmp_path, ["use_sim_time=true"]) as (node, peer):
        rig = Rig(peer).ready()
        clock = peer.publisher(Clock, "/clock")
        peer.matched(clock)
        assert check(peer, "inputs", "nothing has come on /clock") == 2
        start = 1_000 * SECOND

        def play(seconds):
            tick = Clock()
            tick.clock.sec, tick.clock.nanosec = divmod(start + round(seconds * SECOND), SECOND)
            clock.publish(tick)
            rig.send(start + round(seconds * SECOND))
            peer.spin(0.4)

        for step in range(6):
            play(step)
        peer.wait(lambda: rig.answers(start + 5 * SECOND), what="a pose while the clock runs")
        assert "anew" not in node.log()
        rig.odometry.clear()
        for step in range(4):
            play(step + 0.5)
        peer.wait(lambda: rig.answers(start + round(3.5 * SECOND)), what="a pose after the jump back")
        assert re.search(r"(went back|time went back) by .*starting anew", node.log())
        peer.wait(lambda: "went back" in values(peer, "estimates")["began anew"], what="the restart in the diagnostics")


def test_wrong_qos_and_wrong_type_are_named(domain, tmp_path):
    with running(domain, tmp_path, ["image_qos=reliable"]) as (node, peer):
        Rig(peer, reliable=False)
        assert check(peer, "inputs", "peer offers BEST_EFFORT, image_qos asks for RELIABLE") == 2
        text = "offers less RELIABILITY than image_qos:=reliable asks"
        peer.wait(lambda: text in node.log(), what="the event's line in the log")
    with running(domain, tmp_path) as (_, peer):
        peer.publisher(PointCloud2, "source/image")
        peer.publisher(PointCloud2, "source/depth")
        assert check(peer, "inputs", "peer publishes sensor_msgs/msg/PointCloud2, expected sensor_msgs/msg/Image") == 2


@pytest.mark.parametrize("offered", ["RELIABLE", "BEST_EFFORT"])
def test_images_that_get_lost_are_asked_for_reliably_where_that_is_offered(domain, tmp_path, offered):
    from sensor_msgs.msg import Image

    with running(domain, tmp_path, ["image_qos=auto"]) as (_, peer):
        images = peer.publisher(Image, "source/image", reliable=offered == "RELIABLE")
        peer.matched(images)
        kept = [step for step in range(120) if np.random.default_rng(step).random() < 0.4]
        for step in kept:
            stamp_ns = 1_700_000_000 * SECOND + step * SECOND // 30
            images.publish(image(np.zeros((8, 8, 3), np.uint8), "rgb8", "rclpy", stamp_ns=stamp_ns))
            peer.spin(0.03)
        peer.wait(lambda: offered in values(peer, "inputs").get("source/image", ""), what=offered)
        peer.spin(1.2)
        assert offered in values(peer, "inputs")["source/image"]


def test_missing_inputs_are_named(domain, tmp_path):
    with running(domain, tmp_path, ["input_timeout=1.0"], ["source/depth:=/front/depth"]) as (_, peer):
        rig = Rig(peer)
        for camera in rig.cameras:
            peer.matched(camera.image)
        for _ in range(15):
            rig.send()
            peer.spin(0.1)
        assert check(peer, "inputs", "nothing received yet: source/depth (/front/depth, 0 publisher(s))") == 2
        check(peer, "inputs", "silent: ")


def test_images_that_never_belong_together_are_explained(domain, tmp_path):
    with running(domain, tmp_path, ["input_timeout=0.5"]) as (_, peer):
        rig = Rig(peer).ready()
        start = 1_700_000_000 * SECOND
        for step in range(40):
            rig.cameras[0].publish(start + step * SECOND // 10)
            rig.cameras[1].publish(start + step * SECOND // 10 + SECOND // 20)
            peer.spin(0.1)
        text = "none belong together within sync_slop = 0.02 s"
        assert any(text in message for _, message, _ in peer.diagnostics().values()), peer.diagnostics()
