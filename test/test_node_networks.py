# SPDX-License-Identifier: Apache-2.0
"""pose_node with two plain cameras: a network gives depth, and is there before the first pair; or the start ends."""

import signal
import time
from dataclasses import replace

import calm_network
import pytest
import torch
from graph import NodeProcess, room_pair
from node_rig import Rig, assert_equal, finding, offline, running, values

pytest.importorskip("rclpy")

NETWORK = [*calm_network.SETTINGS, "preset=monocular"]


def with_weights(domain, folder, **more):
    return replace(domain, environment={**domain.environment, "GARPS_WEIGHTS": str(folder), **more})


@pytest.fixture(scope="module")
def networked(domain, tmp_path_factory):
    return with_weights(domain, calm_network.install(tmp_path_factory.mktemp("weights")))


@pytest.fixture
def one_thread():
    before = torch.get_num_threads()
    torch.set_num_threads(1)  # as the node: sums in the same order
    yield
    torch.set_num_threads(before)


def words(*settings):
    return ["--ros-args", *(word for setting in settings for word in ("-p", setting.replace("=", ":=", 1)))]


def test_two_plain_images_give_the_offline_pose(networked, tmp_path, monkeypatch, one_thread):
    with running(networked, tmp_path, NETWORK) as (node, peer):
        peer.wait(lambda: "ready" in node.log(), what="the node to be ready")
        assert f"loaded depth_anything_v2 (weights {calm_network.NAME}) in " in node.log().split("ready")[0]
        shots, pose, odometry = Rig(peer, room_pair(), depth="").ready().answer(60)
        assert finding(peer, "inputs", "all inputs arrive") == 0
        assert not {"source/depth", "target/depth"} & set(values(peer, "inputs"))
        assert [peer.node.count_subscribers(f"/{side}/depth") for side in ("source", "target")] == [0, 0]
        assert values(peer, "machine")["scale from"] == f"depth_anything_v2 (weights {calm_network.NAME}), m"
    monkeypatch.setenv("GARPS_WEIGHTS", networked.environment["GARPS_WEIGHTS"])
    estimate = offline(shots, calm_network.SETTINGS, preset="monocular")
    assert_equal(pose, estimate)
    assert_equal(odometry, estimate)


def test_weights_that_are_missing_end_the_start(domain, tmp_path):
    empty = with_weights(domain, tmp_path)
    node = NodeProcess(words(*NETWORK), empty.environment, tmp_path / "node.log")
    assert node.wait(30) == 2, node.log()
    (line,) = [line for line in node.log().splitlines() if "error" in line]
    assert line.startswith("pose_node: error: no depth_anything weights in ")
    assert line.endswith(f"run `garps weights fetch {calm_network.NAME}`")
    assert "Traceback" not in node.log() and "ready" not in node.log()


def test_a_signal_while_it_loads_and_compiles(networked, tmp_path):
    pytest.importorskip("numba")
    cold = with_weights(networked, networked.environment["GARPS_WEIGHTS"], NUMBA_CACHE_DIR=str(tmp_path))
    with NodeProcess(words(*NETWORK), cold.environment, tmp_path / "node.log") as node:
        end = time.monotonic() + 30
        while "loaded" not in node.log():
            assert time.monotonic() < end, node.log()
            time.sleep(0.05)
        time.sleep(0.3)
        node.signal(signal.SIGINT)
        assert node.wait(5.0) == 0
        assert "ready" not in node.log()
