# SPDX-License-Identifier: Apache-2.0
"""The launch file and what it names exist: topics, parameters, choices, executable, files.

The ROS packages `launch` and `launch_ros` are not on PyPI. Stand-ins with the classes and keywords of Jazzy's take
their place here, so the file itself runs; that the real ones accept it, only a robot can show.
"""

import functools
import json
import os
import re
import runpy
import shlex
import subprocess
import sys
from dataclasses import dataclass, field
from itertools import pairwise
from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import Any
from xml.etree import ElementTree

import pytest
import yaml
from places import ROOT

from garps_core.errors import ConfigError
from garps_ros.parameters.parameter import parameters, settings_from

LAUNCH_FILE = ROOT / "launch" / "garps.launch.py"
RVIZ_FILE = ROOT / "rviz" / "garps.rviz"


@dataclass(frozen=True, kw_only=True)
class Node:
    package: str
    executable: str
    name: str | None = None
    namespace: str | None = None
    parameters: list[Any] = field(default_factory=list)
    remappings: list[tuple[str, str]] = field(default_factory=list)
    arguments: list[str] = field(default_factory=list)
    additional_env: dict[str, str] | None = None
    output: str = "log"
    emulate_tty: bool = False
    respawn: bool = False
    respawn_delay: float | None = None


class DeclareLaunchArgument:
    def __init__(self, name: str, *, default_value: str, description: str, choices: list[str] | None = None) -> None:
        self.name, self.default, self.description, self.choices = name, default_value, description, choices
        assert choices is None or default_value in choices, "Jazzy refuses such a default"


class OpaqueFunction:
    def __init__(self, *, function: Any) -> None:
        self.function = function


class LogInfo:
    def __init__(self, *, msg: str) -> None:
        self.msg = msg


STAND_INS = {
    "launch": {"LaunchDescription": list, "LaunchContext": object},
    "launch.actions": {
        "DeclareLaunchArgument": DeclareLaunchArgument,
        "LogInfo": LogInfo,
        "OpaqueFunction": OpaqueFunction,
    },
    "launch_ros": {},
    "launch_ros.actions": {"Node": Node},
}


@pytest.fixture(autouse=True)
def description(monkeypatch: pytest.MonkeyPatch) -> list[Any]:
    for name, content in STAND_INS.items():
        module = ModuleType(name)
        vars(module).update(content)
        monkeypatch.setitem(sys.modules, name, module)
    return runpy.run_path(str(LAUNCH_FILE))["generate_launch_description"]()


def started(description: list[Any], **given: str) -> list[Any]:
    """Return what the launch starts when these arguments are given; checked as Jazzy would."""
    arguments = {action.name: action for action in description if isinstance(action, DeclareLaunchArgument)}
    assert set(given) <= set(arguments)
    for name, value in given.items():
        assert arguments[name].choices is None or value in arguments[name].choices
    values = {name: given.get(name, argument.default) for name, argument in arguments.items()}
    (function,) = [action.function for action in description if isinstance(action, OpaqueFunction)]
    return function(SimpleNamespace(launch_configurations=values))


def test_every_argument_teaches(description: list[Any]) -> None:
    arguments = [action for action in description if isinstance(action, DeclareLaunchArgument)]
    assert {f"{camera}_{part}" for camera in ("source", "target") for part in ("image", "info", "depth")} <= {
        argument.name for argument in arguments
    }
    for argument in arguments:
        assert len(argument.description) > 15, argument.name


def test_the_node_is_started_and_started_again(description: list[Any]) -> None:
    (node,) = started(description)
    assert (node.package, node.output, node.respawn) == ("garps_ros", "screen", True) and node.respawn_delay >= 1
    assert f'"{node.executable} = garps_ros.' in (ROOT / "setup.py").read_text("utf-8")
    (node,) = started(description, respawn="false")
    assert not node.respawn


