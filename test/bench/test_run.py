# SPDX-License-Identifier: Apache-2.0
"""The evaluation bench on two small pairs in the pairs.json layout: every method, twice the same, stopped, resumed."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import typer
from bench_command import called, write_rooms
from dask_cluster import running_cluster
from typer.testing import CliRunner

pytest.importorskip("embreex")

from bench import repeat, run
from bench.pairs import sources
from bench.pairs.readers.pairs_json import read_pairs
from bench.peers.methods import METHODS
from garps_core import Config, View

pytestmark = pytest.mark.usefixtures("one_thread")
TIMES = ("seconds",)


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two pairs with depth, and one without."""
    place = write_rooms(tmp_path_factory.mktemp("data") / "small_rooms")
    records = json.loads((place / "pairs.json").read_text())["pairs"]
    blind = {name: value for name, value in records[0].items() if not name.startswith("depth")}
    (place / "pairs.json").write_text(json.dumps({"pairs": [*records, blind | {"id": "blind"}]}))
    return place


def rows_in(out: Path) -> list[dict]:
    rows = json.loads((out / "run.json").read_text())["rows"]
    return [{name: value for name, value in row.items() if not name.startswith(TIMES)} for row in rows]


def test_every_method_runs_and_twice_the_same(folder: Path, tmp_path: Path) -> None:
    for library in ("open3d", "small_gicp", "kiss_matcher", "pycolmap", "cpd_pytorch"):
        pytest.importorskip(library)
    words = ["--data", f"pairs={folder}", "--depth", "sensor", "--starts", "disturbed", "--methods", "garps,peers"]
    words += ["--workers", "1", "--out"]
    code, printed = called(*words, tmp_path / "first")
    assert code == 0, printed
    assert "small_rooms, depth sensor: 1 pairs come without it for both views" in printed
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
    words = ["--data", f"pairs={folder}", "--depth", "sensor,monocular,demo_net", "--starts", "none", "--workers", "1"]
    words += ["--methods", "garps", "--out", str(tmp_path)]
    assert called(*words)[0] == 0
    whole = rows_in(tmp_path)
    assert [(row["depth"], row["pair"]) for row in whole if row["method"] == "garps"] == [
        *(("sensor", f"room{n}") for n in (7, 8)),
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
    words = ["--data", f"pairs={folder}", "--depth", "sensor,demo_net", "--starts", "disturbed", "--methods", "garps"]
    assert called(*words, "--workers", "1", "--out", tmp_path / "here")[0] == 0
    with running_cluster(tmp_path) as (address, _):
        code, printed = called(*words, "--scheduler", address, "--out", tmp_path / "there")
    assert code == 0, printed
    assert rows_in(tmp_path / "there") == rows_in(tmp_path / "here")


def test_settings_come_from_a_file(folder: Path, tmp_path: Path) -> None:
    (tmp_path / "mine.yaml").write_text("alignment.effective_measurements: 12.5\n")
    for depth, preset in (("sensor", "sensor"), ("demo_net", "demo_net")):
        changes = {"reconstruction.method": "rgbd", "alignment.effective_measurements": 12.5, "lifting.stride": 4}
        found = run.config_for(depth, tmp_path / "mine.yaml", ["lifting.stride=4"])
        assert found == Config.preset(preset).replace(changes)


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["--methods", "nobody"], "no method nobody: expected some of ablations, peers, garps"),
        (["--depth", "guess"], "no depth guess: expected some of sensor"),
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


def test_a_mistake_costs_no_rows(folder: Path, tmp_path: Path) -> None:
    """Neither one that is noticed late, nor a run over one that is there."""
    words = ["--data", f"pairs={folder}", "--depth", "sensor,sensor", "--starts", "features,features"]
    words += ["--methods", "sift-pnp", "--workers", "1", "--out", str(tmp_path)]
    assert called(*words)[0] == 0
    rows = (tmp_path / "rows.jsonl").read_text()
    assert len(rows.splitlines()) == 3 and len(rows_in(tmp_path)) == 4, "each once, although named twice"
    for wrong in (["--half", "third"], ["--data", "pairs=[/nowhere]"], ["--data", f"pairs={folder}"]):
        code, printed = called(*words, *wrong)
        assert code == 2 and "Traceback" not in printed
        assert (tmp_path / "rows.jsonl").read_text() == rows
    assert "2 pairs are there twice" in printed or "3 pairs are there twice" in printed
    assert called(*words, "--seed", "1")[0] == 0
    assert (tmp_path / "rows.previous.jsonl").read_text() == rows


def test_only_missing_starts_are_run_again(folder: Path, tmp_path: Path) -> None:
    words = ["--data", f"pairs={folder}", "--depth", "sensor", "--starts", "features,identity", "--methods", "sift-pnp"]
    words += ["--workers", "1", "--out", str(tmp_path)]
    assert called(*words)[0] == 0
    whole = rows_in(tmp_path)
    lines = (tmp_path / "rows.jsonl").read_text().splitlines()
    half = json.dumps([row for row in json.loads(lines[1]) if row["start"] == "features"])
    (tmp_path / "rows.jsonl").write_text("\n".join([lines[0], half, lines[2]]) + "\n")
    assert called(*words, "--resume")[0] == 0
    key = ("pair", "start", "method")
    assert sorted(rows_in(tmp_path), key=lambda row: [row[k] for k in key]) == sorted(
        whole, key=lambda row: [row[k] for k in key]
    )


def test_the_names_are_listed() -> None:
    code, printed = called("--list")
    assert code == 0 and "garps-isotropic: balls of the same volume" in printed and "peers: all of" in printed


