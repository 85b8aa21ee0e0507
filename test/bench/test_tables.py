# SPDX-License-Identifier: Apache-2.0
"""Figures, acceptance bars and resuming of the accuracy benchmark, fed with made rows."""

import json

import numpy as np
import pytest

from bench.pairs import sources
from bench.peers.methods import METHODS
from bench.report import acceptance, run_tables
from bench.rows import pair_rows, row_log
from bench.scoring import summary

INF = float("inf")


def made_row(method, e_3d=0.01, *, depth="sensor", set="hololens_lounge", start="disturbed", pair="a", **more):
    found = np.isfinite(e_3d)
    row = {"depth": depth, "set": set, "pair": pair, "category": "small", "start": start, "method": method}
    row |= {"found": bool(found), "seconds": 0.1, "reason": "", "e_trans_m": e_3d, "e_3d_m": e_3d}
    return row | {"e_rot_deg": 10 * e_3d if found else INF, "e_c_m": e_3d} | more


@pytest.mark.parametrize("seed", range(5))
def test_auc_counts_pairs_of_right_and_wrong(seed):
    rng = np.random.default_rng(seed)
    scores, right = rng.integers(0, 6, 40) / 5, rng.random(40) < 0.6
    counted = [(a > b) + 0.5 * (a == b) for a in scores[right] for b in scores[~right]]
    assert summary.roc_auc(scores, right) == pytest.approx(np.mean(counted))


def test_auc_is_undefined_where_there_is_nothing_to_tell_apart():
    assert np.isnan(summary.roc_auc([0.1, 0.9], [True, True]))
    assert "undefined, all are right" in summary.quality_auc([made_row("garps", quality=0.4)])[1]
    assert "undefined, all are wrong" in summary.quality_auc([made_row("garps", INF, quality=0.4)])[1]
    assert "no quality" in summary.quality_auc([made_row("garps"), made_row("garps", INF)])[1]


def test_failures_have_quality_zero():
    rows = [made_row("garps", 0.01, quality=0.3), made_row("garps", INF, quality=0.9)]
    value, text = summary.quality_auc(rows)
    assert value == 1
    assert text == "1.000 (1 of 2 within 5 cm and 2 deg)"


def test_tables_are_grouped_by_depth_and_set_with_confidence_below():
    order = [("sensor", "b"), ("monocular", "b"), ("sensor", "a"), ("sensor", "b")]
    rows = []
    for i, (depth, name) in enumerate(order):
        rows.append(made_row("garps", depth=depth, set=name, start=f"s{i}", nees=5.0 + 10 * (i == 3), quality=0.5))
    text = run_tables.markdown(rows, {"reused_peers": "1 of 2 rows of peers were taken."})
    marks = ["sensor depth, b, start: s0", "sensor depth, b, start: s3", "sensor depth, b, all starts"]
    marks += ["sensor depth, a, start: s2", "sensor depth, all sets and starts", "monocular depth, b, start: s1"]
    places = [text.index(mark) for mark in marks]
    assert places == sorted(places)
    assert "NEES: 67 % within the 95 % bound (n = 3)" in text
    assert "taken" in text
    assert text.count("all sets and starts") == 2


def full_rows(garps=0.01, peers=0.02):
    """Every table of a full run, one right GARPS and as many worse peers."""
    rows = []
    for depth in ("sensor", "monocular"):
        tables_of_depth = [("hololens_lounge", start) for start in sources.BY_DEFAULT[sources.PAIRS][1]]
        if depth == "monocular":
            tables_of_depth += [("bare_rooms", start) for start in sources.BY_DEFAULT[sources.BARE][1]]
        for name, start in tables_of_depth:
            where = {"depth": depth, "set": name, "start": start}
            for k in range(20):
                where["category"] = "large" if k % 2 else "small"
                bad = k == 19  # one wrong, so that there is something to order
                own = {"nees": 20.0 if bad else 5.0, "quality": 0.2 if bad else 0.8, "status": "converged"}
                rows.append(made_row("(start)", 0.12, pair=str(k), **where))
                rows.append(made_row("garps", 0.3 if bad else garps, pair=str(k), **where, **own))
                for method in METHODS:
                    far = name == "bare_rooms" or k > 16
                    rows.append(made_row(method, 0.4 if far else peers, pair=str(k), **where))
    for start in ("features", "disturbed"):
        where = {"depth": "demo_net", "set": "learned_rooms", "start": start}
        for k in range(20):
            rows += [made_row("(start)", 0.12, pair=str(k), **where), made_row("garps", garps, pair=str(k), **where)]
    return rows


def test_acceptance_is_met_by_rows_that_are_better_everywhere():
    found = acceptance.bars(full_rows())
    failed = [bar for bar in found if not bar.met and "P90 of E_3D <= that of (start)" not in bar.asked]
    assert failed == []
    assert len(found) == 3 + 2 + 4 + 4 + 4 + 4
    assert found[0].numbers == "0.01 against 0.02 m (open3d-gicp)"


