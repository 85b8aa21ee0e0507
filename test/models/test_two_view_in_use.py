# SPDX-License-Identifier: Apache-2.0
"""`garps align` with MASt3R and DUSt3R: files of the published layout, reduced and random, so no pose may come out."""

import json
import logging
import os
from argparse import Namespace
from fractions import Fraction
from functools import partial
from pathlib import Path
from typing import Any

import cv2
import pytest
import torch
from box_room import K_WORDS
from network_weights import DEPTH, FLASH3D, install, install_reduced, passes, reduced_tensors, shared, write_pair
from safetensors.torch import save_file
from small_mask2former import ADAPTER, HEAD, random_state

from garps_core import Config
from garps_core.cli import command
from garps_core.config import PRESETS
from garps_core.config.start import TWO_VIEW
from garps_core.models import depth_anything, two_view_in_use
from garps_core.models.mask2former import Mask2Former
from garps_core.models.mast3r import NaverModel
from garps_core.models.two_view import PatchEmbed
from garps_core.weights.manifest import ALL, BY_NAME, SHARE_ALIKE
from garps_core.weights.reader import read_tensors

MAST3R, PTH = "mast3r", "mast3r-pth"
DUST3R = ("dust3r-dpt", "dust3r-linear", "dust3r-linear-224")
Captured = pytest.CaptureFixture[str]
Files = dict[str, str]


pytestmark = pytest.mark.usefixtures("one_thread")


