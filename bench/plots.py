# SPDX-License-Identifier: Apache-2.0
"""Pictures of a run, one function each, from the rows of `bench.evaluate` to a PNG file.

Rows of one table belong into a picture: one depth, set and start (`write_plots` tells them apart). A method has the same
colour, line and marker in every picture; colours are those of Okabe and Ito, which the colour-blind can tell apart. All
pairs count, failures as infinite errors. No pyplot: nothing stays open.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from scipy.stats import binomtest, chi2

from bench.scores import NAN
from bench.statistics_blocks import errors_of, median_of_all, methods_of, pair_of, rows_of, spread
from bench.tables import GARPS, SUCCESS_DEG, SUCCESS_M, Row, is_right
from garps_core.checks import Float64Array

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

START = "(start)"
COLOURS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9")
DASHES: tuple[Any, ...] = ("-", (0, (5, 2)), (0, (1, 1.2)), (0, (6, 2, 1, 2)), (0, (3, 1, 1, 1, 1, 1)))
MARKERS = "osD^vP<X>phd*"
KNOWN = (
    *("mast3r", "icp", "colmap", "open3d-colored", "dust3r", "cpd"),
    *("sift-pnp", "open3d-gicp", "kiss-matcher+gicp", "small-gicp", "five-point", "rgbd-intensity"),
    *("sift-pnp+small-gicp", "open3d-plane", "sift-pnp-oneway", "rgbd-hybrid", "colmap-relaxed", "open3d-colored-fast"),
)
"""Methods whose looks do not depend on who else is in the picture; the first six have solid lines, and so on."""
LABELS = {"e_trans_m": "E_trans (m)", "e_rot_deg": "E_rot (deg)", "e_3d_m": "E_3D (m)"}
BINS, LEAST_IN_BIN = 8, 5
QUALITY_BINS = 10
DPI = 130


def error_cdfs(rows: Sequence[Row], path: Path, errors: Sequence[str] = ("e_3d_m", "e_rot_deg")) -> Path:
    """Share of all pairs with an error below x, log x, a panel for each error; a curve ends at the share of poses.

    The legend is in the order of the medians of the first error.
    """
    methods = sorted(_some(methods_of(rows), "rows"), key=lambda name: median_of_all(rows_of(rows, name), errors[0]))
    figure, axes = _figure(len(errors))
    for axis, error in zip(axes, errors, strict=True):
        values = {name: np.sort(_known(errors_of(rows_of(rows, name), error))) for name in methods}
        left, right = _range(np.concatenate([*values.values()]))
        for name, look in looks(methods).items():
            found = values[name][np.isfinite(values[name])]
            x, share = np.r_[left, found, right], np.r_[0, np.arange(len(found)) + 1, len(found)]
            marks = {"markevery": (0.03 * (methods.index(name) % 4), 0.16), "drawstyle": "steps-post"}
            axis.plot(np.clip(x, left, right), share / max(len(values[name]), 1), label=name, **look, **marks)
        _logarithmic(axis, "x", (left, right))
        axis.set(xlabel=_label(error, rows), ylabel="share of all pairs below", ylim=(0, 1.01))
    return _saved(figure, axes, path)


def error_against(rows: Sequence[Row], path: Path, of: str = "true_trans_m", error: str = "e_3d_m") -> Path:
    """Median error over bins of equally many pairs, by the length of the true translation, or another of `OF`.

    What is known of a pair from the row of one method (overlap, which GARPS estimates) counts for all methods. Where
    half of a bin's pairs failed, the median is infinite and the line has a gap.

    Raises:
        ValueError: no row says it.
    """
    places = {pair_of(row): float(row[of]) for row in reversed(rows) if row.get(of) is not None}
    values = _known(np.array(_some([*places.values()], f"rows with {of}")))
    bins = int(np.clip(len(values) // LEAST_IN_BIN, 1, BINS))
    edges = np.unique(np.quantile(values, np.linspace(0, 1, bins + 1)))
    figure, axes = _figure(1)
    methods = methods_of(rows)
    for name, look in looks(methods).items():
        own = [row for row in rows_of(rows, name) if not np.isnan(places.get(pair_of(row), NAN))]
        x = np.array([places[pair_of(row)] for row in own])
        bin_of = np.clip(np.searchsorted(edges, x, side="right"), 1, max(len(edges) - 1, 1))
        groups = [[row for row, k in zip(own, bin_of, strict=True) if k == index] for index in np.unique(bin_of)]
        y = [median_of_all(group, error) for group in groups]
        axes[0].plot([np.median(x[bin_of == index]) for index in np.unique(bin_of)], y, label=name, **look)
    _logarithmic(axes[0], "y")
    axes[0].set(xlabel=_label(of, rows), ylabel=f"median {_label(error, rows)}, bins of equally many pairs")
    return _saved(figure, axes, path)


def time_against_error(rows: Sequence[Row], path: Path, error: str = "e_3d_m") -> Path:
    """A dot for each method: median seconds and median error over all pairs, both log.

    Methods without a time, or of which half failed, have no dot, and their name says so.
    """
    methods = _some(methods_of(rows), "rows")
    figure, axes = _figure(1)
    for name, look in looks(methods).items():
        own = rows_of(rows, name)
        seconds, middle = spread([row["seconds"] for row in own]).median, median_of_all(own, error)
        lacks = "" if seconds > 0 else " (no time)"
        lacks = lacks if np.isfinite(middle) else " (half failed)"
        dot = look | {"linestyle": "", "markersize": 13 if name == GARPS else 9}
        axes[0].plot(*(([], []) if lacks else ([seconds], [middle])), label=name + lacks, **dot)
    _logarithmic(axes[0], "x")
    _logarithmic(axes[0], "y")
    axes[0].set(xlabel="median wall time of a pair (s)", ylabel=f"median {_label(error, rows)}, failures at infinity")
    return _saved(figure, axes, path)


def nees_calibration(rows: Sequence[Row], path: Path) -> Path:
    """Share of the poses whose NEES is below the p quantile of chi-square (6 dof), against p: the diagonal is honest.

    Above it covariances are too large, below it too small.

    Raises:
        ValueError: no row has `nees`.
    """
    having = _some([row for row in rows if row.get("nees") is not None], "rows with nees")
    figure, axes = _figure(1)
    p = np.linspace(0, 1, 201)
    axes[0].plot([0, 1], [0, 1], color="0.6", linewidth=1, label="honest")
    for name, look in looks(methods_of(having)).items():
        values = np.sort([float(row["nees"]) for row in rows_of(having, name)])
        share = np.searchsorted(values, chi2.ppf(p, 6), side="right") / len(values)
        axes[0].plot(p, share, label=f"{name} (n = {len(values)})", markevery=0.1, **look)
    axes[0].set(xlabel="nominal share: chi-square, 6 degrees of freedom", ylabel="share of poses with NEES below")
    axes[0].set(xlim=(0, 1), ylim=(0, 1.01), aspect="equal")
    return _saved(figure, axes, path)


def quality_reliability(rows: Sequence[Row], path: Path, method: str = GARPS) -> Path:
    """Share of right poses (5 cm and 2 deg) in bins of `quality`, with 95 % intervals of Wilson, and pairs per bin.

    A failure has quality 0. Quality need not be a probability: what matters is that the share rises with it.

    Raises:
        ValueError: no row of the method has `quality`.
    """
    own = rows_of(rows, method)
    _some([row for row in own if row.get("quality") is not None], f"rows of {method} with quality")
    quality = np.array([row.get("quality", NAN) if row["found"] else 0.0 for row in own], np.float64)
    right = np.array([is_right(row) for row in own])[~np.isnan(quality)]
    bin_of = np.minimum((_known(quality) * QUALITY_BINS).astype(int), QUALITY_BINS - 1)
    figure, (top, below) = _figure(2, stacked=True)
    top.plot([0, 1], [0, 1], color="0.6", linewidth=1, label="share = quality")
    for k in np.unique(bin_of):
        n, good = int((bin_of == k).sum()), int(right[bin_of == k].sum())
        low, high = binomtest(good, n).proportion_ci(method="wilson")
        x = (k + 0.5) / QUALITY_BINS
        top.plot([x, x], [low, high], color="0.5", linewidth=1.5)
        top.plot(x, good / n, "o", color=COLOURS[0], label=method if k == bin_of.min() else None)
        below.bar(x, n, width=0.9 / QUALITY_BINS, color="0.7")
    top.set(ylabel=f"share within {100 * SUCCESS_M:g} cm and {SUCCESS_DEG:g} deg", ylim=(-0.02, 1.02))
    below.set(xlabel=f"quality of {method}, failures 0", ylabel="pairs", xlim=(0, 1))
    return _saved(figure, [top], path)


PLOTS: Mapping[str, Callable[[Sequence[Row], Path], Path]] = {
    "error_cdfs": error_cdfs,
    "error_by_length": error_against,
    "error_by_overlap": lambda rows, path: error_against(rows, path, "overlap"),
    "time_against_error": time_against_error,
    "nees_calibration": nees_calibration,
    "quality_reliability": quality_reliability,
}


def write_plots(rows: Sequence[Row], folder: Path) -> Iterator[Path]:
    """All plots that the rows have something for, of every depth, set and start, into a folder that is made."""
    folder.mkdir(parents=True, exist_ok=True)
    for place in dict.fromkeys(pair_of(row)[:3] for row in rows):
        part = [row for row in rows if pair_of(row)[:3] == place]
        for name, draw in PLOTS.items():
            file = re.sub(r"[^\w.-]+", "_", "_".join((*filter(None, place), name)))
            try:
                yield draw(part, folder / f"{file}.png")
            except NothingToDraw:
                continue
