# SPDX-License-Identifier: Apache-2.0
"""The live node's parameters as data: complete, described, checked; and the page and the file generated from them."""

import dataclasses
import inspect
import math
import subprocess
import sys
from pathlib import Path

import pytest
from places import ROOT

from garps_core.config import PRESETS, Config
from garps_core.config.field import Checked, setting
from garps_core.errors import ConfigError
from garps_ros.estimates.keyframes import KeyframeRule
from garps_ros.parameters import docs
from garps_ros.parameters.parameter import expert_settings, parameters, settings_from
from garps_ros.parameters.settings import NodeSettings
from garps_ros.replay import replay

LADDERS = ("alignment.ladder", "alignment.search", "alignment.search_ladder")


def values_of(preset: str = "default", **changes: object) -> dict[str, object]:
    values: dict[str, object] = {parameter.name: parameter.default for parameter in parameters(preset)}
    return values | {name.replace("__", "."): value for name, value in changes.items()}


def test_a_class_chooses_how_errors_name_its_settings() -> None:
    @dataclasses.dataclass(frozen=True)
    class Lamp(Checked):
        power: float = setting(1.0, "brightness", unit="W", low=0, high=5)

    @dataclasses.dataclass(frozen=True)
    class Bare(Checked, prefix=""):
        power: float = setting(1.0, "brightness", unit="W", low=0, high=5)

    with pytest.raises(ConfigError, match=r"^lamp\.power is 6: expected between 0 and 5 W$"):
        Lamp(6)
    with pytest.raises(ConfigError, match=r"^power is 6: expected between 0 and 5 W$"):
        Bare(6)
    with pytest.raises(ConfigError, match=r"^pairing is 'x': expected one of cameras, keyframe$"):
        NodeSettings(pairing="x")


def test_every_setting_is_a_parameter_or_for_experts_except_the_ladders() -> None:
    names, experts = ([p.name for p in some()] for some in (parameters, expert_settings))
    own = [f.name for f in dataclasses.fields(NodeSettings)]
    assert names[: len(own)] == own and names[0] == "preset"
    settings = [name for name in Config().settings() if name not in LADDERS]
    assert [name for name in settings if name not in experts] == names[len(own) :]
    assert [name for name in settings if name not in names] == experts
    assert len(names) + 6 <= 45, "`ros2 param list` fills more than a screen"


@pytest.mark.parametrize("preset", PRESETS)
def test_the_defaults_are_those_of_the_preset(preset: str) -> None:
    declared = {parameter.name: parameter.default for parameter in parameters(preset)}
    experts = {parameter.name: parameter.default for parameter in expert_settings(preset)}
    config = Config.preset(preset)
    assert {name: value for name, value in config.settings().items() if name not in LADDERS}.items() <= (
        (declared | experts).items()
    )
    assert settings_from(declared) == (NodeSettings(preset=preset), config)


def test_a_number_has_the_same_type_in_every_preset_and_a_range_that_holds_it() -> None:
    for preset in PRESETS:
        ours = [*parameters(preset), *expert_settings(preset)]
        for default, parameter in zip([*parameters(), *expert_settings()], ours, strict=True):
            assert type(parameter.default) is type(default.default), parameter.name
            assert parameter.doc, parameter.name
            if type(parameter.default) in (int, float):
                assert parameter.low is not None and parameter.high is not None, parameter.name
                assert parameter.low <= parameter.default <= parameter.high, parameter.name
            if parameter.choices:
                assert parameter.default in parameter.choices, parameter.name


def test_the_presets_named_are_those_that_exist() -> None:
    (choices,) = [parameter.choices for parameter in parameters() if parameter.name == "preset"]
    assert [Config.preset(name) for name in choices]
    with pytest.raises(ConfigError) as raised:
        Config.preset("")
    assert str(raised.value).endswith(", ".join(choices))


def test_what_cannot_change_while_the_node_runs() -> None:
    fixed = {parameter.name for parameter in [*parameters(), *expert_settings()] if not parameter.live}
    expected = {"preset", "settings_file", "pairing", "image_transport", "depth_transport", "image_qos", "publish_tf"}
    networks = ("method", "depth_weights", "flash3d_weights", "scene", "semantics", "semantic_weights")
    expected |= {f"reconstruction.{name}" for name in (*networks, "semantic_backbone")}
    assert fixed == expected | {f"start.{name}" for name in ("method", "weights", "adapter")}


def test_the_groups() -> None:
    groups = {parameter.name: parameter.group for parameter in parameters()}
    assert groups["sync_slop"] == "node" and groups["device"] == "" and groups["lifting.stride"] == "lifting"


@pytest.mark.parametrize(
    ("own", "option"),
    [
        ("sync_slop", "slop"),
        ("keyframe_overlap", "keyframe_overlap"),
        ("keyframe_motion", "keyframe_motion"),
        ("keyframe_rotation", "keyframe_rotation"),
        ("keyframe_lost_after", "keyframe_lost_after"),
        ("rectified", "rectified"),
    ],
)
def test_the_node_and_the_replay_have_the_same_defaults(own: str, option: str) -> None:
    assert getattr(NodeSettings(), own) == inspect.signature(replay).parameters[option].default


def test_the_tracker_has_the_default_too() -> None:
    rule, node = KeyframeRule(), NodeSettings()
    assert rule.max_rotation_rad == math.radians(node.keyframe_rotation)
    assert (rule.min_overlap, rule.max_motion_m) == (node.keyframe_overlap, node.keyframe_motion)
    assert rule.lost_after == node.keyframe_lost_after


