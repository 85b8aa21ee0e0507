# SPDX-License-Identifier: Apache-2.0
"""A real `colcon build`, sourced as on a robot: everything is where ROS looks, and what was installed runs."""

import importlib.util
import os
import shlex
import shutil
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from xml.etree import ElementTree

import pytest
import yaml
from places import ROOT

EXECUTABLES = ("pose_node", "replay")
READY_WITHIN_S = 60

pytestmark = pytest.mark.skipif(
    importlib.util.find_spec("colcon_core") is None, reason="colcon is not installed (requirements-test.txt)"
)


def clean_environment(home: Path) -> dict[str, str]:
    """That of the shell without anything of an earlier ROS, Python path or profile."""
    ours = ("ROS_", "RMW_", "COLCON_", "AMENT_", "FASTRTPS_", "FASTDDS_", "PYTHON", "COVERAGE", "COV_CORE")
    kept = {name: value for name, value in os.environ.items() if not name.startswith(ours)}
    return {**kept, "COLCON_HOME": str(home / "colcon"), "PYTHONDONTWRITEBYTECODE": "1"}


def content(folder: Path) -> dict[str, bytes]:
    """Every file below a folder."""
    return {str(path.relative_to(folder)): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


def checkout(place: Path) -> Path:
    """A copy of what belongs to the package, in a workspace's src/."""
    left_out = shutil.ignore_patterns(".*", "build", "install", "log", "dist", "out", "*.egg-info", "__pycache__")
    return Path(shutil.copytree(ROOT, place / "src" / "garps_ros", ignore=left_out))


def colcon_build(workspace: Path, *options: str) -> None:
    done = subprocess.run(
        [sys.executable, "-m", "colcon", "build", *options],
        cwd=workspace,
        env=clean_environment(workspace),
        capture_output=True,
        text=True,
        timeout=300,
    )
    assert done.returncode == 0, done.stdout + done.stderr
    assert "1 package finished" in done.stdout


@pytest.fixture(scope="module")
def workspace(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A workspace with the package built into install/, isolated as colcon does unless told otherwise."""
    place = tmp_path_factory.mktemp("workspace")
    source = checkout(place)
    before = content(source)
    colcon_build(place)
    assert content(source) == before, "the build wrote into the sources"
    return place


@pytest.fixture(scope="module")
def environment(workspace: Path) -> dict[str, str]:
    """The environment of a shell that has sourced install/setup.bash. (Not under `set -u`: colcon's script reads
    variables that are not set.)"""
    show = f"{shlex.quote(sys.executable)} -c 'import json, os; print(json.dumps(dict(os.environ)))'"
    done = subprocess.run(
        ["bash", "-c", f"source install/setup.bash && {show}"],
        cwd=workspace,
        env=clean_environment(workspace),
        capture_output=True,
        text=True,
        timeout=60,
    )
    assert done.returncode == 0 and not done.stderr, done.stderr
    return yaml.safe_load(done.stdout)


@pytest.fixture
def domain() -> Iterator[str]:
    """A ROS domain of its own, held by a port while the test runs; above 101 DDS meets the ephemeral ports."""
    for number in range(1 + os.getpid() % 50, 102):
        with socket.socket() as held:
            try:
                held.bind(("127.0.0.1", 21000 + number))
            except OSError:
                continue
            yield str(number)
            return
    pytest.fail("no free ROS domain")


def site_packages() -> str:
    return f"lib/python{sys.version_info.major}.{sys.version_info.minor}/site-packages"


def run(environment: dict[str, str], command: list[str], folder: Path) -> subprocess.CompletedProcess[str]:
    return subprocess.run(command, cwd=folder, env=environment, capture_output=True, text=True, timeout=120)


def test_a_build_with_symlinks_works_too(tmp_path: Path) -> None:
    """Developers use this; it needs setuptools below 80."""
    source = checkout(tmp_path)
    before = content(source)
    colcon_build(tmp_path, "--symlink-install")
    prefix = tmp_path / "install" / "garps_ros"
    assert all((prefix / "lib" / "garps_ros" / name).is_file() for name in EXECUTABLES)
    assert (prefix / "share/garps_ros/launch/garps.launch.py").is_file()
    assert all(".egg-info/" in name for name in set(content(source)) - set(before))


def test_ros_finds_the_package(workspace: Path, environment: dict[str, str]) -> None:
    prefix = workspace / "install" / "garps_ros"
    assert environment["AMENT_PREFIX_PATH"].split(":")[0] == str(prefix)
    assert (prefix / "share/ament_index/resource_index/packages/garps_ros").is_file()
    package = ElementTree.parse(prefix / "share/garps_ros/package.xml").getroot()
    assert package.findtext("name") == "garps_ros" and package.findtext("export/build_type") == "ament_python"


def test_launch_configuration_and_rviz_files_are_installed(workspace: Path) -> None:
    share = workspace / "install" / "garps_ros" / "share" / "garps_ros"
    for name in ("launch/garps.launch.py", "config/garps.yaml", "config/fastdds_large_images.xml", "rviz/garps.rviz"):
        assert (share / name).read_bytes() == (ROOT / name).read_bytes(), name
    assert yaml.safe_load((share / "config/garps.yaml").read_text("utf-8"))
    assert ElementTree.parse(share / "config/fastdds_large_images.xml").getroot() is not None


@pytest.mark.parametrize("name", EXECUTABLES)
def test_ros2_run_finds_an_executable_for_the_building_python(workspace: Path, name: str) -> None:
    script = workspace / "install" / "garps_ros" / "lib" / "garps_ros" / name
    assert os.access(script, os.X_OK)
    assert script.read_text("utf-8").splitlines()[0] == f"#!{sys.executable}"


def test_only_what_is_meant_to_be_run_is_there(workspace: Path) -> None:
    found = {path.name for path in (workspace / "install" / "garps_ros" / "lib" / "garps_ros").iterdir()}
    assert found == {"garps", "garps-replay", *EXECUTABLES}


@pytest.mark.parametrize("name", EXECUTABLES)
def test_the_installed_executable_explains_itself(
    workspace: Path, environment: dict[str, str], tmp_path: Path, name: str
) -> None:
    script = workspace / "install" / "garps_ros" / "lib" / "garps_ros" / name
    done = run(environment, [str(script), "--help"], tmp_path)
    assert done.returncode == 0, done.stderr
    assert len(done.stdout.splitlines()) > 10 and "source" in done.stdout and not done.stderr
    assert {"pose_node": "--ros-args", "replay": "--out"}[name] in done.stdout


@pytest.mark.parametrize("name", EXECUTABLES)
def test_what_runs_is_what_was_installed(
    workspace: Path, environment: dict[str, str], tmp_path: Path, name: str
) -> None:
    """The script itself, in its environment: which files its packages came from. Not those of the checkout."""
    script = workspace / "install" / "garps_ros" / "lib" / "garps_ros" / name
    code = (
        "import runpy, sys\n"
        "script = sys.argv.pop(1)\n"
        "try:\n    runpy.run_path(script, run_name='__main__')\n"
        "except SystemExit as end:\n    assert not end.code, end.code\n"
        "for name, module in sorted(sys.modules.items()):\n"
        "    if name.split('.')[0] in ('garps_core', 'garps_ros', 'msg_adapters'):\n"
        "        print('FROM', module.__file__)\n"
    )
    done = run(environment, [sys.executable, "-P", "-c", code, str(script), "--help"], tmp_path)
    assert done.returncode == 0, done.stderr
    files = [line.removeprefix("FROM ") for line in done.stdout.splitlines() if line.startswith("FROM ")]
    assert f"{script.parents[2] / site_packages() / 'garps_ros' / name}.py" in files
    assert all(Path(file).is_relative_to(workspace / "install") for file in files), files


def test_the_installed_node_starts_and_ends(
    workspace: Path, environment: dict[str, str], tmp_path: Path, domain: str
) -> None:
    """Start it like `ros2 run`, with the installed parameter file; stopped by Ctrl-C: exit code 0, no traceback."""
    pytest.importorskip("rclpy")
    prefix = workspace / "install" / "garps_ros"
    command = [str(prefix / "lib/garps_ros/pose_node"), "--ros-args", "-r", "__ns:=/rig"]
    command += ["--params-file", str(prefix / "share/garps_ros/config/garps.yaml")]
    ours = {"ROS_DOMAIN_ID": domain, "ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST", "ROS_LOG_DIR": str(tmp_path / "log")}
    output = tmp_path / "output.txt"
    with output.open("w") as file:
        node = subprocess.Popen(
            command,
            cwd=tmp_path,
            env={**environment, **ours, "ROS_PYTHON_CHECK_FIELDS": "1", "PYTHONUNBUFFERED": "1"},
            stdout=file,
            stderr=subprocess.STDOUT,
            start_new_session=True,
        )
        try:
            deadline = time.monotonic() + READY_WITHIN_S
            while "ready" not in output.read_text() and node.poll() is None and time.monotonic() < deadline:
                time.sleep(0.05)
            assert node.poll() is None and "ready" in output.read_text(), output.read_text()
            node.send_signal(signal.SIGINT)
            code = node.wait(timeout=30)
        finally:
            if node.poll() is None:
                node.kill()
                node.wait()
    assert code == 0 and "Traceback" not in output.read_text(), output.read_text()
