# SPDX-License-Identifier: Apache-2.0
"""Pictures of a run, one function each, from the rows of `bench.rows.pair_rows` to a PNG file.

Rows of one table belong into a picture: one depth, set and start (`write_plots` tells them apart). A method looks the
same in every picture; colours are those of Okabe and Ito, which the colour-blind can tell apart. All pairs count,
failures as infinite errors. No pyplot: nothing stays open.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from scipy.stats import binomtest, chi2

from bench.rows.row import GARPS, START, Row
from bench.scoring.scores import NAN
from bench.scoring.statistics import errors_of, length_unit, median_of_all, methods_of, pair_key, rows_of, spread
from bench.scoring.summary import SUCCESS_DEG, SUCCESS_M, is_right
from garps_core.checks import Float64Array

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

COLOURS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9")
DASHES: tuple[Any, ...] = ("-", (0, (5, 2)), (0, (1, 1.2)), (0, (6, 2, 1, 2)), (0, (3, 1, 1, 1, 1, 1)))
MARKERS = "osD^vP<X>phd*"
KNOWN = (
    *("mast3r", "icp", "colmap", "open3d-colored", "dust3r", "cpd"),
    *("sift-pnp", "open3d-gicp", "kiss-matcher+gicp", "small-gicp", "five-point", "rgbd-intensity"),
    *("sift-pnp+small-gicp", "open3d-plane", "sift-pnp-oneway", "rgbd-hybrid", "colmap-relaxed", "open3d-colored-fast"),
)
"""Methods whose looks do not depend on who else is in the picture; the first six have solid lines, and so on."""
LABELS = {
    "e_trans_m": "E_trans",
    "e_rot_deg": "E_rot",
    "e_3d_m": "E_3D",
    "true_trans_m": "length of the true translation",
}
OF = ("true_trans_m", "true_overlap")
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

    Where half of a bin's pairs failed, the median is infinite and the line has a gap.

    Raises:
        NothingToDraw: no row says it.
    """
    having = _some([row for row in rows if row.get(of) is not None], f"rows with {of}")
    values = np.array([*{pair_key(row): round(row[of], 6) for row in having}.values()])  # equal lengths stay together
    bins = int(np.clip(len(values) // LEAST_IN_BIN, 1, BINS))
    edges = np.unique(np.quantile(values, np.linspace(0, 1, bins + 1)))[1:-1]
    figure, axes = _figure(1)
    for name, look in looks(methods_of(having)).items():
        own = rows_of(having, name)
        x = np.array([round(row[of], 6) for row in own])
        bin_of = np.searchsorted(edges, x, side="right")
        used = np.unique(bin_of)
        groups = [[row for row, k in zip(own, bin_of, strict=True) if k == index] for index in used]
        middles = [np.median(x[bin_of == index]) for index in used]
        axes[0].plot(middles, [median_of_all(group, error) for group in groups], label=name, **look)
    _logarithmic(axes[0], "y")
    axes[0].set(xlabel=_label(of, rows), ylabel=f"median {_label(error, rows)}, bins of equally many pairs")
    return _saved(figure, axes, path)


def time_against_error(rows: Sequence[Row], path: Path, error: str = "e_3d_m") -> Path:
    """A dot for each method: median seconds and median error over all pairs, both log.

    Methods without a time, or of which half failed, have no dot; a note follows their name.
    """
    methods = _some(methods_of(rows), "rows")
    figure, axes = _figure(1)
    for name, look in looks(methods).items():
        own = rows_of(rows, name)
        seconds, middle = spread([row["seconds"] for row in own]).median, median_of_all(own, error)
        lacks = "" if seconds > 0 else " (no time)"
        lacks = lacks if np.isfinite(middle) else " (half failed)"
        dot = look | {"linestyle": "", "markersize": 13 if name == GARPS else 9, "marker": look["marker"] or "o"}
        axes[0].plot(*(([], []) if lacks else ([seconds], [middle])), label=name + lacks, **dot)
    _logarithmic(axes[0], "x")
    _logarithmic(axes[0], "y")
    axes[0].set(xlabel="median wall time of a pair (s)", ylabel=f"median {_label(error, rows)}, failures at infinity")
    return _saved(figure, axes, path)


def nees_calibration(rows: Sequence[Row], path: Path) -> Path:
    """Share of the poses whose NEES is below the p quantile of chi-square (6 dof), against p: the diagonal is honest.

    Above it covariances are too large, below it too small.

    Raises:
        NothingToDraw: no row has `nees`.
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
        NothingToDraw: no row of the method has `quality`.
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
    "error_by_overlap": lambda rows, path: error_against(rows, path, "true_overlap"),
    "time_against_error": time_against_error,
    "nees_calibration": nees_calibration,
    "quality_reliability": quality_reliability,
}


def write_plots(rows: Sequence[Row], folder: Path) -> Iterator[Path]:
    """All plots that the rows have something for, of every depth, set and start, into a folder that is made."""
    folder.mkdir(parents=True, exist_ok=True)
    for place in dict.fromkeys(pair_key(row)[:3] for row in rows):
        part = [row for row in rows if pair_key(row)[:3] == place]
        able = {row["method"] for row in part if row["found"]}
        part = [row for row in part if row["method"] in able]
        for name, draw in PLOTS.items():
            file = re.sub(r"[^\w.-]+", "_", "_".join((*filter(None, place), name)))
            try:
                yield draw(part, folder / f"{file}.png")
            except NothingToDraw:
                continue


class NothingToDraw(ValueError):
    """The rows lack what a picture shows."""


def looks(methods: Sequence[str]) -> dict[str, dict[str, Any]]:
    """Colour, line and marker of each method; those of `KNOWN` have the same in every picture."""
    free = [name for name in methods if name not in (GARPS, START, *KNOWN)]
    found: dict[str, dict[str, Any]] = {}
    for name in methods:
        if name == GARPS:
            found[name] = {"color": "black", "linestyle": "-", "linewidth": 2.4, "marker": "*", "markersize": 9}
        elif name == START:
            found[name] = {"color": "0.6", "linestyle": "-", "linewidth": 1.6, "marker": ""}
        else:
            k = KNOWN.index(name) if name in KNOWN else len(KNOWN) + free.index(name)
            dash = DASHES[k // len(COLOURS) % len(DASHES)]
            found[name] = {"color": COLOURS[k % len(COLOURS)], "linestyle": dash, "linewidth": 1.3}
            found[name] |= {"marker": MARKERS[k % len(MARKERS)], "markersize": 4.5}
    return found


def _some(found: list[Any], what: str) -> list[Any]:
    if not found:
        raise NothingToDraw(f"there are no {what}")
    return found


def _known(values: Float64Array) -> Float64Array:
    """Without those that are not defined."""
    return values[~np.isnan(values)]


def _range(values: Float64Array) -> tuple[float, float]:
    """Limits of a logarithmic axis: all but the outermost per cent of the finite values."""
    positive = _some([value for value in values if 0 < value < np.inf], "errors above zero")
    low, high = np.quantile(positive, [0.01, 0.99])
    return float(low) / 1.2, max(float(high) * 1.2, float(low) * 2)


def _label(name: str, rows: Sequence[Row]) -> str:
    if name == "true_overlap":
        return "overlap (share of pixels whose surface the other camera sees)"
    return f"{LABELS[name]} ({length_unit(rows) if name.endswith('_m') else 'deg'})"


def _figure(panels: int, stacked: bool = False) -> tuple[Figure, list[Axes]]:
    """A figure without pyplot, its panels side by side or, sharing x, one above the other."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    size = (8.5, 6.0) if stacked else (2.8 + 5.2 * panels, 5.2)
    figure = Figure(figsize=size, layout="constrained")
    FigureCanvasAgg(figure)
    if stacked:
        grid = figure.subplots(panels, 1, sharex=True, height_ratios=[3, *[1] * (panels - 1)])
    else:
        grid = figure.subplots(1, panels)
    axes = list(np.atleast_1d(grid))
    for axis in axes:
        axis.grid(color="0.9")
        axis.spines[["top", "right"]].set_visible(False)
    return figure, axes


def _logarithmic(axis: Axes, which: str, limits: tuple[float, float] | None = None) -> None:
    """A logarithmic axis with plain numbers on it."""
    from matplotlib.ticker import FuncFormatter

    (axis.set_xscale if which == "x" else axis.set_yscale)("log")
    if limits is not None:
        (axis.set_xlim if which == "x" else axis.set_ylim)(limits)
    part = axis.xaxis if which == "x" else axis.yaxis
    part.set_major_formatter("{x:g}")
    low, high = axis.get_xlim() if which == "x" else axis.get_ylim()
    named = "25" if high / low < 300 else ""
    part.set_minor_formatter(FuncFormatter(lambda x, _: f"{x:g}" if f"{x:e}"[0] in named else ""))


def _saved(figure: Figure, axes: Sequence[Axes], path: Path) -> Path:
    """With the legend of the first panel beside the last."""
    handles, labels = axes[0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside right upper", fontsize=8, frameon=False)
    figure.savefig(path, dpi=DPI)
    return path
