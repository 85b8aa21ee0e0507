# SPDX-License-Identifier: Apache-2.0
"""Spreads, own successes, all pairs and the common subset of a small table whose every figure is worked out by hand."""

from typing import Any

import numpy as np
import pytest

from bench.scoring.statistics import (
    all_pairs,
    common_subset,
    errors_of,
    length_unit,
    matched,
    median_of_all,
    methods_of,
    own_successes,
    pair_key,
    rows_of,
    scale_sources,
    spread,
)

INF, NAN = float("inf"), float("nan")


def made_row(method: str, pair: str, error: float, e_dir: float = 1.0, **more: Any) -> dict[str, Any]:
    """A pose with E_trans = `error` m, as many degrees and twice as much E_3D; a failure where it is infinite."""
    found = bool(np.isfinite(error))
    row = {"set": "rooms", "pair": pair, "start": "none", "method": method, "depth": "given", "category": "small"}
    row |= {"found": found, "seconds": 1.0, "reason": "" if found else "lost", "scale": "metric", "true_trans_m": 0.5}
    row |= {"e_trans_m": error, "e_rot_deg": error, "e_3d_m": 2 * error}
    return row | ({"e_dir_deg": e_dir, "scale_ratio": 1.0} if found else {}) | more


def table() -> list[dict[str, Any]]:
    """Three methods on four pairs: a fails on p4, b on p2, c on p1; all of them solved p3 alone."""
    errors = {"a": (1.0, 2.0, 6.0, INF), "b": (3.0, INF, 5.0, 4.0), "c": (INF, 9.0, 9.0, 9.0)}
    return [made_row(method, f"p{i + 1}", errors[method][i]) for i in range(4) for method in errors]


def test_the_spread_of_values() -> None:
    found = spread([4, 1, 10, 2, 3])
    # Squares of the distances from 4: 0 + 9 + 36 + 4 + 1 = 50, over n - 1. Quartiles are the 2nd and 4th: 2 and 4.
    assert found == (5, 4, pytest.approx(np.sqrt(50 / 4)), 3, 1)
    assert found._fields == ("n", "mean", "std", "median", "half_iqr")


def test_quartiles_lie_linearly_between_values() -> None:
    # Of 1, 2, 4, 8 the quartiles are at 0.75 and 2.25 steps: 1.75 and 5.
    assert spread([8, 4, 2, 1])[3:] == (3, pytest.approx((5 - 1.75) / 2))


def test_the_spread_leaves_out_what_is_not_finite_and_says_how_many_are_left() -> None:
    assert spread([1, INF, NAN, 3, -INF]) == spread([1, 3]) == (2, 2, pytest.approx(np.sqrt(2)), 2, 0.5)


def test_the_spread_of_too_few_values() -> None:
    one = spread([7.0, NAN])
    assert (one.n, one.mean, one.median, one.half_iqr) == (1, 7, 7, 0) and np.isnan(one.std)
    none = spread([INF, NAN])
    assert none.n == 0 and np.isnan(none[1:]).all()
    assert spread([]).n == 0 and np.isnan(spread([])[1:]).all()


def test_own_successes_flatter_where_pairs_fail() -> None:
    rows = table()
    assert own_successes(rows_of(rows, "a"), "e_trans_m") == (3, 3, pytest.approx(np.sqrt(7)), 2, 1.25)
    assert own_successes(rows_of(rows, "b"), "e_3d_m") == (3, 8, pytest.approx(2), 8, 1)
    assert own_successes(rows_of(rows, "c"), "e_rot_deg") == (3, 9, 0, 9, 0)


def test_all_pairs_count_failures_as_infinite() -> None:
    rows = table()
    # Between the second and the third of 1, 2, 6, inf and of 3, 4, 5, inf.
    assert median_of_all(rows_of(rows, "a"), "e_trans_m") == 4
    assert median_of_all(rows_of(rows, "b"), "e_trans_m") == 4.5
    assert median_of_all(rows_of(rows, "c"), "e_3d_m") == 18
    half = [made_row("d", "p1", 1.0), made_row("d", "p2", INF)]
    assert median_of_all(half, "e_trans_m") == INF
    assert median_of_all([half[1], half[1]], "e_trans_m") == INF
    assert np.isnan(median_of_all([], "e_trans_m"))


def test_all_pairs_of_a_method() -> None:
    rows = [made_row("a", "p1", 1.0, 2.0), made_row("a", "p2", 2.0, 1.0), made_row("a", "p3", 6.0, 3.0)]
    found = all_pairs([*rows, made_row("a", "p4", INF)])
    assert (found.n, found.failures) == (4, 1)
    assert found.medians == {"e_trans_m": 4, "e_rot_deg": 4, "e_3d_m": 8}
    # max(E_rot, E_dir) is 2, 2, 6, inf. The area is 0.25 up to 2, then recall is 0.5: 1.5 more up to 5; or 2.5 more up
    # to 6, then 0.75 of recall up to 10 and 20.
    assert found.auc == pytest.approx([1.75 / 5, 5.75 / 10, 13.25 / 20])
    # Twice below 3..30 deg, once below 7..30.
    assert found.maa == pytest.approx((2 * 28 + 24) / (30 * 4))


