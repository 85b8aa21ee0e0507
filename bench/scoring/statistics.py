# SPDX-License-Identifier: Apache-2.0
"""Statistics of a method's errors: over its own successes, all pairs, or the pairs that every method solved.

Rows are those of `bench.rows.pair_rows`, one per depth, set, start, pair and method. A mean or a spread exists over
poses only, and flatters methods that fail on hard pairs; a median and an AUC exist over all pairs with failures at
infinity; over the common subset methods may be compared by their means. Each comes with its n. Pairs for which the
truth defines no such error (E_3D without points, the direction of no motion) are left out, for every method alike.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from bench.rows.row import Row
from bench.scoring.scores import NAN, auc, mean_average_accuracy, pose_error_deg
from bench.scoring.summary import error_of
from garps_core.checks import Float64Array

DDOF = 1
"""Standard deviations are those of a sample, over n - 1; the paper does not say which it gives."""
MAA_DEG = 30
PairKey = tuple[str, str, str, str]
"""Depth ("" where a row does not say), set, start, pair."""


class Spread(NamedTuple):
    """Mean and standard deviation (over n - 1), median and half the interquartile range of n values, in their unit.

    Quartiles are interpolated linearly between values. NaN where there are too few.
    """

    n: int
    mean: float
    std: float
    median: float
    half_iqr: float


class AllPairs(NamedTuple):
    """Statistics of all n pairs: failures, medians by error, AUC at 5, 10 and 20 deg, and mAA(30), shares 0..1."""

    n: int
    failures: int
    medians: dict[str, float]
    auc: tuple[float, ...]
    maa: float


def pair_of(row: Row) -> PairKey:
    """The table and pair of a row."""
    return row.get("depth", ""), row["set"], row["start"], row["pair"]


def methods_of(rows: Iterable[Row]) -> list[str]:
    """Methods in order of first appearance."""
    return list(dict.fromkeys(row["method"] for row in rows))


def rows_of(rows: Iterable[Row], method: str) -> list[Row]:
    """The rows of a method."""
    return [row for row in rows if row["method"] == method]


def scale_sources(rows: Iterable[Row]) -> list[str]:
    """Sources of the truth's lengths, from `Pair.scale`, without the factors of single pairs."""
    return list(dict.fromkeys(str(row.get("scale", "not stated")).partition(" x")[0] for row in rows))


def length_unit(rows: Iterable[Row]) -> str:
    """The unit of lengths: m, or "raw" where a truth among them has the unit of its set."""
    return "raw" if "raw" in scale_sources(rows) else "m"


def errors_of(rows: Iterable[Row], name: str) -> Float64Array:
    """`tables.error_of` of every row: infinity for a failure, NaN where it is not defined or not there."""
    return np.array([error_of(row, name) for row in rows], np.float64)


def spread(values: npt.ArrayLike) -> Spread:
    """Statistics of the finite values."""
    given = np.asarray(values, np.float64)
    kept = given[np.isfinite(given)]
    if not len(kept):
        return Spread(0, NAN, NAN, NAN, NAN)
    low, median, high = np.quantile(kept, [0.25, 0.5, 0.75], method="linear")
    std = float(kept.std(ddof=DDOF)) if len(kept) > DDOF else NAN
    return Spread(len(kept), float(kept.mean()), std, float(median), float(high - low) / 2)


def own_successes(rows: Iterable[Row], name: str) -> Spread:
    """An error over the poses that a method found: what the paper's tables hold."""
    return spread(errors_of(rows, name))


def median_of_all(rows: Iterable[Row], name: str) -> float:
    """Median of an error over all pairs, failures at infinity; infinity when half of them fail, NaN without pairs."""
    values = errors_of(rows, name)
    values = values[~np.isnan(values)]
    return float(np.median(values)) if len(values) else NAN


def all_pairs(rows: Sequence[Row], names: Iterable[str] = ("e_trans_m", "e_rot_deg", "e_3d_m")) -> AllPairs:
    """Over all pairs of a method, failures at infinity; AUC and mAA of max(E_rot, E_dir).

    Args:
        rows: of one method.
        names: errors to give medians of.
    """
    failures = sum(not row["found"] for row in rows)
    medians = {name: median_of_all(rows, name) for name in names}
    angles = [pose_error_deg(row) for row in rows]
    return AllPairs(len(rows), failures, medians, auc(angles), mean_average_accuracy(angles, MAA_DEG))


def common_subset(rows: Sequence[Row], methods: Iterable[str] | None = None) -> list[Row]:
    """The rows of chosen methods (default: all) of the pairs that every one of them solved, in their order."""
    chosen = set(methods_of(rows) if methods is None else methods)
    solved: dict[PairKey, set[str]] = {}
    for row in rows:
        if row["found"]:
            solved.setdefault(pair_of(row), set()).add(row["method"])
    return [row for row in rows if row["method"] in chosen and chosen <= solved.get(pair_of(row), set())]


def matched(rows: Sequence[Row], ours: str, theirs: str) -> list[tuple[Row, Row]]:
    """The rows of two methods, pair by pair, of the pairs that both were run on."""
    others = {pair_of(row): row for row in rows_of(rows, theirs)}
    return [(row, others[pair_of(row)]) for row in rows_of(rows, ours) if pair_of(row) in others]
