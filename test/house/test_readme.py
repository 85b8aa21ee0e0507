# SPDX-License-Identifier: Apache-2.0
"""README and docs/ are true: their code runs, their commands, options, settings, paths and links exist."""

import ast
import importlib.util
import re
import shlex
from pathlib import Path

import cv2
import numpy as np
import pytest
from network_weights import install
from places import ROOT

from garps_core import Config, metrics
from garps_core.cli import command
from garps_core.models import depth_anything
from garps_ros import replay

README = ROOT / "README.md"
PAGES = [README, ROOT / "CONTRIBUTING.md", *sorted((ROOT / "docs").rglob("*.md"))]
TESTED_ELSEWHERE = ("two_view_models.md", "extending.md")
"""Pages whose code belongs to another distribution; tests of adapters, depth networks and ways to start run it."""
FOLDERS = ("docs", "garps_core", "garps_ros", "msg_adapters", "bench", "test")
FILES = [str(path.relative_to(ROOT)) for folder in FOLDERS for path in (ROOT / folder).rglob("*.py")]
WEIGHTS_COMMANDS = ("list", "fetch", "verify", "convert", "check")
K = np.array([[525, 0, 319.5], [0, 525, 239.5], [0, 0, 1]])


def name(path: Path) -> str:
    return str(path.relative_to(ROOT))


def blocks(path: Path, language: str) -> list[str]:
    return re.findall(rf"^```{language}\n(.*?)^```$", path.read_text(encoding="utf-8"), re.M | re.S)


def commands(path: Path) -> list[list[str]]:
    """Words of every command line in the bash blocks; comments and line breaks taken away."""
    lines = "\n".join(blocks(path, "bash")).replace("\\\n", " ").splitlines()
    return [words for words in (shlex.split(line, comments=True) for line in lines) if words]


def spoken(path: Path) -> str:
    """All that is set as code on a page: inline and in blocks."""
    found = re.findall(r"```\w*\n(.*?)```|`([^`\n]+)`", path.read_text("utf-8"), re.S)
    return "\n".join(block or inline for block, inline in found)


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, np.ndarray]:
    """Folder of a.png, b.png and their depths, rendered with the README's K; and the true T_b_a."""
    pytest.importorskip("trimesh")
    from bench.rooms import make_pair, make_room

    place = tmp_path_factory.mktemp("readme")
    cameras = make_pair(seed=3, level=2, width=160, height=120)  # only its poses are used
    poses = cameras.T_world_0, cameras.T_world_0 @ np.linalg.inv(cameras.T_1_0)
    room = make_room(3)
    for stem, T in zip("ab", poses, strict=True):
        seen = room.render(T, K, 640, 480, rng=0)
        millimetres = np.nan_to_num(np.rint(1000 * seen.depth_m)).astype(np.uint16)
        cv2.imwrite(str(place / f"{stem}.png"), seen.rgb[:, :, ::-1])
        cv2.imwrite(str(place / f"{stem}_depth.png"), millimetres)
    return place, cameras.T_1_0


