# SPDX-License-Identifier: Apache-2.0
"""The evaluation bench on two small pairs in the pairs.json layout: every method, twice the same, stopped, resumed."""

import json
from pathlib import Path

import cv2
import numpy as np
import pytest
import typer
from dask_cluster import running_cluster
from typer.testing import CliRunner

pytest.importorskip("embreex")

from bench import run, sources
from bench.baselines import METHODS
from bench.rooms import make_pair
from garps_core import Config

pytestmark = pytest.mark.usefixtures("one_thread")
TIMES = ("seconds",)


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two pairs with depth, and one without."""
    place = tmp_path_factory.mktemp("data") / "small_rooms"
    place.mkdir()
    records = []
    for seed, level in ((7, 1), (8, 2)):
        made = make_pair(seed, level, width=320, height=240, depth_noise="sensor")
        record = {"id": f"room{seed}", "category": "small", "T_1_0": made.T_1_0.tolist()}
        for k, (rgb, depth, K) in enumerate([(made.rgb0, made.depth0, made.K0), (made.rgb1, made.depth1, made.K1)]):
            record |= {f"image{k}": f"{seed}_{k}.png", f"depth{k}": f"{seed}_{k}_d.png", f"K{k}": K.tolist()}
            cv2.imwrite(str(place / f"{seed}_{k}.png"), rgb[..., ::-1])
            cv2.imwrite(str(place / f"{seed}_{k}_d.png"), np.nan_to_num(1000 * depth).astype(np.uint16))
        records.append(record)
    blind = {name: value for name, value in records[0].items() if not name.startswith("depth")}
    (place / "pairs.json").write_text(json.dumps({"pairs": [*records, blind | {"id": "blind"}]}))
    return place


def called(*words: str) -> tuple[int, str]:
    app = typer.Typer()
    app.command()(run.main)
    found = CliRunner().invoke(app, [str(word) for word in words])
    assert found.exception is None or isinstance(found.exception, SystemExit), found.exception
    return found.exit_code, found.output


def rows_in(out: Path) -> list[dict]:
    rows = json.loads((out / "run.json").read_text())["rows"]
    return [{name: value for name, value in row.items() if not name.startswith(TIMES)} for row in rows]


def test_every_method_runs_and_twice_the_same(folder: Path, tmp_path: Path) -> None:
    for library in ("open3d", "small_gicp", "kiss_matcher", "pycolmap", "cpd_pytorch"):
        pytest.importorskip(library)
    words = ["--data", f"pairs={folder}", "--depth", "given", "--starts", "disturbed", "--methods", "garps,peers"]
    words += ["--workers", "1", "--out"]
    code, printed = called(*words, tmp_path / "first")
    assert code == 0, printed
    assert "small_rooms, depth given: 1 pairs come without depth of both views" in printed
    rows = rows_in(tmp_path / "first")
    assert {row["method"] for row in rows} == {"(start)", "garps", *METHODS}
    assert {row["pair"] for row in rows} == {"room7", "room8"}
    right = {row["method"] for row in rows if row["found"] and row["e_3d_m"] < 0.1}
    assert {"garps", "small-gicp", "open3d-gicp", "sift-pnp"} <= right
    assert called(*words, tmp_path / "second")[0] == 0
    assert rows_in(tmp_path / "second") == rows
    for name in ("rows.csv", "table.md"):
        assert (tmp_path / "first" / name).stat().st_size > 0


def test_a_run_that_was_stopped_goes_on(folder: Path, tmp_path: Path) -> None:
    words = ["--data", f"pairs={folder}", "--depth", "given,monocular,demo_net", "--starts", "none", "--workers", "1"]
    words += ["--methods", "garps", "--out", str(tmp_path)]
    assert called(*words)[0] == 0
    whole = rows_in(tmp_path)
    assert [(row["depth"], row["pair"]) for row in whole if row["method"] == "garps"] == [
        *(("given", f"room{n}") for n in (7, 8)),
        *(("monocular", f"room{n}") for n in (7, 8)),
        *(("demo_net", name) for name in ("room7", "room8", "blind")),
    ]
    lines = (tmp_path / "rows.jsonl").read_text().splitlines()
    (tmp_path / "rows.jsonl").write_text("\n".join(lines[:4]) + "\n" + lines[4][:50])
    assert called(*words, "--resume")[0] == 0
    assert rows_in(tmp_path) == whole
    code, printed = called(*words, "--resume", "--seed", "1")
    assert code == 2 and "was made with other settings" in printed


def test_a_cluster_gives_the_same_rows(folder: Path, tmp_path: Path) -> None:
    pytest.importorskip("distributed")
    words = ["--data", f"pairs={folder}", "--depth", "given,demo_net", "--starts", "disturbed", "--methods", "garps"]
    assert called(*words, "--workers", "1", "--out", tmp_path / "here")[0] == 0
    with running_cluster(tmp_path) as (address, _):
        code, printed = called(*words, "--scheduler", address, "--out", tmp_path / "there")
    assert code == 0, printed
    assert rows_in(tmp_path / "there") == rows_in(tmp_path / "here")


def test_settings_come_from_a_file(folder: Path, tmp_path: Path) -> None:
    (tmp_path / "mine.yaml").write_text("alignment.information: 12.5\n")
    configs = run.configs_of(["given", "demo_net"], tmp_path / "mine.yaml", ["lifting.stride=4"])
    for depth, preset in (("given", "sensor"), ("demo_net", "demo_net")):
        changes = {"reconstruction.method": "rgbd", "alignment.information": 12.5, "lifting.stride": 4}
        assert configs[depth] == Config.preset(preset).replace(changes)


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["--methods", "nobody"], "no method nobody: expected some of ablations, peers, garps"),
        (["--depth", "guess"], "no depth guess: expected some of given"),
        (["--starts", "somewhere"], "no start somewhere: expected some of features"),
        (["--data", "rooms"], "--data is 'rooms': expected NAME=FOLDER"),
        (["--data", "films=x"], "expected NAME=FOLDER, NAME one of pairs"),
        (["--data", "pairs=nowhere"], "No such file"),
        (["--data", "tum=nowhere"], "nowhere is no folder"),
        (["--settings", "none.yaml"], "cannot read settings from none.yaml"),
        (["--resume"], "there is nothing to resume"),
    ],
)
def test_mistakes_are_one_line(words: list[str], message: str, tmp_path: Path) -> None:
    code, printed = called(*words, "--out", str(tmp_path / "new"))
    assert code == 2 and message in printed and "Traceback" not in printed


def test_the_names_are_listed() -> None:
    code, printed = called("--list")
    assert code == 0 and "garps-isotropic: balls of the same volume" in printed and "peers: all of" in printed


def test_depth_of_a_network_needs_its_weights(folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("GARPS_WEIGHTS", str(tmp_path))
    words = ["--data", f"pairs={folder}", "--depth", "depth_anything_v2", "--out", str(tmp_path / "out")]
    code, printed = called(*words)
    assert code == 2 and "no depth_anything weights in" in printed


def test_what_is_run_by_default(tmp_path: Path) -> None:
    (tmp_path / "dev" / "set").mkdir(parents=True)
    (tmp_path / "dev" / "set" / "pairs.json").touch()
    assert sources.sources_there(tmp_path) == [f"pairs={tmp_path / 'dev' / 'set'}", "rooms=out/learned_rooms"]
