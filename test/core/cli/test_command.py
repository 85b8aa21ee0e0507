# SPDX-License-Identifier: Apache-2.0
"""The `garps` command as a user meets it: summaries, JSON, exit codes, one-line errors."""

from __future__ import annotations

import importlib.metadata
import importlib.util
import json
from pathlib import Path

import cv2
import numpy as np
import pytest
from box_room import K_WORDS, START, TRUTH, room
from scipy.spatial.transform import Rotation

from garps_core.cli import command, doctor
from garps_core.geometry import se3_log
from garps_core.types import PoseEstimate, Prior, Status


@pytest.fixture(scope="module")
def files(tmp_path_factory: pytest.TempPathFactory) -> dict[str, str]:
    """A pair of images with depth: source at the room's frame, target moved by TRUTH."""
    folder = tmp_path_factory.mktemp("pair")
    paths = {}
    for name, T in (("source", np.eye(4)), ("target", TRUTH)):
        rgb, depth = room(T)
        paths[name], paths[f"{name}_mm"] = str(folder / f"{name}.png"), str(folder / f"{name}_mm.png")
        paths[f"{name}_m"] = str(folder / f"{name}.npy")
        cv2.imwrite(paths[name], rgb[:, :, ::-1])
        cv2.imwrite(paths[f"{name}_mm"], np.rint(depth * 1000).astype(np.uint16))
        np.save(paths[f"{name}_m"], depth)
    return paths


def arguments(files: dict[str, str], *more: str, unit: str = "mm") -> list[str]:
    depths = ["--depth-source", files[f"source_{unit}"], "--depth-target", files[f"target_{unit}"]]
    return ["align", files["source"], files["target"], *K_WORDS, *depths, "--prior", START, *more]


@pytest.mark.parametrize("unit", ["mm", "m"])
def test_json_holds_the_true_pose(files: dict[str, str], capsys: pytest.CaptureFixture[str], unit: str) -> None:
    code = command.main(arguments(files, "--json", unit=unit))
    out = json.loads(capsys.readouterr().out)
    assert code == (0 if out["ok"] else 1)
    T = np.array(out["T_target_source"])
    error = se3_log(T @ np.linalg.inv(TRUTH))
    assert np.linalg.norm(error[:3]) < 0.01
    assert np.degrees(np.linalg.norm(error[3:])) < 0.5
    assert np.shape(out["covariance"]) == (6, 6)
    np.testing.assert_allclose(Rotation.from_quat(out["quaternion_xyzw"]).as_matrix(), T[:3, :3], atol=1e-12)
    assert out["initial"]["origin"] == "given and features"
    assert set(out["seconds"]) >= {"reconstruct", "initialise", "align"}


def test_the_summary_tells_a_person(files: dict[str, str], capsys: pytest.CaptureFixture[str]) -> None:
    command.main(arguments(files))
    out = capsys.readouterr().out
    for word in ("status", "translation", "sigma", "rotation", "quaternion", "start", "overlap", "time"):
        assert word in out


def test_picture_and_splats_are_written(files: dict[str, str], tmp_path: Path) -> None:
    pytest.importorskip("matplotlib")
    command.main(arguments(files, "--figure", str(tmp_path / "pair.png"), "--ply", str(tmp_path / "splats")))
    assert (tmp_path / "pair.png").stat().st_size > 10_000
    assert {p.name for p in (tmp_path / "splats").iterdir()} == {"source.ply", "target.ply", "aligned.ply"}


def without(words: list[str], option: str, count: int = 1) -> list[str]:
    i = words.index(option)
    return words[:i] + words[i + 1 + count :]


MISTAKES = {
    "missing file": (lambda f: ["align", "none.png", *arguments(f)[2:]], "none.png"),
    "text for an image": (lambda f: ["align", __file__, *arguments(f)[2:]], "no image"),
    "folder for an image": (lambda f: ["align", str(Path(__file__).parent), *arguments(f)[2:]], "cannot read"),
    "colour for depth": (lambda f: arguments(f, "--depth-source", f["source"]), "one channel"),
    "zero scale": (lambda f: arguments(f, "--depth-scale", "0"), "depth scale"),
    "millimetres as metres": (lambda f: arguments(f, "--depth-scale", "1"), "millimetres"),
    "three numbers for K": (lambda f: [*without(arguments(f), "--K", 4), "--K", "1", "2", "3"], "--K"),
    "word in K": (lambda f: [*without(arguments(f), "--K", 4), "--K", "1", "2", "3", "four"], "--K"),
    "zero focal length": (lambda f: [*without(arguments(f), "--K", 4), "--K", "0", "2", "3", "4"], "focal"),
    "infinite K": (lambda f: arguments(f, "--K-target", "inf", "2", "3", "4"), "--K-target: K holds"),
    "no K": (lambda f: without(arguments(f), "--K", 4), "--K"),
    "six numbers for a prior": (lambda f: arguments(f, "--prior", "0 0 0 0 0 1"), "expected 7"),
    "word in the prior": (lambda f: arguments(f, "--prior", "a 0 0 0 0 0 1"), "expected 7"),
    "NaN in the prior": (lambda f: arguments(f, "--prior", "nan 0 0 0 0 0 1"), "finite"),
    "zero quaternion": (lambda f: arguments(f, "--prior", "0 0 0 0 0 0 0"), "quaternion of length 0"),
    "negative sigma": (lambda f: arguments(f, "--prior-sigma", "-1 0.1"), "positive"),
    "sigma alone": (lambda f: [*without(arguments(f), "--prior"), "--prior-sigma", "1 1"], "without --prior"),
    "unknown preset": (lambda f: arguments(f, "--preset", "fast"), "expected one of default"),
    "setting with a typo": (lambda f: arguments(f, "--set", "lifting.strid=2"), "did you mean 'lifting.stride'"),
    "setting without value": (lambda f: arguments(f, "--set", "lifting.stride"), "NAME=VALUE"),
    "setting out of range": (lambda f: arguments(f, "--set", "lifting.stride=0"), "lifting.stride is 0"),
    "fraction for an integer": (lambda f: arguments(f, "--set", "lifting.stride=1.5"), "an integer"),
    "neither true nor false": (lambda f: arguments(f, "--set", "start.identity_fallback=maybe"), "true or false"),
    "the ladder": (lambda f: arguments(f, "--set", "alignment.ladder=1"), "cannot be set"),
    "unknown device": (lambda f: arguments(f, "--device", "toaster"), "toaster"),
    "unknown option": (lambda f: arguments(f, "--colour", "red"), "--colour"),
    "unknown command": (lambda f: ["polish"], "polish"),
}