def test_unless_told_nothing_overrules_the_parameter_file(description: list[Any]) -> None:
    (node,) = started(description)
    file, overrides = node.parameters
    assert Path(file) == ROOT / "config" / "garps.yaml" and overrides == {"use_sim_time": False}


def test_parameters_have_the_names_and_types_of_the_node(description: list[Any]) -> None:
    known = {parameter.name: parameter.default for parameter in parameters()}
    (node,) = started(
        description,
        pairing="keyframe",
        preset="monocular",
        image_transport="compressed",
        target_frame="right_optical",
        publish_tf="true",
        use_sim_time="true",
        reconstruction="depth_anything_v2",
    )
    given = node.parameters[1]
    assert given.pop("use_sim_time") is True  # rclpy's own
    assert len(given) == 6
    for name, value in given.items():
        assert type(value) is type(known[name])
    settings, config = settings_from(known | given)
    assert settings.publish_tf and settings.pairing == "keyframe"
    assert config.reconstruction.method == "depth_anything_v2"


def test_every_choice_is_one_the_node_accepts(description: list[Any]) -> None:
    known = {parameter.name: parameter for parameter in parameters()}
    seen = set()
    for argument in description:
        if isinstance(argument, DeclareLaunchArgument) and argument.name in known and argument.choices:
            seen.add(argument.name)
            words = {choice for choice in argument.choices if choice}
            assert words == (set(known[argument.name].choices) or {"true", "false"}), argument.name
        if isinstance(argument, DeclareLaunchArgument) and argument.name == "reconstruction":
            assert not argument.choices, "networks that are installed are not known here"
            assert all(
                name in str(argument.description) for name in {*known["reconstruction.method"].choices} - {"ply"}
            )
    assert seen == {"pairing", "preset", "image_transport", "publish_tf"}


def test_the_parameter_file_is_for_any_namespace_and_right() -> None:
    """`pose_node:` alone would be passed over silently once the node has a namespace."""
    (key, content), *rest = yaml.safe_load((ROOT / "config" / "garps.yaml").read_text("utf-8")).items()
    assert not rest and key in ("/**", "/**/pose_node")
    flat = dict(flattened("", content["ros__parameters"]))
    known = {parameter.name: parameter.default for parameter in parameters(flat.get("preset", "default"))}
    for name, value in flat.items():
        assert type(value) is type(known[name]), name
    settings_from(known | flat)
    with pytest.raises(ConfigError):
        settings_from(known | flat | {"pairing": "camera"})


def flattened(prefix: str, tree: dict[str, Any]) -> list[tuple[str, Any]]:
    pairs: list[tuple[str, Any]] = []
    for name, value in tree.items():
        pairs += flattened(f"{prefix}{name}.", value) if isinstance(value, dict) else [(prefix + name, value)]
    return pairs


def test_calibration_lies_beside_the_image(description: list[Any]) -> None:
    cases = {
        "/left/image_rect": "/left/camera_info",
        "left/colour/image": "left/colour/camera_info",
        "/image": "/camera_info",
        "image": "camera_info",
        "source/image": "source/camera_info",
    }
    for image, info in cases.items():
        (node,) = started(description, source_image=image)
        assert dict(node.remappings)["source/camera_info"] == info
    (node,) = started(description, target_image="/a/b", target_info="/elsewhere/info", target_depth="/a/d")
    assert {name: to for name, to in node.remappings if name.startswith("target")} == {
        "target/image": "/a/b",
        "target/camera_info": "/elsewhere/info",
        "target/depth": "/a/d",
    }


def test_only_topics_of_the_node_are_remapped(description: list[Any]) -> None:
    """A name that the node does not subscribe would be remapped without effect and without a word."""
    (node,) = started(description)
    assert {f"/{name}" for name, _ in node.remappings} <= node_topics()


