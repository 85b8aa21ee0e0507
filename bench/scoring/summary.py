# SPDX-License-Identifier: Apache-2.0
"""From rows to one line per depth, set, start, category and method."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt
from scipy.stats import rankdata

from bench.rows.row import GARPS, Row
from garps_core import metrics
from garps_core.checks import Float64Array

SUCCESS_M, SUCCESS_DEG = 0.05, 2.0
MAP_FREE_M, MAP_FREE_DEG = 0.25, 5.0
"""Bounds of a usable pose in the Map-free relocalisation benchmark."""


def is_right(row: Row, metres: float = SUCCESS_M, degrees: float = SUCCESS_DEG) -> bool:
    """Whether a row's pose is within both bounds; a failure, at infinity, is not."""
    return bool(row["e_trans_m"] < metres and row["e_rot_deg"] < degrees)


def summarise(rows: Sequence[Row]) -> list[Row]:
    """Rows -> one line per depth, set, start, category (small, large, all) and method, in order of first appearance."""
    lines: list[Row] = []
    for depth, name, start in _tables_of(rows):
        group = [row for row in rows if _table_of(row) == (depth, name, start)]
        for category in (*sorted({row["category"] for row in group}, reverse=True), "all"):
            for method in dict.fromkeys(row["method"] for row in group):
                part = [r for r in group if r["method"] == method and category in ("all", r["category"])]
                if part:
                    names = {"depth": depth, "set": name, "start": start, "category": category, "method": method}
                    lines.append(names | _statistics(part))
    return lines


def _table_of(row: Row) -> tuple[str, str, str]:
    """Key of the table of a row: the depth ("" where a row does not name it), the set and the start."""
    return row.get("depth", ""), row["set"], row["start"]


def _tables_of(rows: Sequence[Row]) -> list[tuple[str, str, str]]:
    """Tables in order of first appearance, those of a depth and of a set together."""
    found = list(dict.fromkeys(_table_of(row) for row in rows))
    first = {key[:length]: i for length in (1, 2) for i, key in reversed(list(enumerate(found)))}
    return sorted(found, key=lambda key: (first[key[:1]], first[key[:2]]))


def _statistics(rows: Sequence[Row]) -> Row:
    found = [row for row in rows if row["found"]]
    good = [is_right(row) for row in rows]
    line: Row = {"n": f"{len(found)}/{len(rows)}"}
    line |= {name: float(np.median(_defined(rows, name))) for name in ("e_trans_m", "e_rot_deg", "e_3d_m")}
    # "higher" takes a value that is there: between two infinite ones there is nothing to interpolate.
    line["p90_e_3d_m"] = float(np.quantile(_defined(rows, "e_3d_m"), 0.9, method="higher"))
    line["mean_e_trans_m"] = float(np.mean([row["e_trans_m"] for row in found])) if found else float("nan")
    line["success"] = float(np.mean(good))
    line["map_free"] = float(np.mean([is_right(row, MAP_FREE_M, MAP_FREE_DEG) for row in rows]))
    line["seconds"] = float(np.median([row["seconds"] for row in rows]))
    line["nees_95"] = coverage(rows)[0]
    states = [row["status"] for row in rows if "status" in row]
    if states:
        wrong = [row.get("status") == "converged" and not ok for row, ok in zip(rows, good, strict=True)]
        line["wrong_ok"] = float(np.mean(wrong))
    line["statuses"] = ", ".join(f"{state} {states.count(state)}" for state in dict.fromkeys(states))
    return line


def error_of(row: Row, name: str) -> float:
    """An error of a row: infinity for a failure, NaN where the truth defines none, whatever the method.

    Without a true translation there is no error of direction, without points (`points` of the row) no E_3D. An estimate
    of zero where there is a translation names no direction, and is a failure to.
    """
    undefined = {"e_dir_deg": row.get("true_trans_m") == 0, "e_3d_m": row.get("points") == 0}
    value = row.get(name)
    if undefined.get(name, False):
        return float("nan")
    if not row["found"]:
        return float("inf")
    if name == "e_dir_deg" and value is not None and np.isnan(value) and row.get("true_trans_m"):
        return float("inf")
    return float("nan") if value is None else float(value)


def _defined(rows: Sequence[Row], name: str) -> Float64Array:
    """Errors of the rows for which the truth defines one; a NaN where it does for none."""
    values = np.array([error_of(row, name) for row in rows])
    return values[~np.isnan(values)] if not np.isnan(values).all() else np.full(1, np.nan)


def coverage(rows: Sequence[Row]) -> tuple[float, int]:
    """Share of the poses with a covariance whose NEES is within the 95 % bound (NaN without any), and their number."""
    values = np.array([row["nees"] for row in rows if "nees" in row])
    return (float(np.mean(values < metrics.CHI2_6_95)) if len(values) else float("nan")), len(values)


def roc_auc(scores: npt.ArrayLike, right: npt.ArrayLike) -> float:
    """Chance that a right one scores above a wrong one, a tie counting half; NaN when all are right or all wrong."""
    chosen = np.asarray(right, bool)
    n_right, n_wrong = int(chosen.sum()), int((~chosen).sum())
    if n_right == 0 or n_wrong == 0 or np.isnan(np.asarray(scores, float)).any():
        return float("nan")
    ranks = rankdata(np.asarray(scores, float))
    return float((ranks[chosen].sum() - n_right * (n_right + 1) / 2) / (n_right * n_wrong))


def quality_auc(rows: Sequence[Row]) -> tuple[float, str]:
    """ROC AUC of `quality` as a classifier of right and wrong poses, and a text for people.

    A failure has quality 0. NaN, with the reason, where there is no quality or nothing to tell apart.
    """
    right = [is_right(row) for row in rows]
    quality = [row.get("quality", float("nan")) if row["found"] else 0.0 for row in rows]
    counts = f"{sum(right)} of {len(rows)} within {100 * SUCCESS_M:g} cm and {SUCCESS_DEG:g} deg"
    if np.isnan(quality).any():
        return float("nan"), f"undefined, estimates have no quality ({counts})"
    if all(right) or not any(right):
        return float("nan"), f"undefined, all are {'right' if all(right) else 'wrong'} ({counts})"
    value = roc_auc(quality, right)
    return value, f"{value:.3f} ({counts})"


def confidence_line(rows: Sequence[Row], title: str) -> str:
    """GARPS' quality and covariance over its rows: AUC and NEES coverage with n."""
    own = [row for row in rows if row["method"] == GARPS]
    share, n = coverage(own)
    covered = f"{100 * share:.0f} % within the 95 % bound (n = {n})" if n else "no covariances"
    return f"{title}: AUC of GARPS' quality {quality_auc(own)[1]}; NEES: {covered}"