@pytest.mark.parametrize("name", MISTAKES)
def test_a_mistake_is_one_line_and_code_2(files: dict[str, str], capsys: pytest.CaptureFixture[str], name: str) -> None:
    words, expected = MISTAKES[name]
    assert command.main(words(files)) == 2
    captured = capsys.readouterr()
    assert captured.out == ""
    assert captured.err.startswith("garps: error: ")
    assert captured.err.count("\n") == 1
    assert expected in captured.err


def test_files_that_do_not_fit_are_named(
    files: dict[str, str], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    small, broken, pickled = (str(tmp_path / name) for name in ("small.npy", "broken.npy", "pickled.npy"))
    np.save(small, np.ones((60, 80), np.float32))
    Path(broken).write_bytes(b"\x93NUMPY garbage")
    np.save(pickled, np.array([{"a": 1}], dtype=object), allow_pickle=True)
    empty = tmp_path / "empty.png"
    empty.touch()
    for path, expected in ((small, "60x80"), (broken, "no plain .npy"), (pickled, "no plain .npy"), (empty, "0 bytes")):
        assert command.main(arguments(files, "--depth-target", str(path))) == 2
        err = capsys.readouterr().err
        assert str(path) in err
        assert expected in err


def test_no_pose_is_code_1_with_the_reason(
    files: dict[str, str], tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    none = PoseEstimate(Status.NO_INITIAL_POSE, "4 matches, 12 are needed")
    monkeypatch.setattr(command.Estimator, "estimate_with_mixtures", lambda *_: (none, None))
    assert command.main(arguments(files, "--figure", str(tmp_path / "a.png"))) == 1
    captured = capsys.readouterr()
    assert "no_initial_pose: 4 matches" in captured.out
    assert "no picture" in captured.err
    assert not (tmp_path / "a.png").exists()
    assert command.main(arguments(files, "--json")) == 1
    out = json.loads(capsys.readouterr().out)
    assert out["T_target_source"] is None
    assert out["objective"] is None


def test_a_prior_is_read_in_ros_quaternion_order(files: dict[str, str], monkeypatch: pytest.MonkeyPatch) -> None:
    seen: list[Prior] = []

    def keep(_self: object, _source: object, _target: object, prior: Prior, _maps: None) -> tuple[PoseEstimate, None]:
        seen.append(prior)
        return PoseEstimate(Status.NO_INITIAL_POSE, ""), None

    monkeypatch.setattr(command.Estimator, "estimate_with_mixtures", keep)
    quarter = "-1 2 3 0 0 0.70710678 0.70710678"
    assert command.main([*without(arguments(files), "--prior"), "--prior", quarter, "--prior-sigma", "0.2 0.1"]) == 1
    T = seen[0].T_target_source
    np.testing.assert_allclose(T[:3, :3] @ (1, 0, 0), (0, 1, 0), atol=1e-7)
    np.testing.assert_allclose(T[:3, 3], (-1, 2, 3))
    np.testing.assert_allclose(np.sqrt(np.diag(seen[0].covariance)), [0.2] * 3 + [0.1] * 3)


def test_help_version_and_doctor(capsys: pytest.CaptureFixture[str]) -> None:
    assert command.main(["--version"]) == 0
    assert capsys.readouterr().out.startswith("garps 0.")
    assert command.main(["align", "--help"]) == 0
    assert "Example:" in capsys.readouterr().out
    assert command.main(["doctor"]) == 0
    out = capsys.readouterr().out
    for word in ("python", "torch", "rclpy", "devices", "memory", "self-test       ok"):
        assert word in out


def test_doctor_names_what_networks_need(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv("GARPS_WEIGHTS", str(tmp_path / "none"))
    assert doctor.weights() == f"none, in {tmp_path / 'none'}"
    monkeypatch.setenv("GARPS_WEIGHTS", str(tmp_path))
    for file in ("depth_anything_v2_metric_vkitti_vits.pth", "dinov2-small-hf.safetensors", "other.pth"):
        (tmp_path / file).touch()
    real = importlib.util.find_spec
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None if name == "huggingface_hub" else real(name))
    assert command.main(["doctor"]) == 0
    told = dict(line.split(None, 1) for line in capsys.readouterr().out.splitlines())
    assert told["weights"] == f"depth-anything-v2-outdoor-small, dinov2-small-hf, in {tmp_path}"
    assert told["safetensors"] == importlib.metadata.version("safetensors")
    assert told["huggingface_hub"] == "not installed (garps weights fetch)"