def test_values_reach_the_settings() -> None:
    node, config = settings_from(values_of("paper", sync_slop=0.5, lifting__stride=7, device="cuda:0"))
    assert node.sync_slop == 0.5 and node.preset == "paper"
    assert config == Config.preset("paper").replace({"lifting.stride": 7, "device": "cuda:0"})
    monocular = settings_from(values_of("monocular"))[1]
    assert monocular.alignment.ladder == Config.preset("monocular").alignment.ladder != Config().alignment.ladder


WRONG = {
    "choice": ({"pairing": "x"}, "pairing is 'x': expected one of cameras, keyframe"),
    "preset": ({"preset": "x"}, "preset is 'x': expected one of default, sensor, time_of_flight"),
    "range": ({"sync_slop": 11.0}, "sync_slop is 11.0: expected between 0 and 10 s"),
    "range of the estimator": ({"lifting__stride": 0}, "lifting.stride is 0: expected between 1 and 32 px"),
    "frame in itself": (
        {"source_frame": "cam", "target_frame": "cam"},
        "source_frame and target_frame are both 'cam': expected two names",
    ),
    "not a number": ({"max_rate": float("nan")}, "max_rate is nan: expected between 0 and 1000 Hz"),
    "no part": ({"device": 5}, "device is 5: expected text"),
    "text for flag": ({"lazy": "yes"}, "lazy is 'yes': expected True or False"),
    "unknown": ({"lifting__strid": 2}, "parameter 'lifting.strid' does not exist; did you mean 'lifting.stride'?"),
    "expert": (
        {"alignment__tolerance": 0.1},
        "'alignment.tolerance' is an expert setting and no parameter of the node. Write `alignment.tolerance: 0.1`",
    ),
    "near an expert": ({"alignment__tolerence": 2}, "parameter 'alignment.tolerence' does not exist; did you mean 'al"),
    "ladder": ({"alignment__ladder": 2}, "parameter 'alignment.ladder' does not exist: it comes with the preset"),
    "far from all": ({"zzz": 2}, "parameter 'zzz' does not exist; `ros2 param list` shows all names"),
}


@pytest.mark.parametrize(("changes", "text"), WRONG.values(), ids=WRONG)
def test_a_wrong_value_is_one_line_that_teaches(changes: dict[str, object], text: str) -> None:
    with pytest.raises(ConfigError) as raised:
        settings_from(values_of(**changes))
    assert str(raised.value).startswith(text)


def test_frames_may_have_two_names_or_none() -> None:
    assert settings_from(values_of())[0].source_frame == ""
    node, _ = settings_from(values_of(source_frame="cam", target_frame="map"))
    assert (node.source_frame, node.target_frame) == ("cam", "map")


def test_a_prior_of_another_moment_is_not_used_unless_asked_for() -> None:
    """At 1 m/s the camera is 0.1 m from it; its covariance knows nothing of that."""
    assert NodeSettings().prior_max_age <= 0.1


def test_a_missing_value_is_named() -> None:
    values = values_of()
    del values["lifting.stride"]
    with pytest.raises(ConfigError, match=r"^parameter 'lifting\.stride' has no value"):
        settings_from(values)


def test_an_unknown_preset_has_no_parameters() -> None:
    with pytest.raises(ConfigError, match=r"^preset is 'x': expected one of default"):
        parameters("x")


def test_the_description_needs_no_ros() -> None:
    code = "import garps_ros.parameters.parameter, sys; print('rclpy' in sys.modules)"
    done = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, timeout=120)
    assert done.stdout.strip() == "False", done.stderr


def test_the_page_and_the_file_are_current() -> None:
    assert docs.main(["--check"]) == 0, "run python -m garps_ros.parameters.docs"


def test_a_stale_page_is_noticed_and_written_anew(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "setup.py").touch()
    root = ["--root", str(tmp_path)]
    assert docs.main([*root, "--check"]) == 1
    assert not (tmp_path / "docs").exists()
    assert "docs/parameters.md is stale" in capsys.readouterr().err
    assert docs.main(root) == 0
    assert docs.main([*root, "--check"]) == 0
    page = tmp_path / "docs/parameters.md"
    page.write_text(page.read_text() + "edited")
    assert docs.main([*root, "--check"]) == 1
    assert docs.main(root) == 0 and page.read_text() == docs.page()


def test_only_a_checkout_is_written_into(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit):
        docs.main(["--root", str(tmp_path)])
    assert "is no checkout" in capsys.readouterr().err and not list(tmp_path.iterdir())


def test_the_page_has_a_row_for_every_parameter() -> None:
    rows = [line for line in docs.page().splitlines() if line.startswith("| `")]
    names, experts = ([p.name for p in some()] for some in (parameters, expert_settings))
    assert [row.split("`")[1] for row in rows] == names + experts
    assert [row.count(" | ") for row in rows] == [6] * len(names) + [4] * len(experts)
    (row,) = [row for row in rows if "`lifting.noise_linear`" in row]
    expected = (
        "| `lifting.noise_linear` | double | `0.003`; time_of_flight `0.001`; structured_light `0.0`; stereo `0.0`;"
    )
    assert row.startswith(expected)
    (row,) = [row for row in rows if "`alignment.effective_measurements`" in row]
    assert "`30.0`; monocular `5.0`" in row


def test_the_file_is_one_screen() -> None:
    lines = docs.yaml_file().splitlines()
    assert len(lines) <= 45 and max(map(len, lines)) <= 120


@pytest.mark.parametrize(
    ("value", "text"),
    [(5.0, "5.0"), (1e-5, "1.0e-05"), (1.5e-7, "1.5e-07"), (1e6, "1000000.0"), (3, "3"), (True, "true"), ("a", '"a"')],
)
def test_values_are_written_with_their_type(value: object, text: str) -> None:
    assert docs.written(value) == text
