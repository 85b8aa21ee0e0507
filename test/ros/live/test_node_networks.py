# SPDX-License-Identifier: Apache-2.0
"""The process pose_node with two plain cameras: a network is loaded before the first pair, or the start fails."""

import os
import signal
import time
from dataclasses import replace

import calm_network
import numpy as np
import pytest
from graph import NodeProcess, room_pair
from node_rig import Rig, assert_equal, check, offline, running, values
from places import ROOT
from point_map_cases import Errors, point_maps, true_views
from two_view_fixtures import RECORDED, installed_here, write_maps

from garps_core.geometry import se3_inverse, se3_log
from msg_adapters import pose_from_message

pytest.importorskip("rclpy")

NETWORK = [*calm_network.SETTINGS, "preset=monocular"]


def with_weights(domain, folder, **more):
    return replace(domain, environment={**domain.environment, "GARPS_WEIGHTS": str(folder), **more})


@pytest.fixture(scope="module")
def networked(domain, tmp_path_factory):
    return with_weights(domain, calm_network.install(tmp_path_factory.mktemp("weights")))


def words(*settings):
    return ["--ros-args", *(word for setting in settings for word in ("-p", setting.replace("=", ":=", 1)))]


def test_two_plain_images_give_the_offline_pose(networked, tmp_path, monkeypatch, one_thread):
    with running(networked, tmp_path, NETWORK) as (node, peer):
        peer.wait(lambda: "ready" in node.log(), what="the node to be ready")
        assert f"loaded depth_anything_v2 (weights {calm_network.NAME}) in " in node.log().split("ready")[0]
        shots, pose, odometry = Rig(peer, room_pair(), depth="").ready().answer()
        assert check(peer, "inputs", "all inputs arrive") == 0
        assert not {"source/depth", "target/depth"} & set(values(peer, "inputs"))
        assert [peer.node.count_subscribers(f"/{side}/depth") for side in ("source", "target")] == [0, 0]
        assert values(peer, "machine")["scale from"] == f"depth_anything_v2 (weights {calm_network.NAME}), m"
    monkeypatch.setenv("GARPS_WEIGHTS", networked.environment["GARPS_WEIGHTS"])
    estimate = offline(shots, calm_network.SETTINGS, preset="monocular")
    assert_equal(pose, estimate)
    assert_equal(odometry, estimate)


def test_the_network_in_the_package_runs_live(domain, tmp_path, one_thread):
    with running(domain, tmp_path, ["preset=demo_net"]) as (node, peer):
        peer.wait(lambda: "ready" in node.log(), what="the node to be ready")
        before = node.log().split("ready")[0]
        assert "loaded demo_net (a demonstration: " in before and "demo_net is a demonstration: " in before
        shots, pose, odometry = Rig(peer, room_pair(), depth="").ready().answer()
        assert check(peer, "inputs", "all inputs arrive") == 0
        assert values(peer, "machine")["scale from"].startswith("demo_net (a demonstration: ")
    estimate = offline(shots, [], preset="demo_net")
    assert_equal(pose, estimate)
    assert_equal(odometry, estimate)


def test_weights_that_are_missing_end_the_start(domain, tmp_path):
    empty = with_weights(domain, tmp_path)
    node = NodeProcess(words(*NETWORK), empty.environment, tmp_path / "node.log")
    assert node.wait() == 2, node.log()
    (line,) = [line for line in node.log().splitlines() if "error" in line]
    assert line.startswith("pose_node: error: no depth_anything weights in ")
    assert line.endswith(f"run `garps weights fetch {calm_network.NAME}`")
    assert "Traceback" not in node.log() and "ready" not in node.log()


def test_a_signal_while_it_loads_and_compiles(networked, tmp_path):
    pytest.importorskip("numba")
    cold = with_weights(networked, networked.environment["GARPS_WEIGHTS"], NUMBA_CACHE_DIR=str(tmp_path))
    with NodeProcess(words(*NETWORK), cold.environment, tmp_path / "node.log") as node:
        node.wait_for("loaded")
        time.sleep(0.3)
        node.signal(signal.SIGINT)
        assert node.wait() == 0
        assert "ready" not in node.log()


TWO_VIEW = ["reconstruction.method=two_view", "start.method=adapter"]


def with_adapters(domain, folder):
    """Return a domain whose environment has a package with adapters, next to the tests' own modules."""
    paths = [domain.environment["PYTHONPATH"], str(ROOT / "test" / "tools"), str(installed_here(folder))]
    return replace(domain, environment={**domain.environment, "PYTHONPATH": os.pathsep.join(paths)})


def test_an_adapter_gives_pose_and_depth_of_two_plain_images(domain, tmp_path, monkeypatch, one_thread):
    pair = room_pair()
    maps = point_maps(true_views(pair), pair.T_1_0, Errors(noise=0.005, patches=0.005, scale=0.03), seed=1)
    file = write_maps(tmp_path / "room.npz", (pair.rgb0, pair.rgb1, maps))
    settings = [*TWO_VIEW, f"start.adapter={RECORDED}", f"start.weights={file}"]
    adapting = with_adapters(domain, tmp_path / "installed")
    with running(adapting, tmp_path, ["preset=monocular", *settings]) as (node, peer):
        peer.wait(lambda: "ready" in node.log(), what="the node to be ready")
        assert f"loaded adapter {RECORDED} in " in node.log().split("ready")[0]
        shots, pose, odometry = Rig(peer, pair, depth="").ready().answer()
        assert check(peer, "inputs", "all inputs arrive") == 0
        assert values(peer, "machine")["scale from"] == f"adapter {RECORDED} of every pair, m"
        assert [peer.node.count_subscribers(f"/{side}/depth") for side in ("source", "target")] == [0, 0]
    off = se3_log(pose_from_message(pose)[0] @ se3_inverse(pair.T_1_0))
    assert np.linalg.norm(off[:3]) < 0.03 and np.degrees(np.linalg.norm(off[3:])) < 1
    monkeypatch.syspath_prepend(str(tmp_path / "installed"))
    estimate = offline(shots, settings, preset="monocular")
    assert_equal(pose, estimate)
    assert_equal(odometry, estimate)


def test_an_adapter_that_is_not_installed_ends_the_start(domain, tmp_path):
    node = NodeProcess(
        words("preset=monocular", *TWO_VIEW, "start.adapter=my_model"), domain.environment, tmp_path / "node.log"
    )
    assert node.wait() == 2, node.log()
    (line,) = [line for line in node.log().splitlines() if "error" in line]
    assert line.startswith("pose_node: error: start.adapter is 'my_model': expected the name of an installed adapter")
    assert "Traceback" not in node.log() and "ready" not in node.log()


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        (["preset=mast3r"], "run `garps weights fetch mast3r`"),
        (["preset=mast3r", "start.method=dust3r"], "the points of dust3r have no metres: expected mast3r"),
        (["preset=mast3r", "start.method=auto"], "expected a two-view network to start with, one of mast3r"),
    ],
)
def test_two_view_settings_that_cannot_be_end_the_start(domain, tmp_path, settings, message):
    node = NodeProcess(words(*settings), with_weights(domain, tmp_path).environment, tmp_path / "node.log")
    assert node.wait() == 2, node.log()
    assert message in node.log()
    assert "Traceback" not in node.log() and "ready" not in node.log()
