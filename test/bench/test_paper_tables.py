# SPDX-License-Identifier: Apache-2.0
"""The Markdown tables in the paper's layout: figures worked out by hand in their cells, the best bold, failures, n."""

import re
from math import comb
from typing import Any

import numpy as np
import pytest
from scipy.stats import binomtest

from bench.report import paper_tables as tables

INF, NAN = float("inf"), float("nan")
Cells = dict[str, dict[str, str]]


def made_row(method: str, pair: str, error: float, **more: Any) -> dict[str, Any]:
    """A pose with E_trans = `error` m, ten times as many degrees and twice as much E_3D; a failure where infinite."""
    found = bool(np.isfinite(error))
    row = {"set": "rooms", "pair": pair, "start": "none", "method": method, "depth": "given", "category": "small"}
    row |= {"found": found, "seconds": 1.0, "reason": "" if found else "lost: no", "scale": "metric"}
    row |= {"true_trans_m": 0.5, "e_trans_m": error, "e_rot_deg": 10 * error, "e_3d_m": 2 * error}
    return row | ({"e_dir_deg": 1.0, "scale_ratio": 1.0} if found else {}) | more


def table() -> list[dict[str, Any]]:
    """GARPS fails on p4, sift-pnp on p2; colmap solves p1 alone, and well."""
    rows = [
        made_row("garps", "p1", 0.1, e_dir_deg=2.0, scale_ratio=0.9, seconds=0.5),
        made_row("garps", "p2", 0.2, e_dir_deg=4.0, scale_ratio=1.2, seconds=0.5),
        made_row("garps", "p3", 0.6, e_dir_deg=8.0, scale_ratio=1.1, seconds=0.5),
        made_row("garps", "p4", INF, seconds=1.5),
        made_row("sift-pnp", "p1", 0.3, e_dir_deg=6.0),
        made_row("sift-pnp", "p2", INF),
        made_row("sift-pnp", "p3", 0.5, e_dir_deg=2.0),
        made_row("sift-pnp", "p4", 0.4, e_dir_deg=4.0),
        made_row("colmap", "p1", 0.05, seconds=10.0),
    ]
    return rows + [made_row("colmap", f"p{i}", INF, seconds=10.0) for i in (2, 3, 4)]


def cells(text: str, key: int = 0) -> Cells:
    """Markdown of one table -> cells by the text of column `key` and by heading."""
    lines = [line.strip("|").split("|") for line in text.splitlines() if line.startswith("|")]
    headings, rule, *body = [[cell.strip() for cell in line] for line in lines]
    assert set(rule) == {"---"} and {len(line) for line in [rule, *body]} == {len(headings)}
    return {line[key]: dict(zip(headings, line, strict=True)) for line in body}


def captioned(text: str, caption: str) -> str:
    """The one table of a longer text whose caption begins so, with its note."""
    (found,) = [part for part in re.split(r"(?m)^(?=\*\*)", text) if part.startswith(f"**{caption}")]
    return found


def without(row: dict[str, Any], *names: str) -> dict[str, Any]:
    return {name: value for name, value in row.items() if name not in names}


def test_means_are_over_own_successes() -> None:
    text = tables.mean_table(table())
    found = cells(text)
    # 0.1, 0.2, 0.6: squares 0.04 + 0.01 + 0.09, over 2; 0.3, 0.5, 0.4: 0.01 over 1.
    assert found["garps"] == {
        "Method": "garps",
        "E_trans (m)": "0.3000 ± 0.2646",
        "E_rot (deg)": "3.000 ± 2.646",
        "E_3D (m)": "0.6000 ± 0.5292",
        "Time (s)": "**0.750**",
        "n poses": "3",
        "Failures": "1",
    }
    assert found["sift-pnp"]["E_trans (m)"] == "0.4000 ± 0.1000" and found["sift-pnp"]["Time (s)"] == "1.000"
    # The paper's layout praises who solves but the easiest pair: hence the counts beside it, and the other tables.
    assert [found["colmap"][name] for name in ("E_3D (m)", "n poses", "Failures")] == ["**0.1000 ± -**", "1", "3"]
    assert "over n - 1" in text and "; own successes**" in text and f"Time: {tables.TIME}." in text


