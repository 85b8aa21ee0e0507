# SPDX-License-Identifier: Apache-2.0
"""The command that chooses pairs of RealEstate10K: lists, scale by a network's depth, evaluated by the bench."""

import json
from pathlib import Path

import cv2
import numpy as np
import pytest
import typer
from bench_command import called as run_called
from clips import motion, write_frames, write_sparse, write_track
from typer.testing import CliRunner

from bench import sample

pytestmark = pytest.mark.usefixtures("one_thread")


def called(*words: object) -> tuple[int, str]:
    app = typer.Typer()
    app.command()(sample.main)
    found = CliRunner().invoke(app, [str(word) for word in words])
    assert found.exception is None or isinstance(found.exception, SystemExit), found.exception
    return found.exit_code, " ".join(found.output.split())


@pytest.fixture
def clips(tmp_path: Path) -> Path:
    for clip, metres in (("a", 0.1), ("b", 0.9)):
        write_track(tmp_path, clip, motion(3, (metres, 0, 0)))
        write_frames(tmp_path, clip)
        write_sparse(tmp_path, clip, factor=1.0)
    return tmp_path


def test_a_list_is_written_once(clips: Path) -> None:
    code, printed = called(clips, "--each", 1)
    assert code == 0 and "pairs_test.jsonl: 1 small, 1 large, scale raw, seed 0" in printed
    code, printed = called(clips, "--each", 1)
    assert code == 2 and "a list is written once" in printed


def test_metres_of_a_network_are_named_and_reach_the_rows(clips: Path, tmp_path: Path) -> None:
    """Depth maps of frame 0 are made where missing; those of somebody else are not taken for the network's."""
    code, printed = called(clips, "--each", 1, "--depth", "demo_net")
    assert code == 2 and "holds depth maps (somebody else's), not of demo_net" in printed
    for clip in "ab":
        (clips / "depth" / clip / "0.png").unlink()
    (clips / "cameras" / "test" / "broken.txt").write_text("https://example.org\n1 2 3\n")
    (clips / "cameras" / "test" / "empty.txt").write_text("https://example.org\n")
    code, printed = called(clips, "--each", 1, "--depth", "demo_net")
    assert code == 2 and "broken.txt:2" in printed, printed
    code, printed = called(clips, "--each", 1, "--depth", "demo_net", "--skip")
    assert code == 0 and "scale sfm-depth:demo_net" in printed, printed
    made = cv2.imread(str(clips / "depth" / "b" / "0.png"), cv2.IMREAD_UNCHANGED)
    assert made.dtype == np.uint16 and made.min() > 0
    words = ["--data", f"realestate10k={clips}", "--depth", "demo_net", "--starts", "disturbed", "--methods", "garps"]
    code, printed = run_called(*words, "--workers", "1", "--out", tmp_path / "out")
    assert code == 0, printed
    rows = json.loads((tmp_path / "out" / "run.json").read_text())["rows"]
    assert {row["scale"].partition(" x")[0] for row in rows} == {"sfm-depth:demo_net"}
    assert all(np.isfinite(row["e_3d_m"]) for row in rows if row["found"]), "of the points that the depth gives"
    assert "Scale of the truth: realestate10k: sfm-depth:demo_net." in (tmp_path / "out" / "table.md").read_text()


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["--depth", "guess"], "--depth is 'guess', --scale 'raw': expected one of depth_anything_v2, demo_net"),
        (["--scale", "feet"], "scale is 'feet': expected one of raw, sfm-depth"),
        (["--scale", "raw:x"], "scale is 'raw:x': expected one of raw, sfm-depth"),
        (["--split", "all"], "split is 'all': expected one of test, validation"),
        (["--each", "5"], "4 small and 4 large pairs are wanting"),
    ],
)
def test_mistakes_are_one_line(words: list[str], message: str, clips: Path) -> None:
    code, printed = called(clips, *words)
    assert code == 2 and message in printed and "Traceback" not in printed


def test_maps_that_are_there_are_kept(clips: Path) -> None:
    kept = (clips / "depth" / "a" / "0.png").read_bytes()
    (clips / "depth" / "made_by.txt").write_text("demo_net\n")
    (clips / "depth" / "b" / "0.png").unlink()
    code, printed = called(clips, "--each", 1, "--depth", "demo_net")
    assert code == 0, printed
    assert (clips / "depth" / "a" / "0.png").read_bytes() == kept
    assert (clips / "depth" / "b" / "0.png").is_file()


def test_clips_that_cannot_be_used_are_named(clips: Path) -> None:
    (clips / "frames" / "b" / "0.png").unlink()
    write_track(clips, "d", motion(3, (0.8, 0, 0)))
    write_frames(clips, "d")
    write_track(clips, "c", motion(3, (0.8, 0, 0)))
    code, printed = called(clips, "--each", 1)
    assert code == 2 and "missing:" in printed
    code, printed = called(clips, "--each", 1, "--skip", "--seed", 1)
    assert code == 0 and "1 small, 1 large" in printed and "left out: " in printed