@pytest.fixture(scope="module")
def weights(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return install_reduced(tmp_path_factory.mktemp("weights"), MAST3R, PTH, *DUST3R)


@pytest.fixture(scope="module")
def unsure(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Networks that trust no pixel."""
    return install_reduced(tmp_path_factory.mktemp("unsure"), MAST3R, sureness=-5.0)


@pytest.fixture(scope="module")
def files(tmp_path_factory: pytest.TempPathFactory) -> Files:
    """A pair a, b with depth; and cuts of them, b_tall with depth and a_long without."""
    folder = tmp_path_factory.mktemp("pair")
    paths = write_pair(folder)
    for name, part in (("b", slice(20, 110)), ("b_mm", slice(20, 110))):
        paths[f"{name}_tall"] = str(folder / f"{name}_tall.png")
        cv2.imwrite(paths[f"{name}_tall"], cv2.imread(paths[name], cv2.IMREAD_UNCHANGED)[:, part])
    paths["a_long"] = str(folder / "a_long.png")
    cv2.imwrite(paths["a_long"], cv2.imread(paths["a"])[:17])
    return paths


@pytest.fixture(autouse=True)
def installed(weights: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """All are there, and look at small pictures."""
    monkeypatch.setenv("GARPS_WEIGHTS", str(weights))
    monkeypatch.setattr(two_view_in_use, "NaverModel", partial(NaverModel, long_side=128))


def depths(files: Files, target: str = "b") -> list[str]:
    return ["--depth-source", files["a_mm"], "--depth-target", files[f"{target}_mm" if target == "b" else "b_mm_tall"]]


def aligned(capsys: Captured, files: Files, *words: str, target: str = "b") -> dict[str, Any]:
    """The answer, which is no pose: code 1, in numbers that are finite (JSON has no others here)."""
    capsys.readouterr()
    code = command.main(["align", files["a"], files[target], *words, "--json"])
    captured = capsys.readouterr()
    assert code == 1, captured.err
    out: dict[str, Any] = json.loads(captured.out, parse_constant=lambda word: pytest.fail(f"{word} in JSON"))
    assert not out["ok"] and out["quality"] < 0.1
    assert out["T_target_source"] is None and out["covariance"] is None, "random parameters know no pose"
    assert out["initial"] is None
    return out


def refused(capsys: Captured, files: Files, *words: str, source: str = "a") -> str:
    """The one line that a mistake is answered with."""
    capsys.readouterr()
    assert command.main(["align", files[source], files["b"], *words]) == 2
    captured = capsys.readouterr()
    assert captured.err.count("\n") == 1 and captured.out == "" and "Traceback" not in captured.err
    return captured.err


def with_weights(*words: str) -> list[str]:
    return [part for word in words for part in ("--set", f"start.{word}")]


NO_FIT = "trusted pixels fit one pose: expected at least 20%"


@pytest.mark.parametrize("name", [MAST3R, PTH])
def test_two_pictures_and_nothing_else(files: Files, name: str, capsys: Captured) -> None:
    """Depth of both views and a try at the pose from one look at the pair; both layouts say the same."""
    with passes(PatchEmbed) as seen:
        out = aligned(capsys, files, "--preset", "mast3r", *K_WORDS, *with_weights(f"weights={name}"))
        assert seen == [(2, 3, 96, 128)]
    assert out["status"] == "no_initial_pose"
    assert out["reason"].startswith("mast3r: source first: ") and NO_FIT in out["reason"]
    assert set(out["seconds"]) >= {"depth", "reconstruct"}
    assert out["estimated_fx_px"] == [None, None]


def test_both_layouts_hold_the_same_network(weights: Path) -> None:
    one, other = (read_tensors(weights / BY_NAME[name].local, kind=MAST3R).tensors for name in (MAST3R, PTH))
    second = other.keys() - one.keys()
    assert len(second) == 8 and all(".scratch.layer_rn." in key for key in second)
    assert all(torch.equal(one[key], other[key]) for key in one)


@pytest.mark.parametrize(
    "words",
    [
        ["--preset", "mast3r"],
        ["--start", "mast3r", "depths"],
        ["--start", "dust3r", "depths"],
        ["--preset", "paper_full"],
    ],
    ids=["mast3r", "start", "dust3r", "paper"],
)
def test_without_intrinsics_it_says_that_they_could_not_be_told(
    files: Files, words: list[str], capsys: Captured
) -> None:
    """Random points tell of no lens that there is, which is no mistake in what was typed."""
    more = depths(files) if words[-1] == "depths" else []
    out = aligned(capsys, files, *(word for word in words if word != "depths"), *more)
    name = "dust3r" if "dust3r" in words else MAST3R
    assert out["status"] == "no_initial_pose"
    assert out["reason"].startswith(f"no --K, and none by {name}: a focal length of ")
    assert "for an image of 160x120: expected 32 to 1600" in out["reason"]


@pytest.mark.parametrize("name", [MAST3R, *DUST3R])
@pytest.mark.parametrize("target", ["b", "b_tall"], ids=["of one size", "of two"])
def test_a_start_with_depth_files(files: Files, name: str, target: str, capsys: Captured) -> None:
    kind = BY_NAME[name].kind
    principal = ["--K-target", "150", "150", "59.5", "59.5"] if target == "b_tall" else []
    words = [*K_WORDS, *principal, *depths(files, target), "--start", kind, *with_weights(f"weights={name}")]
    out = aligned(capsys, files, *words, target=target)
    assert out["status"] == "no_initial_pose"
    assert out["reason"].startswith(f"{kind}: source first: ") and out["reason"].count(NO_FIT) == 2
    seen = {"b": [768, 768], "b_tall": [768, 768]}[target] if name != "dust3r-linear-224" else [3136, 3136]
    for count in seen:
        assert f" of {count} trusted pixels" in out["reason"]


def test_matches_of_descriptors(files: Files, capsys: Captured) -> None:
    words = [*K_WORDS, *with_weights("pose_from=matches")]
    for more in (["--preset", "mast3r"], [*depths(files), "--start", "mast3r", "--set", "start.scale=depth"]):
        out = aligned(capsys, files, *words, *more)
        assert out["status"] == "no_initial_pose" and " fit one pose: expected at least 8" in out["reason"]
    assert "dust3r has no descriptors: expected maps" in refused(
        capsys, files, *words, *depths(files), "--start", "dust3r"
    )


def test_the_published_pipeline_whole(
    files: Files, weights: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: Captured
) -> None:
    """Four networks of random parameters, that of the labels reduced too."""
    install(tmp_path, DEPTH, FLASH3D)
    torch.save(random_state(Mask2Former(ADAPTER, HEAD)), tmp_path / "m2f.pth")
    monkeypatch.setenv("GARPS_WEIGHTS", str(tmp_path))
    monkeypatch.setattr(depth_anything, "SHORT_SIDE", 70)
    given = ["--set", f"reconstruction.semantic_weights={tmp_path / 'm2f.pth'}"]
    given += with_weights(f"weights={weights / 'mast3r.safetensors'}")
    out = aligned(capsys, files, "--preset", "paper_full", *K_WORDS, *given)
    assert out["status"] == "no_initial_pose" and NO_FIT in out["reason"]
    assert out["seconds"]["reconstruct"] > 0


def test_a_network_that_is_sure_of_nothing(
    files: Files, unsure: Path, monkeypatch: pytest.MonkeyPatch, capsys: Captured
) -> None:
    monkeypatch.setenv("GARPS_WEIGHTS", str(unsure))
    out = aligned(capsys, files, *K_WORDS, "--preset", "mast3r")
    assert out["status"] == "no_mixture"
    assert out["reason"].startswith("mast3r gives 0 of 19200 pixels of the source depth of which it is surer than 3: ")
    out = aligned(capsys, files, *K_WORDS, "--start", "mast3r", *depths(files))
    assert out["status"] == "no_initial_pose"
    assert (
        out["reason"].count("0 of 768 pixels are surer than 3: expected at least 100; do the pictures share any") == 2
    )
    out = aligned(capsys, files, *K_WORDS, "--preset", "mast3r", *with_weights("min_confidence=0.5"))
    assert out["status"] == "no_initial_pose" and NO_FIT in out["reason"]


def test_what_is_not_finite_is_a_status(files: Files, tmp_path: Path, capsys: Captured) -> None:
    """Huge weights overflow; such as are no numbers are refused with the file."""
    held, last = reduced_tensors(MAST3R), "downstream_head2.dpt.head.4.bias"
    for name, value in (("huge", 1e30), ("nan", torch.nan)):
        save_file(held | {last: torch.full((4,), value)}, tmp_path / f"{name}.safetensors")
    words = with_weights(f"weights={tmp_path / 'huge.safetensors'}")
    for more, status in (
        (["--preset", "mast3r", *K_WORDS], "no_mixture"),
        (["--preset", "mast3r"], "no_initial_pose"),
        (["--start", "mast3r", *K_WORDS, *depths(files)], "no_initial_pose"),
    ):
        out = aligned(capsys, files, *more, *words)
        assert out["status"] == status and "the network returned NaN or infinity in torch.float32" in out["reason"]
    said = refused(
        capsys, files, "--preset", "mast3r", *K_WORDS, *with_weights(f"weights={tmp_path / 'nan.safetensors'}")
    )
    assert f"{last} has 4 of 4 values that are not finite" in said


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["--preset", "mast3r", "--start", "dust3r", "K"], "the points of dust3r have no metres: expected mast3r"),
        (["--preset", "mast3r", "--start", "dust3r"], "the points of dust3r have no metres: expected mast3r"),
        (["--start", "dust3r", "K", "depths", "scale=network"], "and dust3r has no metres: expected auto or depth"),
        (
            ["--preset", "mast3r", "--start", "features", "K"],
            "expected a two-view network to start with, one of mast3r",
        ),
        (["--preset", "mast3r", "--start", "auto", "K"], "expected a two-view network to start with, one of mast3r"),
        (["--preset", "monocular", "--reconstruction", "two_view", "K"], "and start.method is auto: expected a two-v"),
        (["--preset", "default", "--reconstruction", "two_view", "--start", "mast3r", "K"], "would be too small"),
        (
            ["--preset", "mast3r", "K", "weights=dust3r-dpt"],
            "dust3r-dpt are weights of dust3r: expected some of mast3r",
        ),
        (["--start", "dust3r", "K", "depths", "weights=mast3r"], "mast3r are weights of mast3r: expected some of dust"),
        (
            ["--preset", "mast3r", "K", "weights=FOLDER/dust3r-linear.safetensors"],
            "linear head: expected weights of ma",
        ),
        (
            ["--start", "dust3r", "K", "depths", "weights=FOLDER/mast3r.safetensors"],
            "holds MASt3R: expected weights of",
        ),
        (["--preset", "mast3r", "K", "weights=mast3r-224"], "did you mean 'mast3r'"),
        (["--preset", "monocular"], "--K is missing: expected FX FY CX CY in pixels"),
        (
            ["--preset", "mast3r", "--start", "features"],
            "or a two-view network that can estimate it, --start mast3r or",
        ),
        (
            ["--start", "adapter", "K", "depths", "adapter=my_model"],
            "start.adapter is 'my_model': expected the name of",
        ),
        (
            ["--preset", "sensor", "--start", "mast3r", "K", "scale=depth"],
            "the view has no depth: expected HxW float32",
        ),
    ],
)
def test_mistakes_are_one_line(files: Files, weights: Path, words: list[str], message: str, capsys: Captured) -> None:
    given: list[str] = []
    for word in words:
        setting = with_weights(word.replace("FOLDER", str(weights))) if "=" in word else [word]
        given += {"K": K_WORDS, "depths": depths(files)}.get(word, setting)
    assert message in refused(capsys, files, *given)


def test_what_is_not_installed_is_said_with_what_to_type(
    files: Files, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: Captured
) -> None:
    monkeypatch.setenv("GARPS_WEIGHTS", str(tmp_path))
    for words, name in (
        (["--preset", "mast3r", *K_WORDS], MAST3R),
        (["--preset", "mast3r"], MAST3R),
        (["--start", "dust3r", *depths(files), *K_WORDS], "dust3r-dpt"),
        (["--start", "dust3r", *depths(files), *with_weights("weights=dust3r-linear-224")], "dust3r-linear-224"),
        (["--preset", "mast3r", *with_weights("weights=mast3r-pth")], PTH),
    ):
        assert f"run `garps weights fetch {name}`" in refused(capsys, files, *words)
    capsys.readouterr()
    assert command.main(["weights", "fetch", MAST3R]) == 2
    assert f"{SHARE_ALIKE}: read it (" in (said := capsys.readouterr().err)
    assert "repeat with --accept-licence mast3r" in said


def test_a_picture_that_is_too_long_is_said(files: Files, tmp_path: Path, capsys: Captured) -> None:
    long = {**files, "a": files["a_long"]}
    for words in ([*K_WORDS, "--preset", "mast3r"], ["--preset", "mast3r"]):
        assert "160x17 pixels: expected at least 16x16, and at most 8 to 1. Crop" in refused(capsys, long, *words)


class Hostile:
    """A class that no pickle may bring."""


@pytest.mark.parametrize("words", [["--preset", "mast3r"], ["--preset", "mast3r", *K_WORDS]])
def test_a_file_with_another_class_is_not_opened(
    files: Files, tmp_path: Path, words: list[str], capsys: Captured
) -> None:
    held = reduced_tensors("dust3r-linear-224")
    for kind, args in (("Hostile", Hostile()), ("Fraction", Fraction(1, 3))):
        torch.save({"args": Namespace(lr=args), "model": held}, tmp_path / "mine.pth")
        said = refused(capsys, files, *words, *with_weights(f"weights={tmp_path / 'mine.pth'}"))
        assert "holds an object of class" in said and kind in said and "nothing of it was loaded" in said
    (tmp_path / "mine.pth").write_bytes(b"\x80\x04not even a zip file")
    assert "is a bare pickle" in refused(capsys, files, *words, *with_weights(f"weights={tmp_path / 'mine.pth'}"))


def test_the_licence_is_told_as_weights_are_loaded(
    files: Files, weights: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    """A renamed file is recognised, too."""
    for path in weights.iterdir():
        os.link(path, tmp_path / path.name)
    os.link(weights / "mast3r.safetensors", tmp_path / "renamed.safetensors")
    monkeypatch.setenv("GARPS_WEIGHTS", str(tmp_path))
    for name in (MAST3R, PTH, *DUST3R, str(tmp_path / "renamed.safetensors")):
        kind = BY_NAME[name].kind if name in BY_NAME else MAST3R
        with caplog.at_level(logging.WARNING, "garps_core"):
            shared().two_view(Config().replace({"start.method": kind, "start.weights": name}))
        (told,) = [record for record in caplog.records if record.name == "garps_core"]
        assert told.levelno == logging.WARNING
        file = BY_NAME[name].local if name in BY_NAME else "renamed.safetensors"
        assert told.getMessage() == f"licence of the weights {file}: {SHARE_ALIKE}"
        caplog.clear()


def test_no_preset_but_two_asks_for_what_is_not_free() -> None:
    """By name: whoever takes another preset gets weights that anybody may use, or none."""
    two_view = {weights.kind for weights in ALL if weights.kind in TWO_VIEW}
    assert two_view == {"mast3r", "dust3r"}
    assert all("non-commercial" in weights.licence for weights in ALL if weights.kind in two_view)
    for name in PRESETS:
        config = Config.preset(name)
        asks = {config.start.method, config.reconstruction.method} & {*TWO_VIEW, "two_view", "flash3d"}
        assert bool(asks) == (name in ("mast3r", "paper_full")), name


def test_no_other_preset_opens_a_file_of_them(files: Files, monkeypatch: pytest.MonkeyPatch, capsys: Captured) -> None:
    """Though they are installed."""

    def opened(*given: object) -> None:
        pytest.fail(f"asked for {given}")

    monkeypatch.setattr(two_view_in_use, "load_weights", opened)
    for name in PRESETS:
        if name not in ("mast3r", "paper", "paper_full"):
            assert command.main(["align", files["a"], files["b"], *K_WORDS, *depths(files), "--preset", name]) in (0, 1)


@pytest.mark.parametrize("name", [PTH, *DUST3R])
def test_a_converted_file_is_the_same_network(
    files: Files, weights: Path, tmp_path: Path, name: str, capsys: Captured
) -> None:
    """The file has another name, with its kind, licence and variant inside; `check` knows it."""
    source, target, kind = weights / BY_NAME[name].local, tmp_path / "mine.safetensors", BY_NAME[name].kind
    assert command.main(["weights", "convert", str(source), str(target)]) == 0
    printed = capsys.readouterr().out
    assert printed.count("left out: 4 tensors of downstream_head") == (2 if name == PTH else 0)
    assert f"licence as before: {SHARE_ALIKE}" in printed
    read = read_tensors(target)
    assert read.metadata["kind"] == kind and read.metadata.get("variant", "") == BY_NAME[name].variant
    words = [*K_WORDS, *depths(files), "--start", kind]
    answers = [aligned(capsys, files, *words, *with_weights(f"weights={of}"))["reason"] for of in (name, str(target))]
    assert answers[0] == answers[1]
    if name == "dust3r-linear":
        assert command.main(["weights", "check", str(target)]) == 1
        assert "DUSt3R with a linear head, encoder 128 x 2, decoder 64 x 4, no descr" in capsys.readouterr().out