def test_the_example_without_depth_asks_for_the_network_it_names(
    folder: tuple[Path, np.ndarray], monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """It finds the file that the line above it fetches; with pseudo-random parameters the pose means nothing."""
    monkeypatch.chdir(folder[0])
    (fetch,) = [words for words in commands(README) if words[:3] == ["garps", "weights", "fetch"]]
    (words,) = [words for words in commands(README) if words[:2] == ["garps", "align"] and words[-5] == "--K"]
    monkeypatch.setenv("GARPS_WEIGHTS", str(folder[0]))
    assert command.main(words[1:]) == 2
    assert " ".join(fetch) in capsys.readouterr().err
    install(folder[0], fetch[-1])
    monkeypatch.setattr(depth_anything, "SHORT_SIDE", 70)
    assert command.main(words[1:]) in (0, 1)
    assert "depth " in capsys.readouterr().out


def test_the_python_example_finds_the_pose(
    folder: tuple[Path, np.ndarray], monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    place, truth = folder
    monkeypatch.chdir(place)
    (example,) = blocks(README, "python")
    assert len([line for line in example.splitlines() if line.strip()]) <= 15
    space: dict = {}
    exec(compile(example, "README.md", "exec"), space)
    estimate = space["estimate"]
    assert estimate.ok, estimate.reason
    assert metrics.translation_error_m(estimate.T_target_source, truth) < 0.01
    assert metrics.rotation_error_deg(estimate.T_target_source, truth) < 0.2
    assert "converged" in capsys.readouterr().out


def test_the_command_line_example_works(
    folder: tuple[Path, np.ndarray], monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(folder[0])
    (words,) = [words for words in commands(README) if words[:2] == ["garps", "align"] and "--depth-source" in words]
    assert command.main(words[1:]) == 0
    assert "converged" in capsys.readouterr().out
    assert (folder[0] / "pair.png").stat().st_size > 10_000


@pytest.mark.parametrize(
    "path", [p for p in sorted((ROOT / "docs").glob("*.md")) if p.name not in TESTED_ELSEWHERE], ids=name
)
def test_the_code_of_the_pages_runs(path: Path) -> None:
    space: dict = {}
    for block in blocks(path, "python"):
        exec(compile(block, name(path), "exec"), space)


def test_every_python_block_was_seen() -> None:
    for path in PAGES:
        assert path.read_text("utf-8").count("```python") == len(blocks(path, "python")), name(path)
    assert blocks(ROOT / "docs/conventions.md", "python")


@pytest.mark.parametrize("path", PAGES, ids=name)
def test_named_commands_exist(path: Path) -> None:
    text = spoken(path)
    targets = re.findall(r"^([\w-]+):", (ROOT / "Makefile").read_text("utf-8"), re.M)
    for target in re.findall(r"(?<![\w-])make ((?!PYTHON)[\w-]+)", text):
        assert target in targets
    entry_points = re.findall(r'"([\w-]+) = ', (ROOT / "setup.py").read_text("utf-8"))
    for words in commands(path):
        program = Path(words[0]).name
        assert not program.startswith("garps") or program in entry_points
    for module in re.findall(r"python -m ([\w.]+)", text):
        assert module.startswith(("bench", "garps")) is False or importlib.util.find_spec(module), module


@pytest.mark.parametrize("path", PAGES, ids=name)
def test_named_options_exist(path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    helps = {}
    for program, main, words in (
        ("garps", command.main, ["align", "--help"]),
        *((f"garps weights {name}", command.main, ["weights", name, "--help"]) for name in WEIGHTS_COMMANDS),
        ("garps-replay", replay.main, ["--help"]),
    ):
        main(words)
        helps[program] = capsys.readouterr().out + "--help --version"
    for words in commands(path):
        program = Path(words[0]).name
        if words[1:2] == ["weights"]:
            assert words[2] in WEIGHTS_COMMANDS
            program = " ".join(("garps", *words[1:3]))
        for option in [word.split("=")[0] for word in words if word.startswith("--")]:
            assert program not in helps or option in helps[program], f"{program} {option}"


@pytest.mark.parametrize("path", PAGES, ids=name)
def test_named_settings_exist(path: Path) -> None:
    known = Config().settings()
    for setting in re.findall(r"(?<![\w.])((?:reconstruction|lifting|start|alignment)\.\w+)(?![\w.]|\()", spoken(path)):
        assert setting in known or setting.endswith((".md", ".py"))


@pytest.mark.parametrize("path", PAGES, ids=name)
def test_named_files_and_links_exist(path: Path) -> None:
    text = path.read_text("utf-8")
    for link in re.findall(r"\]\(([^)#\s]+)[^)]*\)", text):
        assert link.startswith("https://") or (path.parent / link).exists(), link
    for mention in re.findall(rf"(?<![\w./])({'|'.join(FOLDERS)})/([\w/.-]*\w)", spoken(path)):
        assert (ROOT / "/".join(mention)).exists(), "/".join(mention)
    for mention in re.findall(r"`([\w/]+\.py)`", text):
        assert any(f"/{file}".endswith(f"/{mention}") for file in FILES), mention


@pytest.mark.parametrize("path", PAGES, ids=name)
def test_named_parts_of_files_exist(path: Path) -> None:
    """`file.name`, where a file of the packages has that stem: one of them holds the name."""
    for stem, part in re.findall(r"`([a-z_0-9]+)\.([A-Za-z_]\w+)`", path.read_text("utf-8")):
        texts = [(ROOT / file).read_text("utf-8") for file in FILES if Path(file).stem == stem]
        settings = any(setting.endswith(f"{stem}.{part}") for setting in Config().settings())
        if texts and part not in ("py", "md", "csv", "json") and not settings:
            assert any(re.search(rf"\b{part}\b", text) for text in texts), f"{stem}.{part}"


def test_every_status_is_explained() -> None:
    from garps_core import Status

    text = (ROOT / "docs/troubleshooting.md").read_text("utf-8")
    for status in Status:
        assert f"`{status.value}`" in text
    source = (ROOT / "garps_ros/estimates/outcomes.py").read_text("utf-8")
    (failures,) = [
        node
        for node in ast.parse(source).body
        if isinstance(node, ast.AnnAssign) and ast.unparse(node.target) == "FAILURES"
    ]
    for kind in re.findall(r"'(\w+)'", ast.unparse(failures)):
        assert f"`{kind}`" in text


def test_the_picture_is_small() -> None:
    assert (ROOT / "docs/images/before_after.png").stat().st_size < 400_000
