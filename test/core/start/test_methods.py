# SPDX-License-Identifier: Apache-2.0
"""A way to start of another distribution: it works by its name wherever one of this package does; and its errors."""

import csv
import inspect
import json
import os
import sys
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from distributions import write_distribution
from places import ROOT
from start_distribution import ASKED, FAILING, MISTAKEN, NAME, install_starts
from surfaces import FREE, disturbed

from garps_core import Config, ConfigError, Prior, Status, View, estimate_relative_pose, metrics
from garps_core.cli import command
from garps_core.cli.doctor import examine
from garps_core.config import start_methods
from garps_core.config.start import START_PLUGINS, STARTS, TWO_VIEW, installed_starts
from garps_core.errors import InitialisationError, WeightsError
from garps_core.geometry import se3_exp
from garps_core.plugins import load
from garps_core.start.identity_start import identity
from garps_core.start.initialise import initialise
from garps_core.start.methods import Find

pytest.importorskip("embreex")
from bench.rooms import RoomPair, make_pair

pytestmark = pytest.mark.usefixtures("one_thread")


def asking(name: str) -> Config:
    return Config().replace({"start.method": name})


@pytest.fixture(scope="module")
def room() -> RoomPair:
    return make_pair(1, 1, width=320, height=240, depth_noise="sensor")


@pytest.fixture(scope="module")
def views(room: RoomPair) -> tuple[View, View]:
    return View(room.rgb0, room.K0, room.depth0), View(room.rgb1, room.K1, room.depth1)


@pytest.fixture(scope="module")
def distribution(room: RoomPair, tmp_path_factory: pytest.TempPathFactory) -> Path:
    return install_starts(tmp_path_factory.mktemp("distribution"), room.T_1_0)