def test_it_is_said_which_pairs_and_what_the_time_is_of() -> None:
    text = tables.mean_table(table(), "some pairs")
    assert (
        text.startswith("**Mean pose errors")
        and "; some pairs**" in text
        and "Time: one call from the images, without the depth" in text
    )


def test_medians_are_over_own_successes() -> None:
    text = tables.median_table(table())
    found = cells(text)
    # Quartiles of 0.1, 0.2, 0.6 are 0.15 and 0.4; of 0.3, 0.4, 0.5 they are 0.35 and 0.45.
    assert found["garps"]["E_trans (m)"] == "0.2000 ± 0.1250"
    assert found["garps"]["E_rot (deg)"] == "2.000 ± 1.250"
    assert found["sift-pnp"]["E_3D (m)"] == "0.8000 ± 0.1000"
    assert found["colmap"]["E_trans (m)"] == "**0.0500 ± 0.0000**"
    assert [found["sift-pnp"][name] for name in ("n poses", "Failures")] == ["3", "1"]
    assert "; own successes**" in text


def test_an_error_that_some_poses_lack_has_its_own_n() -> None:
    rows = [made_row("garps", "p1", 0.1), made_row("garps", "p2", 0.3), made_row("garps", "p3", 0.8, e_3d_m=NAN)]
    for text, shown in ((tables.mean_table(rows), "0.4000 ± 0.2828"), (tables.median_table(rows), "0.4000 ± 0.1000")):
        assert cells(text)["garps"]["E_3D (m)"] == f"**{shown} (n = 2)**"
        assert "n =" not in cells(text)["garps"]["E_trans (m)"] and cells(text)["garps"]["n poses"] == "3"


def test_all_pairs_take_failures_as_infinite() -> None:
    text = tables.all_pairs_table(table())
    found = cells(text)
    # max(E_rot, E_dir) of garps is 2, 4, 8 deg: AUC@5 is 0.25 + 0.75 + 0.5 over 5, AUC@10 is 1 + 2.5 + 1.5 over 10,
    # AUC@20 is 3.5 + 12 * 0.75 over 20; below 3..30, 5..30 and 9..30 deg, of 4 pairs and 30 limits.
    assert found["garps"] == {
        "Method": "garps",
        "E_rot (deg)": "**4.000**",
        "E_dir (deg)": "6.000",
        "AUC@5": "**30.0**",
        "AUC@10": "**50.0**",
        "AUC@20": "**62.5**",
        "mAA(30)": "**63.3**",
        "Length": "1.100",
        "E_trans (m)": "**0.4000**",
        "E_3D (m)": "**0.8000**",
        "n poses": "3",
        "Failures": "1",
    }
    # 4, 5 and 6 deg: 0.5 + 0.25 over 5; 0.5 + 0.375 + 0.625 + 3 over 10; 1.5 + 14 * 0.75 over 20; 26 + 25 + 24 limits.
    shares = [found["sift-pnp"][name] for name in ("AUC@5", "AUC@10", "AUC@20", "mAA(30)")]
    assert shares == ["15.0", "45.0", "60.0", "62.5"]
    assert found["sift-pnp"]["E_dir (deg)"] == "**5.000**" and found["sift-pnp"]["E_trans (m)"] == "0.4500"
    assert [found["colmap"][name] for name in ("E_rot (deg)", "E_trans (m)", "Failures")] == ["∞", "∞", "3"]
    assert "failures at infinity**" in text and "in per cent" in text


def test_equal_figures_as_rounded_are_all_bold() -> None:
    rows = [made_row("a", "p1", 0.10001), made_row("b", "p1", 0.10002), made_row("c", "p1", 0.1003)]
    found = cells(tables.all_pairs_table(rows))
    assert [found[name]["E_trans (m)"] for name in "abc"] == ["**0.1000**", "**0.1000**", "0.1003"]


