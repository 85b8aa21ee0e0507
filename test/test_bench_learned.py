# SPDX-License-Identifier: Apache-2.0
"""The bench on learned depth: its pairs, the errors of depth maps, what it says of methods; pairs go through it."""

import json
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

pytest.importorskip("embreex")

import typer

from bench import learned, learned_rooms
from bench.depth_data import FIRST_SEED
from bench.depth_errors import depth_errors, depth_table
from bench.learned import bars, differences
from bench.learned_rooms import KINDS, SPLITS, kind_of, level_of
from bench.rooms import LEVELS
from bench.train_depth import HELD_OUT_SEED
from garps_core.models.demo_net import shipped

pytestmark = pytest.mark.usefixtures("one_thread")


def row(pair: str, start: str, method: str, error: float) -> dict:
    return {"pair": pair, "start": start, "method": method, "e_3d_m": error, "found": bool(np.isfinite(error))}


def rows_of(start: str, ours: list[float], theirs: list[float]) -> list[dict]:
    found = []
    for i, (a, b) in enumerate(zip(ours, theirs, strict=True)):
        found += [row(f"p{i}", start, "garps", a), row(f"p{i}", start, "(start)", b)]
    return found


def test_no_seed_is_shared_with_the_training() -> None:
    used = [set(seeds) for seeds in SPLITS.values()] + [set(range(HELD_OUT_SEED, HELD_OUT_SEED + 1000))]
    assert not used[0] & used[1] and not used[2] & (used[0] | used[1])
    assert max(map(max, used)) < FIRST_SEED and len(SPLITS["report"]) == 200


def test_every_level_comes_in_every_kind() -> None:
    found = {(kind_of(seed), level_of(seed)) for seed in SPLITS["report"]}
    assert found == {(kind, level) for kind in KINDS for level in LEVELS}


def test_depth_errors_by_hand() -> None:
    true = np.array([[1.0, 2.0, np.nan, 4.0]], np.float32)
    found = depth_errors(np.array([[1.1, 2.2, 3.0, 8.8]], np.float32), true)
    assert found.abs_rel == pytest.approx((0.1 + 0.1 + 1.2) / 3, rel=1e-5)
    assert found.delta == pytest.approx(2 / 3)
    assert found.log_scale == pytest.approx(np.log(1.1), rel=1e-5)
    assert found.shape == pytest.approx(1 / 3, rel=1e-4)
    with pytest.raises(ValueError, match="no pixel has both depths"):
        depth_errors(np.full((2, 2), np.nan, np.float32), np.ones((2, 2), np.float32))


def test_a_pair_without_a_pose_keeps_its_start() -> None:
    rows = rows_of("disturbed", [0.1, float("inf"), 0.1], [0.3, 0.2, 0.3])
    found = differences(rows, "disturbed")
    assert found["mean"].value == pytest.approx((0.1 + 0.2 + 0.1) / 3 - 0.8 / 3)
    assert found["median"].value == pytest.approx(0.1 - 0.3)


def test_the_bars_tell_sure_from_unsure() -> None:
    rng = np.random.default_rng(0)
    start = rng.uniform(0.1, 0.2, 60)
    better, level, worse = 0.5 * start, start[::-1], 1.5 * start
    for ours, met in ((better, True), (level, False), (worse, False)):
        assert [bar.met for bar in bars(rows_of("disturbed", list(ours), list(start)))] == [met, met]
    for ours, met in ((better, True), (level, True), (worse, False)):
        assert [bar.met for bar in bars(rows_of("features", list(ours), list(start)))] == [met, met]


def test_a_pair_goes_through_all_of_it(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(learned_rooms.SPLITS, "tune", range(91_000, 91_002))
    app = typer.Typer()
    app.command()(learned.main)
    words = ["--split", "tune", "--methods", "garps,sift-pnp", "--workers", "1"]
    words += ["--rooms", str(tmp_path / "rooms"), "--out", str(tmp_path / "out")]
    first = CliRunner().invoke(app, words)
    assert first.exit_code == 0, first.output
    run = json.loads((tmp_path / "out" / "run.json").read_text())
    assert {(r["pair"], r["start"]) for r in run["rows"]} == {
        (f"room{seed}_level{level_of(seed)}", start) for seed in (91_000, 91_001) for start in learned.METHODS_OF
    }
    assert {r["depth"] for r in run["rows"]} == {"demo_net"}
    table = (tmp_path / "out" / "table.md").read_text()
    assert "| rich | 4 |" in table and "E_3D surely lower than the start's" in table
    lines = (tmp_path / "out" / "rows.jsonl").read_text().splitlines()
    (tmp_path / "out" / "rows.jsonl").write_text("\n".join(lines[:-1]) + "\n")  # as if it had been stopped
    again = CliRunner().invoke(app, [*words, "--resume"])
    assert again.exit_code == 0, again.output
    resumed = json.loads((tmp_path / "out" / "run.json").read_text())["rows"]
    key = ["pair", "start", "method"]
    of = {tuple(r[k] for k in key): r["T"] for r in run["rows"] if r["found"]}
    assert {tuple(r[k] for k in key): r["T"] for r in resumed if r["found"]} == of


@pytest.mark.parametrize("words", [["--methods", "nobody"], ["--split", "none"], ["--starts", "nowhere"]])
def test_mistakes_are_one_line(words: list[str], tmp_path: Path) -> None:
    app = typer.Typer()
    app.command()(learned.main)
    found = CliRunner().invoke(app, [*words, "--out", str(tmp_path)])
    assert found.exit_code == 2 and "Traceback" not in found.output and "expected" in found.output


def test_the_table_tells_common_from_own_scale(monkeypatch: pytest.MonkeyPatch) -> None:
    """Two maps of a pair that are off by the same factor, another from pair to pair."""
    from bench import depth_errors as module
    from bench.datasets import Pair
    from garps_core import View

    K = np.diag([50.0, 50.0, 1.0])
    true = np.full((16, 16), 2.0, np.float32)
    view = View(np.zeros((16, 16, 3), np.uint8), K, true)
    pairs = [Pair("rooms", f"p{i}", "rich", view, view, np.eye(4), np.zeros((0, 3))) for i in range(40)]
    factors = iter(np.exp(np.random.default_rng(0).normal(0, 0.1, 40)).astype(np.float32))

    def same_factor(network, views):
        factor = next(factors)
        return [view.depth * factor for view in views]

    monkeypatch.setattr(module, "depth_of", same_factor)
    cells = depth_table(pairs, shipped()).splitlines()[-1].split("|")
    assert float(cells[7]) == pytest.approx(0.1, abs=0.03) and float(cells[8]) == 0
