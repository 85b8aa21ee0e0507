# SPDX-License-Identifier: Apache-2.0
"""A depth network of another distribution: it works by its name wherever one of this package does; and its errors."""

import csv
import json
import sys
from collections.abc import Iterator
from pathlib import Path

import cv2
import numpy as np
import pytest
from depth_distribution import FAILING, NAME, install_depth_networks, write_depths
from distributions import write_distribution
from places import ROOT

from garps_core import Config, ConfigError, Status, View, estimate_relative_pose, metrics
from garps_core.cli import command
from garps_core.cli.doctor import examine
from garps_core.config import depth_networks, methods
from garps_core.config.reconstruction import DEPTH_NETWORKS, DEPTH_PLUGINS
from garps_core.errors import WeightsError
from garps_core.mixtures.reconstruct import with_depth
from garps_core.models.demo_net import DemoNet
from garps_core.models.depth_networks import DEFAULT, depth_network, preset_for
from garps_core.models.in_use import Networks

pytest.importorskip("embreex")
from bench.rooms import RoomPair, make_pair

pytestmark = pytest.mark.usefixtures("one_thread")
Captured = pytest.CaptureFixture[str]


@pytest.fixture(scope="module")
def room() -> RoomPair:
    return make_pair(3, 2, 1.0, 320, 240, depth_noise="sensor")