def test_what_is_infinite_or_not_defined_is_never_the_best() -> None:
    lost = [made_row("a", "p1", INF), made_row("b", "p1", INF)]
    assert [line["E_trans (m)"] for line in cells(tables.all_pairs_table(lost)).values()] == ["∞", "∞"]
    rows = [made_row("a", "p1", 0.1, e_3d_m=NAN), made_row("b", "p1", 0.3), made_row("c", "p1", 0.2)]
    assert [line["E_3D (m)"] for line in cells(tables.all_pairs_table(rows)).values()] == ["-", "0.6000", "**0.4000**"]


def sign_rows(lengths: str = "metric") -> list[dict[str, Any]]:
    """GARPS is better on p1..p5, of which the other fails on p5, worse on p6, equal on p7; both fail on p8."""
    others = (0.2, 0.2, 0.2, 0.2, INF, 0.05, 0.1, INF)
    rows = [made_row("peer", f"p{i}", error, scale=lengths) for i, error in enumerate(others, 1)]
    return rows + [made_row("garps", f"p{i}", 0.1 if i < 8 else INF, scale=lengths) for i in range(1, 9)]


def test_differences_and_their_sign_test() -> None:
    text = tables.difference_table(sign_rows(), error="e_trans_m")
    line = cells(text)["peer"]
    # Over the six pairs that both solved: -0.1 four times, 0.05 once, 0 once.
    assert line["n both"] == "6" and line["Better / worse"] == "5 / 1"
    assert line["Median [95 %]"].startswith("-0.1000 [") and line["Mean [95 %]"].startswith("-0.0583 [")
    low, high = (float(end) for end in line["Mean [95 %]"].partition("[")[2].strip("]").split(", "))
    assert -0.1 <= low < -0.0583 < high <= 0.05
    # Six throws of a coin of which none or one, or five or six, are heads.
    p = 2 * (comb(6, 0) + comb(6, 1)) / 2**6
    assert p == pytest.approx(binomtest(5, 6).pvalue) == pytest.approx(0.21875)
    assert line["Sign test p"] == "0.22"
    assert "E_trans (m) of garps" in text and "negative: garps is better" in text and "two-sided" in text


def test_the_other_way_round_the_differences_change_their_sign() -> None:
    line = cells(tables.difference_table(sign_rows(), "peer", "e_3d_m"))["garps"]
    assert line["Better / worse"] == "1 / 5" and line["Sign test p"] == "0.22"
    assert line["Median [95 %]"].startswith("+0.2000 [") and line["Mean [95 %]"].startswith("+0.1167 [")


def test_differences_of_methods_that_share_no_pose() -> None:
    rows = [made_row("garps", "p1", 0.1), made_row("peer", "p1", INF)]
    line = cells(tables.difference_table(rows))["peer"]
    assert [line[name] for name in ("n both", "Median [95 %]", "Mean [95 %]")] == ["0", "-", "-"]
    assert line["Better / worse"] == "1 / 0" and line["Sign test p"] == "1"
    both_fail = [made_row(method, "p1", INF) for method in ("garps", "peer")]
    line = cells(tables.difference_table(both_fail))["peer"]
    assert line["Better / worse"] == "0 / 0" and line["Sign test p"] == "-"
    assert tables.difference_table([made_row("garps", "p1", 0.1), made_row("peer", "p2", 0.1)]) == ""
    assert tables.difference_table([made_row("peer", "p1", 0.1), made_row("other", "p1", 0.1)]) == ""