def test_depth_of_a_network_needs_its_weights(folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("GARPS_WEIGHTS", str(tmp_path))
    words = ["--data", f"pairs={folder}", "--depth", "depth_anything_v2", "--out", str(tmp_path / "out")]
    code, printed = called(*words)
    assert code == 2 and "no depth_anything weights in" in printed


def test_a_network_that_is_not_there_leaves_the_others_alone(
    folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("GARPS_WEIGHTS", str(tmp_path))
    words = ["--data", f"pairs={folder}", "--depth", "depth_anything_v2,sensor", "--starts", "features", "--methods"]
    code, printed = called(*words, "garps", "--workers", "1", "--out", tmp_path / "out")
    assert code == 0 and "left out: depth depth_anything_v2: no depth_anything weights in" in printed, printed
    assert {row["depth"] for row in rows_in(tmp_path / "out")} == {"sensor"}
    assert "- depth depth_anything_v2: no depth_anything weights" in (tmp_path / "out" / "table.md").read_text()


def test_a_pair_without_depth_is_failures(folder: Path) -> None:
    """A picture that the network cannot take: far too narrow."""
    pair = read_pairs("rooms", folder, 1)[0]
    narrow = View(np.zeros((480, 32, 3), np.uint8), pair.source.K)
    job = run.Job("demo_net", ("none", "features"), replace(pair, source=narrow), Config(), ("garps", "sift-pnp"), 0)
    made = run.job_rows(job)
    assert [[row["method"] for row in rows] for rows in made] == [["(start)", "garps", "sift-pnp"]] * 2
    assert all(not row["found"] and row["reason"].startswith("no depth: ") for rows in made for row in rows)


def test_what_is_run_by_default(folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Sets of which every pair has depth; each from its own starts, with its own depths."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "dev" / "with").mkdir(parents=True)
    records = json.loads((folder / "pairs.json").read_text())["pairs"]
    (tmp_path / "dev" / "with" / "pairs.json").write_text(json.dumps({"pairs": records[:2]}))
    (tmp_path / "dev" / "without").mkdir()
    (tmp_path / "dev" / "without" / "pairs.json").write_text(json.dumps({"pairs": records}))
    found = sources.sources_there(tmp_path)
    assert found == ["pairs=dev/with", "bare=out/bare_rooms", "rooms=out/learned_rooms"]
    assert [sources.defaults_of(source) for source in found] == [
        (("sensor", "monocular", "demo_net"), ("features", "disturbed", "identity")),
        (("monocular",), ("none", "disturbed")),
        (("demo_net",), ("features", "disturbed", "none")),
    ]
    assert sources.defaults_of("mapfree=x") == (("sensor",), ("none", "disturbed"))


def test_two_runs_are_compared(folder: Path, tmp_path: Path) -> None:
    words = ["--data", f"pairs={folder}", "--depth", "sensor", "--starts", "disturbed", "--workers", "1"]
    words += ["--methods", "garps,sift-pnp", "--out"]
    assert called(*words, tmp_path / "a")[0] == called(*words, tmp_path / "b", "--limit", "2")[0] == 0
    found = repeat.differences(repeat.rows_in(tmp_path / "a"), repeat.rows_in(tmp_path / "b"))
    assert found == dict.fromkeys(("(start)", "garps", "sift-pnp"), repeat.Differences(1, 0, 0.0))
    app = typer.Typer()
    app.command()(repeat.main)
    assert CliRunner().invoke(app, [str(tmp_path / "a"), str(tmp_path / "b")]).exit_code == 0
    assert called(*words, tmp_path / "b", "--seed", "1")[0] == 0
    other = CliRunner().invoke(app, [str(tmp_path / "a"), str(tmp_path / "b")])
    assert (
        other.exit_code == 1
        and "| sift-pnp | 2 | 0 | 0 |" in other.output
        and "| (start) | 2 | 0 | 0.1" in other.output
    )
    none = CliRunner().invoke(app, [str(tmp_path / "a"), str(tmp_path / "nowhere")])
    assert none.exit_code == 2 and "give the --out of a run" in none.output


def test_methods_that_need_no_start_run_once(folder: Path, tmp_path: Path) -> None:
    words = ["--data", f"pairs={folder}", "--depth", "sensor", "--starts", "features,identity", "--workers", "1"]
    words += ["--limit", "1", "--methods", "sift-pnp,small-gicp", "--out"]
    assert called(*words, tmp_path / "both")[0] == 0
    rows = json.loads((tmp_path / "both" / "run.json").read_text())["rows"]
    seconds = {name: {row["seconds"] for row in rows if row["method"] == name} for name in ("sift-pnp", "small-gicp")}
    assert {name: len(values) for name, values in seconds.items()} == {"sift-pnp": 1, "small-gicp": 2}
    assert [row["start"] for row in rows if row["method"] == "sift-pnp"] == ["features", "identity"]


def test_peers_of_an_earlier_run_are_taken_over(folder: Path, tmp_path: Path) -> None:
    words = ["--data", f"pairs={folder}", "--depth", "sensor", "--starts", "disturbed", "--workers", "1"]
    words += ["--methods", "garps,small-gicp", "--out"]
    assert called(*words, tmp_path / "first")[0] == 0
    earlier = tmp_path / "first" / "run.json"
    code, printed = called(*words, tmp_path / "again", "--reuse-peers", earlier)
    assert code == 0, printed
    assert "2 of 2 rows of peers, times included, were not run anew" in " ".join(printed.split())
    of = {
        out: {row["pair"]: row for row in rows_in(tmp_path / out) if row["method"] == "small-gicp"}
        for out in ("first", "again")
    }
    assert all(row.pop("reused") for row in of["again"].values())
    assert of["again"] == of["first"]
    code, printed = called(*words, tmp_path / "first", "--reuse-peers", earlier)
    assert code == 2 and "would be overwritten" in printed