@functools.cache
def node_topics() -> set[str]:
    """Return the topics that a running pose node subscribes and publishes; its process meets no other."""
    pytest.importorskip("rclpy")
    code = (
        "import rclpy; from rclpy.node import Node; from garps_ros.live.node import PoseNode; rclpy.init()\n"
        "ros = Node('pose_node'); node = PoseNode(ros)\n"
        "print('TOPICS', *(end.topic_name for end in (*ros.subscriptions, *ros.publishers)))\n"
        "node.stop(5.0); ros.destroy_node(); rclpy.shutdown()"
    )
    environment = {**os.environ, "ROS_AUTOMATIC_DISCOVERY_RANGE": "OFF"}
    done = subprocess.run(
        [sys.executable, "-c", code], cwd=ROOT, env=environment, capture_output=True, text=True, timeout=120
    )
    assert done.returncode == 0, done.stderr
    (line,) = [line for line in done.stdout.splitlines() if line.startswith("TOPICS ")]
    return set(line.split()[1:])


def test_large_images_name_a_profile_that_is_there(description: list[Any]) -> None:
    (node,) = started(description, large_images="true")
    ((variable, path),) = node.additional_env.items()
    assert variable == "FASTRTPS_DEFAULT_PROFILES_FILE"
    text = ElementTree.parse(path)
    sizes = [int(element.text or "") for element in text.iter() if element.tag.endswith("segment_size")]
    assert sizes == [32 * 2**20]
    library = next(Path(sys.prefix).glob("lib*/libfastrtps.so*"), None)  # where the wheels have it
    assert library is None or variable.encode() in library.read_bytes(), "Fast DDS does not know the variable"
    (node,) = started(description)
    assert not node.additional_env


def test_every_file_it_names_is_installed(description: list[Any]) -> None:
    node, _, rviz = started(description, rviz="true", large_images="true")
    named = [node.parameters[0], *node.additional_env.values(), rviz.arguments[1], str(LAUNCH_FILE)]
    installed = [str(path) for pattern in installed_patterns() for path in ROOT.glob(pattern)]
    for path in named:
        assert str(path) in installed, path


def installed_patterns() -> list[str]:
    return re.findall(r'present\("([^"]+)"\)', (ROOT / "setup.py").read_text("utf-8"))


def rviz_topics() -> set[str]:
    displays = yaml.safe_load(RVIZ_FILE.read_text("utf-8"))["Visualization Manager"]["Displays"]
    return {display["Topic"]["Value"] for display in displays if "Topic" in display}


def test_rviz_is_led_to_the_topics_of_the_launch(description: list[Any]) -> None:
    node, rviz = started(
        description,
        rviz="true",
        namespace="rig",
        target_frame="right_optical",
        source_image="/left/image_rect",
        target_image="right/image_rect",
        use_sim_time="true",
    )
    assert (rviz.package, rviz.executable) == ("rviz2", "rviz2") and node.namespace == "rig"
    assert rviz.arguments == ["-d", str(RVIZ_FILE), "-f", "right_optical"] and rviz.parameters == [
        {"use_sim_time": True}
    ]
    led = dict(rviz.remappings)
    assert rviz_topics() <= set(led)
    assert led["/source/image"] == "/left/image_rect" and led["/target/image"] == "/rig/right/image_rect"
    assert led["/pose_node/pose"] == "/rig/pose_node/pose"


def test_rviz_without_a_frame_says_what_to_do(description: list[Any]) -> None:
    _, hint, rviz = started(description, rviz="true")
    assert "target_frame:=" in hint.msg and "-f" not in rviz.arguments
    led = dict(rviz.remappings)
    assert led["/source/image"] == "/source/image" and led["/pose_node/pose"] == "/pose_node/pose"


def test_rviz_shows_what_the_node_publishes() -> None:
    assert rviz_topics() <= node_topics()