@pytest.fixture(autouse=True)
def asked(distribution: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """The distribution is installed; the file has a line for every call."""
    monkeypatch.syspath_prepend(str(distribution))
    yield distribution / ASKED
    (distribution / ASKED).unlink(missing_ok=True)
    sys.modules.pop("made_start", None)


def test_every_way_to_start_of_this_package_has_its_function() -> None:
    assert set(TWO_VIEW) < set(STARTS)
    for value in STARTS.values():
        module, name = value.split(":")
        find: Find = getattr(__import__(module, fromlist=[name]), name)
        assert list(inspect.signature(find).parameters) == ["source", "target", "config", "ask"]


def test_names_are_listed_without_an_import_and_none_of_this_package_is_taken() -> None:
    assert start_methods()[: len(STARTS) + 1] == ("auto", *STARTS)
    assert start_methods().count("features") == start_methods().count("auto") == 1, "the distribution offers them too"
    assert NAME in installed_starts() and not {"auto", "features", "given"} & set(installed_starts())
    assert "made_start" not in sys.modules
    with pytest.raises(ConfigError, match=rf"'nobody': expected one of auto, features, identity, .*, {NAME}"):
        asking("nobody")


def test_its_pose_is_the_start_under_its_name(room: RoomPair, views: tuple[View, View], asked: Path) -> None:
    found = estimate_relative_pose(*views, asking(NAME))
    assert found.status is Status.CONVERGED and found.initial is not None
    assert (found.initial.origin, found.initial.reason) == (NAME, "told")
    np.testing.assert_allclose(found.initial.T_target_source, room.T_1_0, atol=1e-12)
    assert metrics.translation_error_m(found.T_target_source, room.T_1_0) < 0.01
    assert asked.read_text() == f"True {NAME}\n"


def test_a_given_prior_is_combined_with_it_or_is_its_rival(room: RoomPair, views: tuple[View, View]) -> None:
    near = Prior(se3_exp(np.array([0.01, 0, 0, 0, 0.005, 0])) @ room.T_1_0, FREE)
    (alone,), (both,) = (initialise(*views, asking(NAME), prior) for prior in (None, near))
    assert both.origin == f"given and {NAME}" and both.reason.startswith("told, ")
    assert np.linalg.eigvalsh(alone.covariance - both.covariance)[0] > 0, "more certain in every direction"
    rivals = initialise(*views, asking(NAME), disturbed(room.T_1_0, [0.9, 0, 0, 0, 0, 0], 1e-2 * FREE))
    assert [start.origin for start in rivals] == [NAME, "given"]
    assert f"contradicts the {NAME}" in rivals[1].reason


@pytest.mark.parametrize("name", FAILING)
def test_one_that_finds_no_pose_is_a_status_with_its_reason(views: tuple[View, View], name: str) -> None:
    config = asking(name)
    with pytest.raises(InitialisationError, match=FAILING[name]):
        initialise(*views, config)
    found = estimate_relative_pose(*views, config, identity(config, "even with a prior"))
    assert (found.status, found.T_target_source) == (Status.NO_INITIAL_POSE, None)


@pytest.mark.parametrize("name", MISTAKEN)
def test_one_that_cannot_be_had_is_a_mistake_of_the_settings(views: tuple[View, View], name: str) -> None:
    with pytest.raises(ConfigError, match=MISTAKEN[name]):
        estimate_relative_pose(*views, asking(name))


def test_weights_that_it_lacks_are_a_mistake_of_the_settings(views: tuple[View, View]) -> None:
    with pytest.raises(WeightsError, match="no weights of the markers"):
        estimate_relative_pose(*views, asking("no_weights"))


def test_the_command_line_starts_with_it(
    room: RoomPair, views: tuple[View, View], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    words = ["align"]
    for side, view in zip("ab", views, strict=True):
        cv2.imwrite(str(tmp_path / f"{side}.png"), view.rgb[:, :, ::-1])
        np.save(tmp_path / f"{side}.npy", view.depth)
        words.append(str(tmp_path / f"{side}.png"))
    words += ["--K", *(str(room.K0[at]) for at in ((0, 0), (1, 1), (0, 2), (1, 2)))]
    words += ["--depth-source", str(tmp_path / "a.npy"), "--depth-target", str(tmp_path / "b.npy")]
    for way in (["--start", NAME], ["--set", f"start.method={NAME}"]):
        assert command.main([*words, *way, "--json"]) == 0
        assert json.loads(capsys.readouterr().out)["initial"]["origin"] == NAME
    assert command.main([*words, "--start", "not_there"]) == 2
    assert "the way to start 'not_there' (no_such_package:START of made_start 1.0)" in capsys.readouterr().err


def test_doctor_and_the_parameter_page_list_it() -> None:
    from garps_ros.parameters.docs import page

    rows = dict(examine()[0])
    assert rows[f"start {NAME}"] == "the pose of a file; installed by made_start 1.0"
    assert rows["start not_there"].startswith("the way to start 'not_there' (no_such_package:START of made_start 1.0)")
    (line,) = [line for line in page().split("\n") if line.startswith("| `start.method`")]
    assert f"`{NAME}`" in line


def test_a_recording_is_replayed_with_it(views: tuple[View, View], tmp_path: Path, asked: Path) -> None:
    from recordings import START, write
    from ros_messages import camera_info, image

    from garps_ros import replay

    messages = []
    for side, view in zip("ba", views, strict=True):  # the camera whose topics come first is the target
        head = {"stamp_ns": START, "frame_id": f"{side}_optical"}
        info = camera_info("rosbags", (320, 240), K=view.K, D=[0] * 5, model="plumb_bob", **head)
        messages.append((f"/{side}/camera_info", info))
        messages.append((f"/{side}/image_raw", image(view.rgb, "rgb8", "rosbags", **head)))
        messages.append((f"/{side}/depth/image_raw", image(view.depth, "32FC1", "rosbags", **head)))
    bag, out = write(tmp_path, "mcap", messages), tmp_path / "out"
    assert replay.main([str(bag), "--out", str(out), "--set", f"start.method={NAME}"]) == 0
    with (out / "poses.csv").open(encoding="utf-8") as file:
        (row,) = csv.DictReader(file)
    assert row["status"] == "converged" and asked.read_text() == f"True {NAME}\n"


def test_the_node_takes_the_parameter_and_loads_it_before_the_first_pair() -> None:
    from garps_ros.live.jobs import JobRunner
    from garps_ros.parameters.parameter import parameters, settings_from

    given = {parameter.name: parameter.default for parameter in parameters()}
    runner = JobRunner(lambda text: None)
    _, config = settings_from(given | {"start.method": "not_there"})
    with pytest.raises(ConfigError, match="cannot be imported; update or remove it"):
        runner.prepare(config)
    runner.prepare(settings_from(given | {"start.method": NAME})[1])
    assert "made_start" in sys.modules


def test_a_running_node_starts_with_it(request: pytest.FixtureRequest, tmp_path: Path) -> None:
    pytest.importorskip("rclpy")
    from graph import room_pair
    from node_rig import Rig, running

    from msg_adapters import pose_from_message

    pair, domain = room_pair(), request.getfixturevalue("domain")
    folder = install_starts(tmp_path / "installed", pair.T_1_0)
    path = os.pathsep.join([domain.environment["PYTHONPATH"], str(folder)])
    domain = replace(domain, environment={**domain.environment, "PYTHONPATH": path})
    with running(domain, tmp_path, [f"start.method={NAME}"]) as (_, peer):
        _, pose, _ = Rig(peer, pair).ready().answer()
    assert metrics.translation_error_m(pose_from_message(pose)[0], pair.T_1_0) < 0.03
    assert set((folder / ASKED).read_text().splitlines()) == {f"True {NAME}"}


SIDE_M = 0.4
"""Side of the marker in the example, with its white border half as wide again on every side."""


def marker_view(T_camera_world: np.ndarray, K: np.ndarray) -> View:
    """The marker on a wall 2 m away, in an image of 640x480."""
    aruco = cv2.aruco
    drawn = aruco.generateImageMarker(aruco.getPredefinedDictionary(aruco.DICT_4X4_50), 0, 600)
    drawn = cv2.copyMakeBorder(drawn, 100, 100, 100, 100, cv2.BORDER_CONSTANT, value=255)
    per_px = SIDE_M / 600
    on_wall = np.array([[per_px, 0, -399.5 * per_px], [0, per_px, -399.5 * per_px], [0, 0, 2.0], [0, 0, 1.0]])
    finer = np.array([[4, 0, 1.5], [0, 4, 1.5], [0, 0, 1]]) @ K
    grey = cv2.warpPerspective(drawn, finer @ (T_camera_world @ on_wall)[:3], (4 * 640, 4 * 480))
    grey = cv2.resize(grey, (640, 480), interpolation=cv2.INTER_AREA)
    return View(np.repeat(grey[..., None], 3, axis=2), K)


def test_the_documented_way_to_start_runs_as_it_stands(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    section = (ROOT / "docs" / "extending.md").read_text(encoding="utf-8").split("## A way to start\n")[1]
    code = section.split("```python\n")[1].split("\n```")[0]
    assert max(map(len, code.split("\n"))) <= 120 and 'my_markers = "my_robot.markers:START"' in section
    package = tmp_path / "my_robot"
    package.mkdir()
    (package / "__init__.py").touch()
    (package / "markers.py").write_text(code + "\n", encoding="utf-8")
    write_distribution(tmp_path, "my_robot", START_PLUGINS, {"my_markers": "my_robot.markers:START"})
    monkeypatch.syspath_prepend(str(tmp_path))
    config = Config().replace({"start.method": "my_markers"})
    K = np.array([[525, 0, 319.5], [0, 525, 239.5], [0, 0, 1]])
    truth = se3_exp(np.array([0.15, -0.05, 0.08, 0.03, 0.08, -0.02]))
    try:
        source, target = marker_view(np.eye(4), K), marker_view(truth, K)
        (start,) = initialise(source, target, config)
        assert load(START_PLUGINS, "my_markers", "way to start").description in dict(examine()[0])["start my_markers"]
        with pytest.raises(InitialisationError, match="the marker is not in"):
            initialise(source, View(np.zeros_like(target.rgb), K), config)
    finally:
        for module in ("my_robot", "my_robot.markers"):
            sys.modules.pop(module, None)
    assert start.origin == "my_markers"
    assert metrics.translation_error_m(start.T_target_source, truth) < 0.05
    assert metrics.nees(start.T_target_source, start.covariance, truth) < 12, "its covariance covers its error"