def test_categories_have_medians_of_their_own() -> None:
    rows = [row | {"category": "large" if row["pair"] in ("p3", "p4") else "small"} for row in table()]
    rows = [made_row("garps", "p0", 0.7, category="bare"), *rows]
    text = tables.category_table(rows)
    order = [tuple(line.strip("| ").split(" | ")[:2]) for line in text.splitlines() if line.startswith("| ")][1:]
    methods = ["garps", "sift-pnp", "colmap"]
    assert order == [*(("small", name) for name in methods), *(("large", name) for name in methods), ("bare", "garps")]
    large = cells("\n".join(line for line in text.splitlines() if not line.startswith("| small")), key=1)
    assert "| small | garps | **0.1500** | **1.500** | **0.3000** | 2 | 0 |" in text
    assert "| small | sift-pnp | ∞ | ∞ | ∞ | 1 | 1 |" in text
    assert "| small | colmap | ∞ | ∞ | ∞ | 1 | 1 |" in text
    assert "| large | garps | ∞ | ∞ | ∞ | 1 | 1 |" in text
    assert large["sift-pnp"]["E_trans (m)"] == "**0.4500**" and large["sift-pnp"]["n poses"] == "2"
    assert "| bare | garps | **0.7000** | **7.000** | **1.4000** | 1 | 0 |" in text


def test_lengths_are_in_bins_and_an_edge_is_in_the_longer_one() -> None:
    lengths = {"p1": 0.05, "p2": 0.1, "p3": 0.19, "p4": 7.0}
    rows = [row | {"true_trans_m": lengths[row["pair"]]} for row in table()]
    rows.append(without(made_row("garps", "p9", 5.0), "true_trans_m"))
    text = tables.length_table(rows)
    found = cells(text)
    bins = ["0 to 0.1 m (n = 1)", "0.1 to 0.2 m (n = 2)", "from 1 m (n = 1)"]
    assert list(found["garps"]) == ["Method", *bins, "n poses", "Failures"]
    assert [found["garps"][name] for name in bins] == ["0.2000", "**0.8000**", "∞"]
    assert [found["sift-pnp"][name] for name in bins] == ["0.6000", "∞", "**0.8000**"]
    assert [found["colmap"][name] for name in bins] == ["**0.1000**", "∞", "∞"]
    assert found["garps"]["n poses"] == "3" and "4 pairs" in text and text.startswith("**Median E_3D (m) by length")
    other = cells(tables.length_table(rows, "e_rot_deg", (0.0, 1.0)))
    assert other["garps"]["0 to 1 m (n = 3)"] == "**2.000**"
    assert tables.length_table([without(row, "true_trans_m") for row in rows]) == ""


def test_scores_of_map_free() -> None:
    given = {"p1": (0.1, 10.0, 1.0, 0.9), "p2": (0.2, 50.0, 6.0, 0.5), "p3": (0.5, 200.0, 1.0, 0.7)}
    rows = []
    for pair, (e_c, vcre, e_rot, quality) in given.items():
        more = {"e_c_m": e_c, "vcre_px": vcre, "e_rot_deg": e_rot}
        rows += [made_row("garps", pair, 0.1, quality=quality, **more), made_row("peer", pair, 0.1, **more)]
    rows += [made_row(method, "p4", INF, e_c_m=INF, vcre_px=INF) for method in ("garps", "peer")]
    found = cells(tables.map_free_table(rows))
    assert found["garps"]["E_c (m)"] == "**0.3500**" and found["garps"]["VCRE (px)"] == "**125.0**"
    # By falling confidence p1, p3, p2, then the failure: below 90 px are p1 and p2; within 0.25 m and 5 deg p1 alone.
    assert found["garps"]["VCRE < 90 px: precision"] == "**0.500**"
    assert found["garps"]["VCRE < 90 px: AUC"] == f"**{(1 + 1 / 2 + 2 / 3) / 4:.3f}**"
    assert found["garps"]["E_c < 0.25 m, E_rot < 5 deg: precision"] == "**0.250**"
    assert found["garps"]["E_c < 0.25 m, E_rot < 5 deg: AUC"] == f"**{(1 + 1 / 2 + 1 / 3) / 4:.3f}**"
    assert (found["peer"]["VCRE < 90 px: AUC"], found["peer"]["E_c < 0.25 m, E_rot < 5 deg: AUC"]) == ("0.500", "0.250")
    assert tables.map_free_table([*rows, made_row("older", "p1", 0.1)]) == ""