def test_all_pairs_give_the_medians_that_are_asked_for() -> None:
    rows = [made_row("a", "p1", 1.0, 20.0), made_row("a", "p2", 2.0, 30.0), made_row("a", "p3", INF)]
    assert all_pairs(rows, ["e_dir_deg"]).medians == {"e_dir_deg": 30}
    nothing = all_pairs([])
    assert (nothing.n, nothing.failures) == (0, 0)
    assert np.isnan([*nothing.medians.values(), *nothing.auc, nothing.maa]).all()


def test_the_common_subset_is_what_all_solved() -> None:
    rows = table()
    shared = common_subset(rows)
    assert [(row["method"], row["pair"]) for row in shared] == [("a", "p3"), ("b", "p3"), ("c", "p3")]
    two = common_subset(rows, ["b", "a"])
    assert [(row["method"], row["pair"]) for row in two] == [("a", "p1"), ("b", "p1"), ("a", "p3"), ("b", "p3")]
    # Over their own successes they have means of 3 and 4: p2, which a alone solved, was an easy pair for it.
    assert [own_successes(rows_of(two, name), "e_trans_m").mean for name in "ab"] == [3.5, 4]
    assert common_subset(rows, ["c"]) == [row for row in rows if row["method"] == "c" and row["found"]]


def test_the_common_subset_of_a_method_without_poses_is_empty() -> None:
    assert common_subset([*table(), made_row("d", "p3", INF)]) == []
    assert common_subset(table(), ["a", "not run"]) == []
    assert common_subset(table(), []) == common_subset([]) == []


@pytest.mark.parametrize("key", ["depth", "set", "start", "pair"])
def test_pairs_of_different_tables_are_not_the_same(key: str) -> None:
    ours, theirs = made_row("a", "p1", 1.0), made_row("b", "p1", 2.0)
    assert common_subset([ours, theirs]) == [ours, theirs] and matched([ours, theirs], "a", "b") == [(ours, theirs)]
    other = theirs | {key: "another"}
    assert common_subset([ours, other]) == [] == matched([ours, other], "a", "b")


def test_a_row_that_does_not_say_its_depth_is_of_none() -> None:
    row = made_row("a", "p1", 1.0, depth="sensor", set="s", start="features")
    assert pair_key(row) == ("sensor", "s", "features", "p1")
    del row["depth"]
    assert pair_key(row) == ("", "s", "features", "p1")


def test_matched_rows_are_of_pairs_that_both_ran_on_failures_too() -> None:
    rows = [row for row in table() if (row["method"], row["pair"]) != ("b", "p3")]
    found = matched(rows[::-1], "a", "b")
    assert [(a["method"], b["method"]) for a, b in found] == [("a", "b")] * 3
    assert [(a["pair"], b["pair"]) for a, b in found] == [("p4", "p4"), ("p2", "p2"), ("p1", "p1")]
    assert [(a["e_trans_m"], b["e_trans_m"]) for a, b in found] == [(INF, 4), (2, INF), (1, 3)]
    assert matched(rows, "a", "not run") == []


def test_errors_that_are_not_defined_are_left_out_and_n_says_so() -> None:
    rows = [
        made_row("a", "p1", 1.0, e_3d_m=NAN),
        made_row("a", "p2", 2.0, e_3d_m=None),
        made_row("a", "p3", 3.0),
        made_row("a", "p4", 4.0),
        made_row("a", "p5", INF, e_3d_m=None),
    ]
    del rows[3]["e_3d_m"]
    np.testing.assert_array_equal(errors_of(rows, "e_3d_m"), [NAN, NAN, 6, NAN, INF])
    assert own_successes(rows, "e_3d_m").n == 1 and own_successes(rows, "e_trans_m").n == 4
    assert median_of_all(rows[:4], "e_3d_m") == 6
    assert median_of_all(rows, "e_3d_m") == INF  # of 6 and infinity
    assert np.isnan(median_of_all(rows[:2], "e_3d_m"))
    # A failure has neither a direction nor a length, and counts as infinite all the same.
    np.testing.assert_array_equal(errors_of(rows[3:], "e_dir_deg"), [1, INF])


def test_methods_and_their_rows_are_in_order_of_appearance() -> None:
    rows = [made_row(method, pair, 1.0) for pair, method in (("p2", "b"), ("p2", "a"), ("p1", "a"), ("p1", "b"))]
    assert methods_of(rows) == ["b", "a"]
    assert [row["pair"] for row in rows_of(rows, "a")] == ["p2", "p1"]
    assert rows_of(rows, "c") == []


def test_the_unit_of_lengths_is_raw_where_a_truth_is() -> None:
    metric = [made_row("a", "p1", 1.0, scale="depth x1.20"), made_row("a", "p2", 1.0, scale="depth x0.80")]
    assert scale_sources(metric) == ["depth"] and length_unit(metric) == "m"
    unknown = made_row("a", "p3", 1.0)
    del unknown["scale"]
    assert scale_sources([*metric, unknown]) == ["depth", "not stated"]
    assert length_unit([*metric, unknown]) == "m"
    assert length_unit([*metric, made_row("a", "p4", 1.0, scale="raw")]) == "raw"
