# SPDX-License-Identifier: Apache-2.0
"""The bench on learned depth: its pairs, the errors of depth maps, what is asked of GARPS on it."""

from dataclasses import replace

import numpy as np
import pytest

pytest.importorskip("embreex")

from bench.pairs.learned_rooms import KINDS, SPLITS, kind_of, level_of
from bench.pairs.pair import Pair
from bench.report.acceptance import Bar, bars, differences
from bench.report.depth_tables import depth_tables
from bench.rooms import LEVELS
from bench.rows.depth_errors import depth_errors, errors_of_pair
from bench.train_depth import HELD_OUT_SEED
from bench.training.rooms import FIRST_SEED
from garps_core import View

PLACE = {"depth": "demo_net", "set": "learned_rooms", "category": "rich", "seconds": 0.1, "reason": ""}


def row(pair: str, start: str, method: str, error: float) -> dict:
    found = {"pair": pair, "start": start, "method": method, "found": bool(np.isfinite(error))}
    return PLACE | found | dict.fromkeys(("e_3d_m", "e_trans_m", "e_rot_deg"), error)


def rows_of(start: str, ours: list[float], theirs: list[float]) -> list[dict]:
    found = []
    for i, (a, b) in enumerate(zip(ours, theirs, strict=True)):
        found += [row(f"p{i}", start, "garps", a), row(f"p{i}", start, "(start)", b)]
    return found


def learned_bars(rows: list[dict]) -> list[Bar]:
    return [bar for bar in bars(rows) if bar.asked.startswith("demo_net") and bar.met is not None]


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
    found = differences(rows, ("demo_net", "learned_rooms", "disturbed"))
    assert found["mean"].value == pytest.approx((0.1 + 0.2 + 0.1) / 3 - 0.8 / 3)
    assert found["median"].value == pytest.approx(0.1 - 0.3)


def test_the_bars_tell_sure_from_unsure() -> None:
    rng = np.random.default_rng(0)
    start = rng.uniform(0.1, 0.2, 60)
    better, level, worse = 0.5 * start, start[::-1], 1.5 * start
    for ours, met in ((better, True), (level, False), (worse, False)):
        assert [bar.met for bar in learned_bars(rows_of("disturbed", list(ours), list(start)))] == [met, met]
    for ours, met in ((better, True), (level, True), (worse, False)):
        assert [bar.met for bar in learned_bars(rows_of("features", list(ours), list(start)))] == [met, met]


def test_the_table_tells_common_from_own_scale() -> None:
    """Two maps of a pair that are off by the same factor, another from pair to pair."""
    view = View(np.zeros((16, 16, 3), np.uint8), np.diag([50.0, 50.0, 1.0]), np.full((16, 16), 2.0, np.float32))
    true = Pair("rooms", "p", "rich", view, view, np.eye(4), np.zeros((0, 3)))
    rows = []
    for i, factor in enumerate(np.exp(np.random.default_rng(0).normal(0, 0.1, 40)).astype(np.float32)):
        off = replace(view, depth=view.depth * factor)
        found = errors_of_pair(replace(true, source=off, target=off), true)
        rows += [row(f"p{i}", start, "garps", 0.1) | {"depth_errors": found} for start in ("none", "disturbed")]
    text = depth_tables([*rows, row("p0", "none", "garps", 0.1) | {"set": "other", "depth_errors": None}])
    assert text.count("**Errors of") == 1 and "| all | 80 |" in text
    cells = next(line for line in text.splitlines() if line.startswith("| all")).split("|")
    assert float(cells[7]) == pytest.approx(0.1, abs=0.03) and float(cells[8]) == 0


def test_a_map_without_readings_has_no_errors() -> None:
    view = View(np.zeros((16, 16, 3), np.uint8), np.diag([50.0, 50.0, 1.0]), np.full((16, 16), 2.0, np.float32))
    pair = Pair("rooms", "p", "rich", view, view, np.eye(4), np.zeros((0, 3)))
    halves = np.full((2, 16, 16), 2.0, np.float32)
    halves[0, :8], halves[1, 8:] = np.nan, np.nan
    found, true = (replace(pair, target=replace(view, depth=half)) for half in halves)
    assert errors_of_pair(found, true) is None and errors_of_pair(pair, pair) is not None
    assert errors_of_pair(pair, replace(pair, source=replace(view, depth=None))) is None
