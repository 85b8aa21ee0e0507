# SPDX-License-Identifier: Apache-2.0
"""garps-replay of one camera without depth, by an installed two-view adapter."""

import csv

import numpy as np
import pytest
from point_map_cases import Errors, point_maps, true_views
from recordings import PERIOD, START, write
from ros_messages import camera_info, image
from scipy.spatial.transform import Rotation
from two_view_fixtures import CALLS, RECORDED, installed_here, write_maps

from bench.rooms import make_pair
from garps_core.geometry import se3_inverse, se3_log
from garps_ros import replay

SIZE = (320, 240)


@pytest.fixture(scope="module")
def pair():
    return make_pair(1, 1, width=SIZE[0], height=SIZE[1])


def walked(folder, pair, order):
    """A recording of the pair's pictures in some order, by a camera without depth."""
    seen = {0: (pair.rgb0, pair.K0), 1: (pair.rgb1, pair.K1)}
    messages = []
    for i, which in enumerate(order):
        head = {"stamp_ns": START + i * PERIOD, "frame_id": "cam_optical"}
        rgb, K = seen[which]
        messages.append(("/cam/camera_info", camera_info("rosbags", SIZE, K=K, D=[0] * 5, model="plumb_bob", **head)))
        messages.append(("/cam/image_raw", image(rgb, "rgb8", "rosbags", **head)))
    return write(folder, "mcap", messages)


def run(bag, folder, file, *more):
    words = ["--preset", "monocular", "--reconstruction", "two_view", "--set", "start.method=adapter"]
    words += ["--set", f"start.adapter={RECORDED}", "--set", f"start.weights={file}"]
    code = replay.main([str(bag), "--out", str(folder / "out"), *words, *more])
    with (folder / "out" / "poses.csv").open(encoding="utf-8") as table:
        return code, list(csv.DictReader(table))


def test_a_camera_without_depth_is_followed_by_an_adapter(tmp_path, monkeypatch, pair, capfd):
    """A first view begins without depth, and gets it with the second; an unknown pair is a row with its reason."""
    monkeypatch.syspath_prepend(str(installed_here(tmp_path / "installed")))
    maps = point_maps(true_views(pair), pair.T_1_0, Errors(noise=0.005, patches=0.005, scale=0.03), seed=1)
    file = write_maps(tmp_path / "room.npz", (pair.rgb0, pair.rgb1, maps))
    CALLS.clear()
    code, rows = run(walked(tmp_path, pair, (1, 0, 1, 0)), tmp_path, file)
    assert code == 0
    assert f"loaded adapter {RECORDED} in " in capfd.readouterr().err
    by_status = [(row["status"], (int(row["source_stamp_ns"]) - START) // PERIOD) for row in rows]
    assert [found for found in by_status if found[0] == "converged"] == [("converged", 1), ("converged", 3)]
    (lost,) = {row["reason"] for row in rows if row["status"] != "converged"}
    assert "the adapter 'recorded' failed (LookupError: two pictures it has never seen)" in lost
    path = np.loadtxt(tmp_path / "out" / "trajectory.tum")
    np.testing.assert_allclose(path[0, 1:], [0, 0, 0, 0, 0, 0, 1], atol=1e-12)
    for x, y, z, *quaternion in (path[1, 1:], path[2, 1:]):
        T = np.eye(4)
        T[:3, :3], T[:3, 3] = Rotation.from_quat(quaternion).as_matrix(), (x, y, z)
        off = se3_log(T @ se3_inverse(pair.T_1_0))
        assert np.linalg.norm(off[:3]) < 0.03 and np.degrees(np.linalg.norm(off[3:])) < 1