@pytest.fixture(scope="module")
def depths(room: RoomPair, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("depths")
    return write_depths(folder / "room.npz", (room.rgb0, room.depth0), (room.rgb1, room.depth1))


@pytest.fixture(scope="module")
def distribution(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return install_depth_networks(tmp_path_factory.mktemp("distribution"))


@pytest.fixture(autouse=True)
def installed(distribution: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    monkeypatch.syspath_prepend(str(distribution))
    yield
    sys.modules.pop("made_depth", None)


def asked(name: str, weights: Path | str = "") -> Config:
    changes = {"reconstruction.method": name, "reconstruction.depth_weights": str(weights)}
    return Config.preset("monocular").replace(changes)


def bare(room: RoomPair) -> tuple[View, View]:
    return View(room.rgb0, room.K0), View(room.rgb1, room.K1)


def written(room: RoomPair, folder: Path) -> list[str]:
    """Words for `garps align` of both images."""
    paths = [str(folder / f"{name}.png") for name in "ab"]
    for path, rgb in zip(paths, (room.rgb0, room.rgb1), strict=True):
        cv2.imwrite(path, rgb[:, :, ::-1])
    numbers = [[str(K[at]) for at in ((0, 0), (1, 1), (0, 2), (1, 2))] for K in (room.K0, room.K1)]
    return ["align", *paths, "--K", *numbers[0], "--K-target", *numbers[1]]


def test_its_depth_is_what_it_says_times_the_scale(room: RoomPair, depths: Path) -> None:
    found = with_depth(bare(room), asked(NAME, depths).replace({"reconstruction.depth_scale": 1.5}))
    np.testing.assert_array_equal(found[0].depth, np.float32(1.5) * room.depth0, "0 is unknown")
    np.testing.assert_array_equal(found[1].depth, np.float32(1.5) * room.depth1, "0 is unknown")


def test_it_is_loaded_once_for_every_weights(room: RoomPair, depths: Path) -> None:
    networks = Networks()
    first = networks.depth_network(asked(NAME, depths))
    assert networks.depth_network(asked(NAME, depths)) is first
    assert networks.depth_network(asked(NAME, depths.parent / "." / "room.npz")) is first
    with pytest.raises(WeightsError, match=r"reconstruction\.depth_weights is empty"):
        networks.depth_network(asked(NAME))


def test_two_images_give_a_pose_on_the_command_line(
    room: RoomPair, depths: Path, tmp_path: Path, capsys: Captured
) -> None:
    words = [*written(room, tmp_path), "--reconstruction", NAME, "--set", f"reconstruction.depth_weights={depths}"]
    assert command.main([*words, "--json"]) == 0
    found = json.loads(capsys.readouterr().out)
    assert found["depth_from"] == NAME
    assert metrics.translation_error_m(np.array(found["T_target_source"]), room.T_1_0) < 0.02
    assert command.main(words) == 0
    assert f"depth        by {NAME}" in capsys.readouterr().out


def test_it_has_a_preset_a_line_of_doctor_and_a_place_on_the_parameter_page() -> None:
    from garps_ros.parameters.docs import page

    assert NAME in depth_networks() and NAME in methods()
    assert preset_for(NAME, True) == preset_for(NAME, False) == "monocular"
    rows = dict(examine()[0])
    assert rows[NAME] == "the depth of a file; installed by made_depth 1.0"
    assert rows["not_there"].startswith(
        "the depth network 'not_there' (no_such_package:NETWORK of made_depth 1.0) cann"
    )
    (line,) = [line for line in page().split("\n") if line.startswith("| `reconstruction.method`")]
    assert f"`{NAME}`" in line


def test_a_recording_is_replayed_with_it(room: RoomPair, depths: Path, tmp_path: Path) -> None:
    from recordings import START, write
    from ros_messages import camera_info, image

    from garps_ros import replay

    messages = []
    for side, rgb, K in (("source", room.rgb0, room.K0), ("target", room.rgb1, room.K1)):
        head = {"stamp_ns": START, "frame_id": f"{side}_optical"}
        messages.append((f"/{side}/image", image(rgb, "rgb8", "rosbags", **head)))
        info = camera_info("rosbags", (320, 240), K=K, D=[0] * 5, model="plumb_bob", **head)
        messages.append((f"/{side}/camera_info", info))
    bag, out = write(tmp_path, "mcap", messages), tmp_path / "out"
    words = ["--out", str(out), "--set", f"reconstruction.depth_weights={depths}"]
    assert replay.main([str(bag), *words, "--reconstruction", NAME]) == 0
    with (out / "poses.csv").open(encoding="utf-8") as file:
        (row,) = csv.DictReader(file)
    assert row["status"] == "converged"


def test_the_node_takes_the_parameter_loads_it_and_names_it(depths: Path) -> None:
    from garps_ros.live.jobs import JobRunner
    from garps_ros.parameters.parameter import parameters, settings_from

    given = {parameter.name: parameter.default for parameter in parameters("monocular")}
    given |= {"preset": "monocular", "reconstruction.method": NAME, "reconstruction.depth_weights": str(depths)}
    _, config = settings_from(given)
    said: list[str] = []
    runner = JobRunner(said.append)
    runner.prepare(config)
    assert runner.scale == f"{NAME} (weights {depths}), m", "what /diagnostics shows as `scale from`"
    assert said[0].startswith(f"loaded {NAME} (weights {depths}) in ")


@pytest.mark.parametrize(("name", "said"), FAILING.items(), ids=FAILING)
def test_what_goes_wrong_in_it_is_a_status_with_its_name(room: RoomPair, name: str, said: str) -> None:
    found = estimate_relative_pose(*bare(room), asked(name))
    assert (found.status, found.T_target_source) == (Status.NO_MIXTURE, None)
    assert f"depth network '{name}' (made_depth:{name} of made_depth 1.0) {said}" in found.reason


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("not_there", r"of made_depth 1\.0\) cannot be imported; update or remove it: ModuleNotFoundError: No module"),
        ("unloadable", r"of made_depth 1\.0\) cannot be loaded; see its documentation: ZeroDivisionError"),
        ("no_entry", r"of made_depth 1\.0\) is an object of class int: expected a DepthNetwork.*docs/extending\.md"),
    ],
)
def test_one_that_cannot_be_had_is_a_mistake_of_the_settings(room: RoomPair, name: str, message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        estimate_relative_pose(*bare(room), asked(name))


def test_a_name_that_is_not_installed_lists_those_that_are() -> None:
    with pytest.raises(ConfigError, match=rf"'nobody': expected one of auto, rgbd, depth_any.*, {NAME}, .*, ply$"):
        asked("nobody")


def test_nobody_can_take_a_name_of_this_package() -> None:
    """The distribution tries to: it offers a `demo_net`."""
    assert depth_networks().count("demo_net") == 1
    assert isinstance(Networks().depth_network(Config.preset("demo_net")), DemoNet)


def test_every_network_of_this_package_has_its_entry() -> None:
    assert DEFAULT in DEPTH_NETWORKS
    for name in DEPTH_NETWORKS:
        assert depth_network(name).preset in ("monocular", name)
        assert Config.preset(depth_network(name).preset).alignment.depth_errors


WALL = '''
"""A wall two metres ahead, bent by what the pictures show."""
import torch


class Wall(torch.nn.Conv2d):
    def forward(self, pictures):
        return 2 + super().forward(pictures)[:, 0]


def load_network(weights):
    torch.manual_seed(2)
    return Wall(3, 1, 5, padding=2).eval()
'''


def test_the_documented_network_runs_as_it_stands(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, room: RoomPair, capsys: Captured
) -> None:
    section = (ROOT / "docs" / "extending.md").read_text(encoding="utf-8").split("## A depth network\n")[1]
    code = section.split("```python\n")[1].split("\n```")[0]
    assert max(map(len, code.split("\n"))) <= 120 and 'my_depth = "my_robot.depth:NETWORK"' in section
    package = tmp_path / "my_robot"
    package.mkdir()
    (package / "__init__.py").touch()
    (package / "depth.py").write_text(code + "\n", encoding="utf-8")
    (package / "depth_network.py").write_text(WALL, encoding="utf-8")
    write_distribution(tmp_path, "my_robot", DEPTH_PLUGINS, {"my_depth": "my_robot.depth:NETWORK"})
    monkeypatch.syspath_prepend(str(tmp_path))
    try:
        code_of_exit = command.main([*written(room, tmp_path), "--reconstruction", "my_depth", "--json"])
    finally:
        for module in ("my_robot", "my_robot.depth", "my_robot.depth_network"):
            sys.modules.pop(module, None)
    found = json.loads(capsys.readouterr().out)
    assert code_of_exit in (0, 1) and found["depth_from"] == "my_depth" and found["seconds"]["depth"] > 0