def test_the_note_says_scales_pairs_and_whose_length_is_borrowed() -> None:
    rows = [made_row("garps", "p1", 0.1, scale="depth x1.2"), made_row("garps", "p2", 0.1, scale="raw")]
    rows += [made_row("colmap", "p1", 0.1, scale="depth x1.2"), made_row("sift-pnp", "p1", 0.1, set="hall")]
    rows.append(without(made_row("five-point", "p1", INF, set="yard"), "scale"))
    scales = "rooms: depth, raw; hall: metric; yard: not stated"
    assert tables.note(rows) == f"Scale of the truth: {scales}. 4 pairs. Length of t from depth: colmap, five-point."
    assert tables.note(rows[:1]) == "Scale of the truth: rooms: depth. 1 pairs."


@pytest.mark.parametrize(
    "made",
    [
        tables.mean_table,
        tables.median_table,
        tables.all_pairs_table,
        tables.difference_table,
        tables.category_table,
        tables.length_table,
    ],
)
def test_lengths_of_an_unknown_scale_are_raw(made: Any) -> None:
    text = made(sign_rows("raw"))
    assert re.search(r"E_3D \(raw\)", text) and "(m)" not in text and " m (n" not in text
    assert "Scale of the truth: rooms: raw. 8 pairs." in text
    assert re.search(r"E_3D \(m\)", made(sign_rows())) and "rooms: metric. 8 pairs." in made(sign_rows())
    assert made([]) == ""


def test_the_common_subset_leaves_out_who_solved_too_little() -> None:
    rows = table() + [made_row("ransac", f"p{i}", INF) for i in (1, 2, 3)]
    rows.append(made_row("ransac", "p4", INF, reason="too dark"))
    text = tables.paper_tables(rows)
    which = "pairs that all methods solved, without colmap, which solved less than 50 %"
    means = cells(captioned(text, f"Mean pose errors ± standard deviation (over n - 1), and time per pair; {which}"))
    medians = cells(captioned(text, f"Median pose errors ± 0.5 IQR; {which}"))
    # p1 and p3: garps 0.1 and 0.6, sift-pnp 0.3 and 0.5 m.
    assert list(means) == list(medians) == ["garps", "sift-pnp"]
    assert (
        means["garps"]["E_trans (m)"] == "**0.3500 ± 0.3536**" and means["sift-pnp"]["E_trans (m)"] == "0.4000 ± 0.1414"
    )
    assert medians["garps"]["E_trans (m)"] == "**0.3500 ± 0.1250**"
    assert [means["garps"][name] for name in ("n poses", "Failures", "Time (s)")] == ["2", "0", "**0.500**"]
    assert "2 pairs." in captioned(text, f"Median pose errors ± 0.5 IQR; {which}")
    assert "No pose at all: ransac (lost).\n" in text and "| ransac" not in text


def test_half_of_the_pairs_is_enough_for_the_common_subset() -> None:
    rows = [row for row in table() if row["method"] != "colmap"]
    rows += [made_row("half", f"p{i}", 0.1 if i < 3 else INF) for i in (1, 2, 3, 4)]
    text = captioned(tables.paper_tables(rows), "Median pose errors ± 0.5 IQR; pairs that all methods solved**")
    assert list(cells(text)) == ["garps", "sift-pnp", "half"] and " 1 pairs." in text


def test_places_are_apart_and_in_order_of_appearance() -> None:
    rows = [row | {"depth": depth, "set": name} for depth, name in (("", "b"), ("sensor", "a")) for row in table()]
    text = tables.paper_tables(rows)
    headings = [line for line in text.splitlines() if line.startswith("### ")]
    assert headings == ["### b, depth given, start none", "### a, depth sensor, start none"]
    assert text.count("Scale of the truth: b: metric.") == text.count("Scale of the truth: a: metric.") > 5
    assert (
        text.count("Time: one call from the images") == 4 and text.count("E_3D (m) of garps less that of others") == 2
    )
    assert tables.paper_tables([]) == ""
