# SPDX-License-Identifier: Apache-2.0
"""Expert settings reach the node by a settings file; old names and words of parameters work with a warning."""

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

pytest.importorskip("rclpy", reason="needs ROS 2")

import rclpy
from rcl_interfaces.srv import ListParameters
from rclpy.node import Node
from rclpy.parameter import Parameter

from garps_core.config import Config
from garps_core.config.renamed import warn_once
from garps_core.errors import ConfigError
from garps_ros.live.node_parameters import NodeParameters

MOST_PARAMETERS = 45
"""One screen of `ros2 param list`."""


@pytest.fixture(autouse=True)
def alone(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setenv("ROS_AUTOMATIC_DISCOVERY_RANGE", "OFF")
    monkeypatch.setenv("ROS_LOG_DIR", str(tmp_path))
    warn_once.cache_clear()


@contextmanager
def node_with(*overrides: str) -> Iterator[Node]:
    """A real node with parameters like "pairing:=keyframe"."""
    context = rclpy.Context()
    words = [word for override in overrides for word in ("-p", override)]
    rclpy.init(args=["--ros-args", *words] if words else [], context=context)
    node = Node("pose_node", context=context)
    try:
        yield node
    finally:
        node.destroy_node()
        rclpy.try_shutdown(context=context)


def written(folder: Path, text: str) -> str:
    file = folder / "settings.yaml"
    file.write_text(text, encoding="utf-8")
    return f"settings_file:={file}"


def test_the_file_gives_preset_and_settings_and_parameters_stand_above_it(tmp_path: Path) -> None:
    text = "preset: monocular\nalignment.tolerance: 0.1\nlifting: {stride: 5, max_range_m: 7}\n"
    with node_with(written(tmp_path, text), "lifting.stride:=3") as node:
        ours = NodeParameters(node, lambda: None)
        changes = {"alignment.tolerance": 0.1, "lifting.stride": 3, "lifting.max_range_m": 7.0}
        assert ours.config == Config.preset("monocular").replace(changes)
        assert ours.node.preset == node.get_parameter("preset").value == "monocular"
        assert node.get_parameter("lifting.max_range_m").value == 7.0
        assert node.set_parameters([Parameter("lifting.stride", value=6)])[0].successful
        assert ours.config == Config.preset("monocular").replace(changes | {"lifting.stride": 6})


def test_a_preset_among_the_parameters_stands_above_the_files(
    tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    with node_with(written(tmp_path, "preset: monocular\nseed: 4\n"), "preset:=stereo") as node:
        assert NodeParameters(node, lambda: None).config == Config.preset("stereo").replace({"seed": 4})
    assert "the preset is stereo, as asked for, and not monocular, which" in capfd.readouterr().err


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        (
            "alignment.tolerence: 0.1",
            "setting 'alignment.tolerence' does not exist; did you mean 'alignment.tolerance'",
        ),
        ("alignment.tolerance: 7", "alignment.tolerance is 7: expected between"),
        ("preset: best", "preset 'best' does not exist: expected one of default"),
        ("- 1", "holds list: expected lines like `lifting.stride: 4`"),
    ],
)
def test_a_mistake_in_the_file_is_one_line_that_names_it(tmp_path: Path, text: str, expected: str) -> None:
    with node_with(written(tmp_path, text)) as node, pytest.raises(ConfigError) as raised:
        NodeParameters(node, lambda: None)
    assert str(raised.value).startswith(f"settings_file: {tmp_path / 'settings.yaml'}")
    assert expected in str(raised.value) and "\n" not in str(raised.value)


@pytest.mark.parametrize(("text", "word"), [("true", "rectified"), ("false", "raw"), ("'true'", "rectified")])
def test_earlier_words_for_rectified_work_with_a_warning(
    text: str, word: str, capfd: pytest.CaptureFixture[str]
) -> None:
    with node_with(f"rectified:={text}") as node:
        assert NodeParameters(node, lambda: None).node.rectified == word
        assert node.get_parameter("rectified").value == word
    assert f"is now called rectified={word}" in capfd.readouterr().err


@pytest.mark.parametrize("value", [True, "true"])
def test_earlier_words_for_rectified_work_while_the_node_runs(value: object) -> None:
    with node_with() as node:
        ours = NodeParameters(node, lambda: None)
        assert node.set_parameters([Parameter("rectified", value=value)])[0].successful
        assert ours.node.rectified == node.get_parameter("rectified").value == "rectified"


def test_an_old_name_of_a_parameter_works(monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]) -> None:
    from garps_core.config import renamed

    monkeypatch.setattr(renamed, "RENAMED", (renamed.Renamed("lifting.step", "lifting.stride"),))
    with node_with("lifting.step:=7") as node:
        assert NodeParameters(node, lambda: None).config.lifting.stride == 7
        assert node.get_parameter("lifting.stride").value == 7
    assert "lifting.step is now called lifting.stride" in capfd.readouterr().err


def test_a_running_node_shows_one_screen_of_parameters(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    from graph import NodeProcess, Peer, private_domain

    monkeypatch.delenv("ROS_AUTOMATIC_DISCOVERY_RANGE")
    with (
        private_domain(tmp_path) as domain,
        NodeProcess([], domain.environment, tmp_path / "node.log"),
        Peer(domain) as peer,
    ):
        names = peer.call(ListParameters, "/pose_node/list_parameters", ListParameters.Request()).result.names
    assert {"preset", "settings_file", "lifting.stride", "use_sim_time"} <= set(names)
    assert len(names) <= MOST_PARAMETERS, sorted(names)