@pytest.mark.parametrize(
    ("asked", "spoil"),
    [
        ("sensor, hololens_lounge, disturbed: median E_3D", {"garps": 0.03}),
        ("sensor, hololens_lounge, identity: success", {"garps": 0.06}),
        ("monocular, hololens_lounge, disturbed: median E_3D", {"garps": 0.05}),
        ("monocular, hololens_lounge, features: median E_3D <= that of sift-pnp", {"garps": 0.03}),
        ("monocular, bare_rooms, none: success", {"garps": 0.26}),
        ("monocular, bare_rooms, none, large motions: success", {"garps": 0.26}),
        ("monocular, bare_rooms, disturbed: median E_3D", {"garps": 0.08}),
        ("monocular: AUC", {"garps": 0.06}),
    ],
)
def test_acceptance_is_missed_where_a_figure_is_too_large(asked, spoil):
    (bar,) = [bar for bar in acceptance.bars(full_rows(**spoil)) if bar.asked.startswith(asked)]
    expected = "not run" if "AUC" in asked else "no"
    assert acceptance.answer(bar) == expected, bar
    assert f"| {bar.asked} | {bar.numbers} | {expected} |" in acceptance.markdown_bars([bar])


def test_acceptance_needs_all_rows():
    rows = [row for row in full_rows() if row["method"] != "rgbd-hybrid"]
    missing = {bar.asked for bar in acceptance.bars(rows) if bar.met is None}
    assert missing == {
        f"sensor, hololens_lounge, disturbed: {name} best registration" for name in ("median E_3D <=", "success >=")
    }
    assert {acceptance.answer(bar) for bar in acceptance.bars([])} == {"not run"}


def test_resume_goes_on_and_refuses_other_settings(tmp_path):
    options = {"seed": 0, "settings": {"sensor": {"start.method": "auto"}}}
    log = row_log.RowLog(tmp_path, options)
    log.add([made_row("garps", INF), made_row("(start)", 0.1)])
    log.add([made_row("garps", pair="b")])
    with log.path.open("a") as file:
        file.write('[{"depth": "sen')  # torn
    again = row_log.RowLog(tmp_path, options, resume=True)
    assert again.rows == log.rows
    assert again.done == {("sensor", "hololens_lounge", "disturbed", pair) for pair in "ab"}
    again.add([made_row("garps", pair="c")])
    assert len(row_log.RowLog(tmp_path, options, resume=True).rows) == 4
    other = {"seed": 1, "settings": {"sensor": {"start.method": "identity"}}}
    with pytest.raises(ValueError, match=r"seed was 0, is 1; settings.sensor.start.method was 'auto', is 'identity'"):
        row_log.RowLog(tmp_path, other, resume=True)
    assert row_log.RowLog(tmp_path, options, resume=True).rows
    assert row_log.RowLog(tmp_path, options).rows == []
    with pytest.raises(ValueError, match="nothing to resume"):
        row_log.RowLog(tmp_path / "new", options, resume=True)


def test_damage_within_the_rows_is_told(tmp_path):
    log = row_log.RowLog(tmp_path, {})
    log.path.write_text("{}\n[{\n[]\n")
    with pytest.raises(ValueError, match="damaged in line 2"):
        row_log.RowLog(tmp_path, {}, resume=True)


def test_only_rows_that_owe_nothing_to_garps_are_reused(tmp_path):
    rows = [
        made_row("open3d-gicp", INF), made_row("garps"), made_row("(start)"), made_row("garps-no-features"),
        made_row("open3d-gicp", start="features"), made_row("sift-pnp", start="features"),
    ]  # fmt: skip
    run_tables.write(tmp_path, rows, {"seed": 0, "commit": "abc"})
    known = row_log.reusable_rows(tmp_path / "run.json", 0)
    assert {key[2]: list(found) for key, found in known.items()} == {
        "disturbed": ["open3d-gicp"],
        "features": ["sift-pnp"],
    }
    assert known["sensor", "hololens_lounge", "disturbed", "a"]["open3d-gicp"] == {**rows[0], "reused": "abc"}
    with pytest.raises(ValueError, match="made with seed 0, not 1"):
        row_log.reusable_rows(tmp_path / "run.json", 1)
    (tmp_path / "old.json").write_text(json.dumps({"facts": {"seed": 0}, "rows": [{"method": "garps"}]}))
    with pytest.raises(ValueError, match="rows without depth"):
        row_log.reusable_rows(tmp_path / "old.json", 0)
    with pytest.raises(ValueError, match=r"no run\.json"):
        row_log.reusable_rows(tmp_path / "none.json", 0)


def test_known_rows_of_peers_are_taken_over():
    from bench.pairs import bare_rooms
    from garps_core import Config

    pair = bare_rooms.room_pair(22, 1, 160, 120)
    known = {"open3d-gicp": made_row("open3d-gicp", reused="abc")}
    methods = ["garps", "garps-no-features", "open3d-gicp"]
    rows = pair_rows.rows_of_pair(Config.preset("monocular"), pair, "none", methods, known=known)
    assert [row["method"] for row in rows] == ["(start)", "garps", "open3d-gicp"]
    assert rows[2] is known["open3d-gicp"]
    assert rows[1]["status"] and "quality" in rows[1]
    disturbed = pair_rows.rows_of_pair(Config.preset("monocular"), pair, "disturbed", methods[:2])
    assert [row["method"] for row in disturbed] == ["(start)", *methods[:2]]