def test_every_ros_package_that_is_used_is_declared() -> None:
    """An apt robot installs what package.xml names (`rosdep install`), no more."""
    package = ElementTree.parse(ROOT / "package.xml").getroot()
    declared = {element.text for element in package.iter("exec_depend")}
    text = "\n".join(
        path.read_text("utf-8") for folder in ("garps_ros", "msg_adapters") for path in folder_files(folder)
    )
    used = set(re.findall(r"\b(\w+_(?:msgs|srvs|interfaces))[./](?:msg|srv)\b", text))
    used |= set(re.findall(r"^from (launch\w*)[. ]", LAUNCH_FILE.read_text("utf-8"), re.M)) | {"rclpy", "rviz2"}
    assert {"sensor_msgs", "std_srvs", "tf2_msgs", "launch_ros"} <= used <= declared, used - declared


def folder_files(folder: str) -> list[Path]:
    return sorted((ROOT / folder).rglob("*.py"))


def ros2_commands() -> list[list[str]]:
    """Words of every `ros2 run` and `ros2 launch` of this package in README and docs."""
    pages = [ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md"))]
    blocks = [
        block for page in pages for block in re.findall(r"^```bash\n(.*?)^```$", page.read_text("utf-8"), re.M | re.S)
    ]
    lines = "\n".join(blocks).replace("\\\n", " ").splitlines()
    words = [shlex.split(line, comments=True) for line in lines if line.startswith("ros2 ")]
    return [line for line in words if line[1] in ("run", "launch") and line[2] == "garps_ros"]


def test_the_commands_of_the_pages_are_right(description: list[Any]) -> None:
    arguments = {action.name for action in description if isinstance(action, DeclareLaunchArgument)}
    names = {parameter.name for parameter in parameters()} | {"use_sim_time"}
    commands = ros2_commands()
    assert {words[1] for words in commands} == {"run", "launch"}
    for _, verb, _, target, *rest in commands:
        if verb == "launch":
            assert target == LAUNCH_FILE.name
            given = {word.partition(":=")[0]: word.partition(":=")[2] for word in rest if word != "--show-args"}
            assert set(given) <= arguments, given
            started(description, **given)
            continue
        assert f'"{target} = garps_' in (ROOT / "setup.py").read_text("utf-8")
        assert {name.partition(":=")[0] for flag, name in pairwise(rest) if flag == "-p"} <= names
        topics = {f"/{name.partition(':=')[0]}" for flag, name in pairwise(rest) if flag == "-r"}
        assert topics <= node_topics(), topics


def test_the_container_starts_the_node_itself_and_stops_it_by_a_signal_that_it_hears() -> None:
    """`ros2 run` as process 1 passes no signal on: `docker stop` would kill the node after 10 s."""
    said = dict(line.split(" ", 1) for line in (ROOT / "Dockerfile").read_text("utf-8").splitlines() if " " in line)
    (command,) = json.loads(said["CMD"])
    folder = re.search(r"^install_scripts=\$base/(.*)$", (ROOT / "setup.cfg").read_text("utf-8"), re.M)
    assert folder is not None
    path, _, executable = command.rpartition("/")
    assert path == f"{said['WORKDIR']}/install/garps_ros/{folder[1]}"
    assert f'"{executable} = garps_ros.pose_node:' in (ROOT / "setup.py").read_text("utf-8")
    assert f"signal.{said['STOPSIGNAL']}" in (ROOT / "garps_ros" / "pose_node.py").read_text("utf-8")


def test_messages_that_the_page_explains_exist() -> None:
    """The table under "Nothing comes out" quotes what the node says."""
    page = (ROOT / "docs" / "robot.md").read_text("utf-8").partition("## Nothing comes out")[2]
    quoted = re.findall(r"^\| `([^`]+)` \|", page, re.M)
    source = "\n".join(path.read_text("utf-8") for path in folder_files("garps_ros"))
    literal = re.sub(r"\{[^{}]*\}", "...", source)
    assert len(quoted) > 5
    for text in quoted:
        for part in text.split("..."):
            assert part.strip(" ,") in literal, part
