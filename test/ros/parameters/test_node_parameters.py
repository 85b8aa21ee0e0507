# SPDX-License-Identifier: Apache-2.0
"""The parameters on a real node: declared, refused with a reason, applied as one; mistakes at the start are errors."""

import dataclasses
import re
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest
from places import ROOT

pytest.importorskip("rclpy", reason="needs ROS 2")

import rclpy
import yaml
from rcl_interfaces.msg import ParameterDescriptor, SetParametersResult
from rclpy.node import Node
from rclpy.parameter import Parameter

from garps_core.config import Config
from garps_core.errors import ConfigError
from garps_ros.live.node_parameters import NodeParameters
from garps_ros.parameters.parameter import parameters
from garps_ros.parameters.settings import NodeSettings

TYPES = {bool: Parameter.Type.BOOL, int: Parameter.Type.INTEGER, float: Parameter.Type.DOUBLE}
ALL = parameters()


@pytest.fixture(autouse=True)
def alone(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """Nothing here talks to another process."""
    monkeypatch.setenv("ROS_AUTOMATIC_DISCOVERY_RANGE", "OFF")
    monkeypatch.setenv("ROS_LOG_DIR", str(tmp_path))


@contextmanager
def ros_node(*arguments: str) -> Iterator[Node]:
    """A real node as `--ros-args arguments` would start it."""
    context = rclpy.Context()
    rclpy.init(args=["--ros-args", *arguments] if arguments else [], context=context)
    node = Node("pose_node", context=context)
    try:
        yield node
    finally:
        node.destroy_node()
        rclpy.try_shutdown(context=context)


class Live:
    """A node with our parameters and a count of what it was told."""

    def __init__(self, node: Node) -> None:
        self.node, self.changes = node, 0
        self.parameters = NodeParameters(node, self.count)

    def count(self) -> None:
        self.changes += 1

    def set(self, **values: object) -> SetParametersResult:
        changes = [Parameter(name.replace("__", "."), value=value) for name, value in values.items()]
        return self.node.set_parameters_atomically(changes)


@pytest.fixture
def live() -> Iterator[Live]:
    with ros_node() as node:
        yield Live(node)


def given(*overrides: str) -> tuple[str, ...]:
    return tuple(word for override in overrides for word in ("-p", override))


def test_every_parameter_is_declared_with_type_meaning_and_range(live: Live) -> None:
    for ours in ALL:
        described: ParameterDescriptor = live.node.describe_parameter(ours.name)
        assert live.node.get_parameter(ours.name).value == ours.default
        assert described.type == TYPES.get(type(ours.default), Parameter.Type.STRING).value, ours.name
        assert described.description.startswith(ours.doc) and ours.unit in described.description
        assert described.read_only is not ours.live and not described.dynamic_typing
        assert described.additional_constraints == ("one of: " + ", ".join(ours.choices) if ours.choices else "")
        ranges = [*described.integer_range, *described.floating_point_range]
        assert [(r.from_value, r.to_value) for r in ranges] == ([] if ours.low is None else [(ours.low, ours.high)]), (
            ours.name
        )
        assert len(described.integer_range) == (type(ours.default) is int)


def test_the_description_names_unit_and_choices(live: Live) -> None:
    texts = {name: live.node.describe_parameter(name).description for name in ("sync_slop", "pairing", "lazy")}
    assert texts["sync_slop"].endswith("equal stamps always pair (unit: s)")
    assert texts["pairing"].endswith("against its keyframe (one of: cameras, keyframe)")
    assert "(" not in texts["lazy"]


def test_the_defaults_are_the_settings(live: Live) -> None:
    assert live.parameters.node == NodeSettings() and live.parameters.config == Config()
    assert live.changes == 0


def test_a_preset_moves_the_defaults_and_single_values_stand_above_it() -> None:
    with ros_node(*given("preset:=monocular", "lifting.stride:=4")) as node:
        live = Live(node)
        assert live.parameters.config == Config.preset("monocular").replace({"lifting.stride": 4})
        assert node.get_parameter("lifting.scale_sigma").value == Config.preset("monocular").lifting.scale_sigma
        assert live.set(lifting__stride=5).successful
        assert live.parameters.config.alignment.ladder == Config.preset("monocular").alignment.ladder


def test_an_atomic_change_is_told_once(live: Live) -> None:
    assert live.set(lifting__stride=4, sync_slop=0.1, max_rate=2.0).successful
    assert live.changes == 1
    assert live.parameters.config.lifting.stride == 4
    assert (live.parameters.node.sync_slop, live.parameters.node.max_rate) == (0.1, 2.0)
    assert live.set(lifting__stride=4).successful  # the same again
    assert live.changes == 1
    assert live.set(lifting__stride=3).successful
    assert live.changes == 2


def test_another_parameter_of_the_node_is_none_of_ours(live: Live) -> None:
    live.node.declare_parameter("other", 1)
    assert live.set(other=2).successful
    assert live.set(use_sim_time=True).successful
    assert live.changes == 0


REFUSED = {
    "range": ({"lifting__stride": 0}, "lifting.stride out of range"),
    "real range": ({"sync_slop": 11.0}, "sync_slop out of range"),
    "not a number": ({"sync_slop": float("nan")}, "sync_slop"),
    "type": ({"sync_slop": 1}, "Wrong parameter type"),
    "choice": ({"rectified": "maybe"}, "rectified is 'maybe': expected one of auto, rectified, raw"),
    "device": ({"device": "tpu"}, "device is 'tpu', which is not there: expected one of cpu"),
    "no device": ({"device": "quantum"}, "device is 'quantum', which is not there"),
    "one of two": ({"lifting__stride": 4, "rectified": "maybe"}, "rectified is 'maybe': expected one of auto"),
} | {p.name: ({p.name: p.default}, f"read-only parameter: {p.name}") for p in ALL if not p.live}


@pytest.mark.parametrize(("values", "reason"), REFUSED.values(), ids=REFUSED)
def test_a_wrong_change_is_refused_with_its_reason(live: Live, values: dict[str, object], reason: str) -> None:
    result = live.set(**values)
    assert not result.successful and reason in result.reason
    assert live.changes == 0
    assert live.parameters.node == NodeSettings() and live.parameters.config == Config()
    assert live.node.get_parameter("lifting.stride").value == Config().lifting.stride


def test_what_a_network_needs_stays() -> None:
    with ros_node(*given("preset:=monocular", "reconstruction.method:=flash3d")) as node:
        live = Live(node)
        assert not live.set(device="tpu").successful
        assert live.set(reconstruction__depth_scale=1.1).successful and live.changes == 1


def test_what_another_callback_refuses_is_not_applied(live: Live) -> None:
    """Validation must not change anything: a later callback may still refuse."""

    def refuse(_: object) -> SetParametersResult:
        return SetParametersResult(successful=False, reason="no")

    live.node._on_set_parameters_callbacks.append(refuse)
    assert live.set(lifting__stride=4).reason == "no"
    assert live.changes == 0 and live.parameters.config == Config()


MISTAKES = {
    "lifting.noise_linear:=1": "lifting.noise_linear is 1 (integer): expected a double. Write 1.0",
    "sync_slop:=0": "sync_slop is 0 (integer): expected a double. Write 0.0",
    "lifting.stride:=4.0": "lifting.stride is 4.0 (double): expected an integer. Write 4",
    "lifting.stride:=4.5": "lifting.stride is 4.5 (double): expected an integer, for example 2",
    "lifting.stride:=[1, 2]": "lifting.stride is [1, 2] (integer array): expected an integer, for example 2",
    "lazy:=1": "lazy is 1 (integer): expected a bool, for example true",
    "alignment.tolerance:=0.1": "'alignment.tolerance' is an expert setting and no parameter of the node. Write `align",
    "dtype:=float64": "'dtype' is an expert setting and no parameter of the node. Write `dtype: \"float64\"`",
    "alignment.information:=5.0": "'alignment.effective_measurements' is an expert setting and no parameter",
    "settings_file:=/missing.yaml": "settings_file: cannot read settings from /missing.yaml: No such file or directory",
    "source_frame:=5": """source_frame is 5 (integer): expected a string. Write "5" in a file, '"5"' in a shell""",
    "preset:=1": "preset is 1 (integer): expected a string",
    "preset:=best": "preset is 'best': expected one of default, sensor, time_of_flight",
    "pairing:=both": "pairing is 'both': expected one of cameras, keyframe",
    "sync_slop:=11.0": "sync_slop is 11.0: expected between 0 and 10 s",
    "device:=tpu": "device is 'tpu', which is not there",
    "reconstruction.method:=ply": "reconstruction.method is ply, mixtures from files: expected auto, rgbd or a network",
    "reconstruction.method:=depth_anything_v2": "reconstruction.method is depth_anything_v2, whose depth is off by",
    "reconstruction.metod:=rgbd": "parameter 'reconstruction.metod' does not exist; did you mean 'reconstruction.meth",
    "lifting.strid:=4": "parameter 'lifting.strid' does not exist; did you mean 'lifting.stride'?",
    "start.zzz:=4": "parameter 'start.zzz' does not exist; ",
    "liftin.stride:=4": "parameter 'liftin.stride' does not exist; did you mean 'lifting.stride'?",
    "sinc_slop:=0.1": "parameter 'sinc_slop' does not exist; did you mean 'sync_slop'?",
    "alignment.ladder:=[1, 2]": "parameter 'alignment.ladder' does not exist: it comes with the preset",
}


@pytest.mark.parametrize("override", MISTAKES)
def test_a_mistake_at_the_start_is_one_line_that_teaches(override: str) -> None:
    with ros_node(*given(override)) as node:
        with pytest.raises(ConfigError) as raised:
            NodeParameters(node, lambda: None)
        assert str(raised.value).startswith(MISTAKES[override]) and "\n" not in str(raised.value)
        assert not node.has_parameter("preset")


def test_names_of_somebody_else_are_no_mistake(capfd: pytest.CaptureFixture[str]) -> None:
    """One file for all nodes (`/**:`) holds names that are not ours."""
    with ros_node(*given("use_sim_time:=true", "max_range:=1", "frame_id:=map")) as node:
        Live(node)
    said = capfd.readouterr().err
    assert "'max_range'" in said and "'frame_id'" in said and "use_sim_time" not in said


YAML = ROOT / "config/garps.yaml"


def with_everything(path: Path) -> Path:
    """Write the shipped file with no setting commented out."""
    path.write_text(re.sub(r"^( +)#(?=[a-z])", r"\1", YAML.read_text("utf-8"), flags=re.M), encoding="utf-8")
    return path


def test_the_shipped_file_holds_every_parameter_once_with_its_default_and_type(tmp_path: Path) -> None:
    own = yaml.safe_load(YAML.read_text("utf-8"))["/**"]["ros__parameters"]
    assert own == {f.name: f.default for f in dataclasses.fields(NodeSettings)}
    text = with_everything(tmp_path / "all.yaml").read_text("utf-8")
    values = yaml.safe_load(text)["/**"]["ros__parameters"]
    assert list(values.items()) == [(parameter.name, parameter.default) for parameter in ALL]
    assert [type(value) for value in values.values()] == [type(parameter.default) for parameter in ALL]
    assert all(len(re.findall(rf"^ +{re.escape(name)}:", text, re.M)) == 1 for name in values)


@pytest.mark.parametrize("everything", [False, True])
def test_the_shipped_file_starts_a_node(tmp_path: Path, everything: bool, capfd: pytest.CaptureFixture[str]) -> None:
    file = with_everything(tmp_path / "all.yaml") if everything else YAML
    with ros_node("--params-file", str(file)) as node:
        given_names = set(node._parameter_overrides)
        live = Live(node)
        assert (live.parameters.node, live.parameters.config) == (NodeSettings(), Config())
    assert given_names == ({p.name for p in ALL} if everything else {f.name for f in dataclasses.fields(NodeSettings)})
    assert "no effect" not in capfd.readouterr().err


def test_the_shipped_file_leaves_a_preset_as_it_is() -> None:
    with ros_node("--params-file", str(YAML), *given("preset:=monocular")) as node:
        assert Live(node).parameters.config == Config.preset("monocular")


def test_a_changed_line_of_the_file_counts(tmp_path: Path) -> None:
    file = with_everything(tmp_path / "all.yaml")
    for old, new in (("stride: 2", "stride: 9"), ("sync_slop: 0.02", "sync_slop: 0.5")):
        assert old in file.read_text("utf-8")
        file.write_text(file.read_text("utf-8").replace(old, new), encoding="utf-8")
    with ros_node("--params-file", str(file)) as node:
        found = Live(node).parameters
    assert found.config.lifting.stride == 9 and found.node.sync_slop == 0.5


def test_nested_names_are_the_same_as_dotted_ones(tmp_path: Path) -> None:
    file = tmp_path / "nested.yaml"
    file.write_text("/**:\n  ros__parameters:\n    lifting:\n      stride: 9\n", encoding="utf-8")
    with ros_node("--params-file", str(file)) as node:
        assert Live(node).parameters.config.lifting.stride == 9


def test_the_file_of_the_page_starts_a_node(tmp_path: Path) -> None:
    (example,) = re.findall(r"^```yaml\n(.*?)^```$", (ROOT / "docs/parameters.md").read_text("utf-8"), re.M | re.S)
    file = tmp_path / "my.yaml"
    file.write_text(example, encoding="utf-8")
    with ros_node("--params-file", str(file)) as node:
        found = Live(node).parameters
    assert found.config == Config.preset("monocular").replace({"lifting.stride": 4}) and found.node.sync_slop == 0.03
