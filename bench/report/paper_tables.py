# SPDX-License-Identifier: Apache-2.0
"""Markdown tables in the layout of the paper, and those it lacks: of all pairs, paired, by category, by length.

Rows are those of `bench.rows.pair_rows`. The paper's numbers are over each method's own successes, and cannot be
compared where methods fail on different pairs; so every table says how many pairs and failures it is of, and where the
unit of the true translations comes from. The best of a column, as rounded, is bold. A table of no rows is empty text.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterable, Sequence
from itertools import pairwise

import numpy as np
from scipy.stats import binomtest

from bench.report.ablations import ERRORS
from bench.rows.row import GARPS, Row
from bench.scoring.intervals import paired_difference
from bench.scoring.scores import INF, THRESHOLDS_DEG, VCRE_PX, precision_auc
from bench.scoring.statistics import (
    MAA_DEG,
    all_pairs,
    common_subset,
    errors_of,
    length_unit,
    matched,
    median_of_all,
    methods_of,
    own_successes,
    pair_of,
    rows_of,
    scale_sources,
    spread,
)
from bench.scoring.summary import MAP_FREE_DEG, MAP_FREE_M
from garps_core.checks import Float64Array

ALL_PAIRS = {"e_rot_deg": "E_rot", "e_dir_deg": "E_dir", "e_trans_m": "E_trans", "e_3d_m": "E_3D"}
DIGITS_M, DIGITS_DEG, DIGITS_S = 4, 3, 3
TIME = (
    "one call from the images, without the depth that the pair has and without a start that is given; mean over the "
    "pairs, failures too"
)
"""Meaning of the seconds of rows that `bench.rows.pair_rows` made."""
LENGTH_FROM_DEPTH = ("five-point", "colmap", "colmap-relaxed")
"""Methods that find a direction, and take the length of t from the depth of the pair (`bench.peers.metres`)."""
COUNTS = ("n poses", "Failures")
LENGTHS = (0.0, 0.1, 0.2, 0.3, 0.5, 1.0, INF)
COMMON_SHARE = 0.5
"""A method that solved less of the pairs is left out of the common subset, which it would empty."""


def paper_tables(rows: Sequence[Row]) -> str:
    """Every table, for each depth, set and start in order of first appearance."""
    text = []
    for place in dict.fromkeys(pair_of(row)[:3] for row in rows):
        part = [row for row in rows if pair_of(row)[:3] == place]
        part, without = _with_any_pose(part)
        shared, which = _common(part)
        tables = [mean_table(part), median_table(part), all_pairs_table(part)]
        tables += [mean_table(shared, which), median_table(shared, which)]
        tables += [difference_table(part), category_table(part), length_table(part), map_free_table(part)]
        depth, name, start = place
        text += [f"### {name}, depth {depth or 'given'}, start {start}\n", *without, *filter(None, tables)]
    return "\n".join(text)


def _with_any_pose(rows: Sequence[Row]) -> tuple[list[Row], list[str]]:
    """The rows of methods with at least one pose, and of the others their most frequent reason, in words."""
    able = {row["method"] for row in rows if row["found"]}
    whose: dict[str, list[str]] = {}
    for name in (name for name in methods_of(rows) if name not in able):
        (reason, _), *_ = Counter(row["reason"].partition(":")[0] for row in rows_of(rows, name)).most_common(1)
        whose.setdefault(reason, []).append(name)
    lines = [f"No pose at all: {', '.join(names)} ({reason}).\n" for reason, names in whose.items()]
    return [row for row in rows if row["method"] in able], lines


def _common(rows: Sequence[Row]) -> tuple[list[Row], str]:
    """The common subset of the methods that solve enough pairs, and what it is, in words."""
    least = COMMON_SHARE * len({pair_of(row) for row in rows})
    able = [name for name in methods_of(rows) if sum(row["found"] for row in rows_of(rows, name)) >= least]
    out = [name for name in methods_of(rows) if name not in able]
    without = f", without {', '.join(out)}, which solved less than {100 * COMMON_SHARE:g} %" if out else ""
    return common_subset(rows, able), f"pairs that all methods solved{without}"


def mean_table(rows: Sequence[Row], which: str = "own successes") -> str:
    """The paper's Table 1: mean ± standard deviation (over n - 1) of a method's poses, and mean seconds per pair."""
    seconds = [float(spread([row["seconds"] for row in rows_of(rows, m)]).mean) for m in methods_of(rows)]
    columns = _spread_columns(rows, "mean", "std")
    columns |= {"Time (s)": _column(seconds, DIGITS_S)}
    caption = f"Mean pose errors ± standard deviation (over n - 1), and time per pair; {which}"
    return _by_method(caption, rows, columns, f" Time: {TIME}.")


def median_table(rows: Sequence[Row], which: str = "own successes") -> str:
    """The paper's Table 2: median ± half the interquartile range of a method's poses."""
    return _by_method(f"Median pose errors ± 0.5 IQR; {which}", rows, _spread_columns(rows, "median", "half_iqr"))


def all_pairs_table(rows: Sequence[Row]) -> str:
    """Medians, AUC and mAA over all pairs, failures at infinity; first what owes nothing to the scale of the truth."""
    found = [all_pairs(rows_of(rows, name), ALL_PAIRS) for name in methods_of(rows)]
    medians = {error: _column([line.medians[error] for line in found], _digits(error)) for error in ALL_PAIRS}
    columns = {_heading(error, rows): medians[error] for error in ("e_rot_deg", "e_dir_deg")}
    for i, limit in enumerate(THRESHOLDS_DEG):
        columns[f"AUC@{limit:g}"] = _column([100 * line.auc[i] for line in found], 1, max)
    columns[f"mAA({MAA_DEG})"] = _column([100 * line.maa for line in found], 1, max)
    ratios = [own_successes(rows_of(rows, name), "scale_ratio").median for name in methods_of(rows)]
    columns["Length"] = [_number(ratio, DIGITS_DEG) for ratio in ratios]
    columns |= {_heading(error, rows): medians[error] for error in ("e_trans_m", "e_3d_m")}
    end = " AUC and mAA: of max(E_rot, E_dir), in per cent. Length: estimated |t| over the true, median of the poses."
    return _by_method("Medians and AUC over all pairs, failures at infinity", rows, columns, end)


def difference_table(rows: Sequence[Row], method: str = GARPS, error: str = "e_3d_m") -> str:
    """An error of one method less that of every other on the same pairs: median, mean, and who is better how often.

    Median and mean with 95 % intervals are over the pairs that both solved. The sign test is over all pairs: a failure
    is worse than any pose, ties say nothing. p is two-sided and not corrected for the number of methods.
    """
    lines = []
    for other in methods_of(rows) if method in methods_of(rows) else ():
        pairs = matched(rows, method, other)
        if other == method or not pairs:
            continue
        ours, theirs = (errors_of([pair[i] for pair in pairs], error) for i in (0, 1))
        better, worse = int((ours < theirs).sum()), int((ours > theirs).sum())
        p = f"{binomtest(better, better + worse).pvalue:.2g}" if better + worse else "-"
        lines.append([other, *_differences(ours, theirs), f"{better} / {worse}", p])
    headings = ["Against", "n both", "Median [95 %]", "Mean [95 %]", "Better / worse", "Sign test p"]
    caption = f"{_heading(error, rows)} of {method} less that of others, pair by pair (negative: {method} is better)"
    end = " Sign test: over all pairs, failures at infinity; two-sided p, not corrected for the number of methods."
    return _table(caption, headings, lines, rows, end)


def _differences(ours: Float64Array, theirs: Float64Array) -> list[str]:
    """Number of pairs in which both errors are finite, median and mean of their paired differences."""
    both = np.isfinite(ours) & np.isfinite(theirs)
    if not both.any():
        return ["0", "-", "-"]
    apart, zero = ours[both] - theirs[both], np.zeros(both.sum())
    return [f"{both.sum()}", *(str(paired_difference(apart, zero, statistic)) for statistic in (np.median, np.mean))]


def category_table(rows: Sequence[Row]) -> str:
    """Medians over all pairs, failures at infinity: small motions, large ones, and what else a set tells apart."""
    found = dict.fromkeys(row["category"] for row in rows)
    categories = [name for name in dict.fromkeys(("small", "large", *found)) if name in found]
    lines = []
    for category in categories:
        part = [row for row in rows if row["category"] == category]
        columns = [_column(_medians(part, error), _digits(error)) for error in ERRORS]
        for name, *cells in zip(methods_of(part), *columns, strict=True):
            lines.append([category, name, *cells, *_counts(rows_of(part, name))])
    headings = ["Pairs", "Method", *(_heading(error, rows) for error in ERRORS), *COUNTS]
    return _table("Medians by category over all pairs, failures at infinity", headings, lines, rows)


def length_table(rows: Sequence[Row], error: str = "e_3d_m", edges: Sequence[float] = LENGTHS) -> str:
    """Median of an error over all pairs, failures at infinity, by the length of the true translation.

    Args:
        rows: those without `true_trans_m` are left out.
        error: its name.
        edges: of the bins, in the unit of the truth; a length on an edge belongs to the longer bin.
    """
    known = [row for row in rows if row.get("true_trans_m") is not None]
    names, columns = methods_of(known), {}
    for low, high in pairwise(edges):
        if part := [row for row in known if low <= row["true_trans_m"] < high]:
            text = f"{low:g} to {high:g}" if high < INF else f"from {low:g}"
            heading = f"{text} {length_unit(rows)} (n = {len({pair_of(row) for row in part})})"
            columns[heading] = _column([median_of_all(rows_of(part, name), error) for name in names], _digits(error))
    caption = f"Median {_heading(error, rows)} by length of the true translation, over all pairs, failures at infinity"
    return _by_method(caption, known, columns) if columns else ""


def map_free_table(rows: Sequence[Row]) -> str:
    """Scores of Map-free relocalisation: camera error, VCRE, precision, and AUC over each method's own confidence.

    Medians are over all pairs, not per scene; a method without a confidence has an AUC like its precision.
    """
    if not all("e_c_m" in row for row in rows):
        return ""
    names = methods_of(rows)
    columns = {
        f"E_c ({length_unit(rows)})": _column([median_of_all(rows_of(rows, m), "e_c_m") for m in names], DIGITS_M),
        "VCRE (px)": _column([median_of_all(rows_of(rows, m), "vcre_px") for m in names], 1),
    }
    usable = {f"VCRE < {VCRE_PX:g} px": lambda row: row["vcre_px"] < VCRE_PX}
    usable[f"E_c < {MAP_FREE_M:g} {length_unit(rows)}, E_rot < {MAP_FREE_DEG:g} deg"] = lambda row: (
        row["e_c_m"] < MAP_FREE_M and row["e_rot_deg"] < MAP_FREE_DEG
    )
    for what, accepts in usable.items():
        scores = [_precision(rows_of(rows, name), accepts) for name in names]
        columns[f"{what}: precision"] = _column([score[0] for score in scores], DIGITS_DEG, max)
        columns[f"{what}: AUC"] = _column([score[1] for score in scores], DIGITS_DEG, max)
    end = " AUC: of precision over recall in order of falling confidence (`quality`), all pairs in the denominator."
    return _by_method("Scores of Map-free relocalisation, medians over all pairs", rows, columns, end)


def _precision(rows: Sequence[Row], accepts: Callable[[Row], bool]) -> tuple[float, float]:
    """Share of all pairs whose pose is accepted, and the area under precision and recall."""
    found = [row for row in rows if row["found"]]
    right = [accepts(row) for row in found]
    confidence = np.nan_to_num([float(row.get("quality", 0.0)) for row in found])
    return sum(right) / len(rows), precision_auc(confidence, right, len(rows) - len(found))


def note(rows: Iterable[Row]) -> str:
    """Notes below a table: scale of the truth per set, number of pairs, borrowed lengths."""
    rows = list(rows)
    sets = dict.fromkeys(row["set"] for row in rows)
    sources = {name: scale_sources(row for row in rows if row["set"] == name) for name in sets}
    scales = "; ".join(f"{name}: {', '.join(found)}" for name, found in sources.items())
    text = f"Scale of the truth: {scales}. {len({pair_of(row) for row in rows})} pairs.{_points(rows)}"
    borrowed = [name for name in methods_of(rows) if name in LENGTH_FROM_DEPTH]
    return text + (f" Length of t from depth: {', '.join(borrowed)}." if borrowed else "")


def _points(rows: Sequence[Row]) -> str:
    """Over how many points E_3D is, and whose depth gave them; nothing where rows do not say."""
    counts = [row["points"] for row in rows if row.get("points")]
    whose = " or ".join(dict.fromkeys(row["points_from"] for row in rows if row.get("points")))
    return (
        f" E_3D: mean over {min(counts)} to {max(counts)} points of the source view; depth: {whose}." if counts else ""
    )


def _by_method(caption: str, rows: Sequence[Row], columns: dict[str, list[str]], end: str = "") -> str:
    """A line per method: its cell of every column, poses and failures."""
    cells = zip(*columns.values(), strict=True)
    lines = [[name, *line, *_counts(rows_of(rows, name))] for name, line in zip(methods_of(rows), cells, strict=True)]
    return _table(caption, ["Method", *columns, *COUNTS], lines, rows, end)


def _table(caption: str, headings: list[str], lines: list[list[str]], rows: Sequence[Row], end: str = "") -> str:
    if not lines:
        return ""
    text = [f"**{caption}**\n", f"| {' | '.join(headings)} |", "|---" * len(headings) + "|"]
    text += [f"| {' | '.join(line)} |" for line in lines]
    return "\n".join([*text, f"\n{note(rows)}{end}\n"])


def _counts(rows: Sequence[Row]) -> list[str]:
    poses = sum(row["found"] for row in rows)
    return [f"{poses}", f"{len(rows) - poses}"]


def _spread_columns(rows: Sequence[Row], middle: str, width: str) -> dict[str, list[str]]:
    """Each error as "middle ± width", two fields of `Spread`, with n where it is not that of the poses."""
    columns = {}
    for error in ERRORS:
        digits, values, texts = _digits(error), [], []
        for name in methods_of(rows):
            found = own_successes(rows_of(rows, name), error)
            values.append(float(getattr(found, middle)))
            n = f" (n = {found.n})" if f"{found.n}" != _counts(rows_of(rows, name))[0] else ""
            texts.append(f"{_number(values[-1], digits)} ± {_number(getattr(found, width), digits)}{n}")
        columns[_heading(error, rows)] = _column(values, digits, texts=texts)
    return columns


def _medians(rows: Sequence[Row], error: str) -> list[float]:
    return [median_of_all(rows_of(rows, name), error) for name in methods_of(rows)]


def _column(
    values: Sequence[float], digits: int, best: Callable[..., float] = min, texts: Sequence[str] | None = None
) -> list[str]:
    """Cells (default: the values themselves), the best ones as rounded in bold."""
    shown = [_number(value, digits) for value in values]
    finite = [value for value in values if np.isfinite(value)]
    top = _number(best(finite), digits) if finite else None
    return [f"**{text}**" if number == top else text for text, number in zip(texts or shown, shown, strict=True)]


def _number(value: float, digits: int) -> str:
    return "-" if np.isnan(value) else "∞" if np.isinf(value) else f"{value:.{digits}f}"


def _digits(error: str) -> int:
    return DIGITS_M if error.endswith("_m") else DIGITS_DEG


def _heading(error: str, rows: Sequence[Row]) -> str:
    return f"{ALL_PAIRS[error]} ({length_unit(rows) if error.endswith('_m') else 'deg'})"
