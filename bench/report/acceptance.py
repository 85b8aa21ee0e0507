# SPDX-License-Identifier: Apache-2.0
"""The bars that GARPS has to clear, each as one line with its numbers and yes or no, from the rows of a full run.

Rows come from `bench.run`. A bar whose rows are missing is "not run", never met. "Success" is within 5 cm and 2 deg,
unless 25 cm and 5 deg are named; all figures are over all pairs of a set, failures at infinity.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from typing import NamedTuple

import numpy as np
from rich.console import Console
from rich.table import Table

from bench.pairs.bare_rooms import SET as BARE_ROOMS
from bench.pairs.learned_rooms import SET as LEARNED_ROOMS
from bench.rows.row import GARPS, START, Row
from bench.scoring.intervals import Difference, paired_difference
from bench.scoring.summary import coverage, quality_auc, summarise

REGISTRATION = ("open3d-gicp", "open3d-colored", "open3d-plane", "small-gicp", "rgbd-hybrid", "rgbd-intensity")
BARE_PEERS = ("sift-pnp", "open3d-gicp", "open3d-colored", "kiss-matcher+gicp")
MONOCULAR_E_3D, MONOCULAR_E_ROT = 0.4, 0.8
"""Shares of the start's error that may be left."""
BARE_E_3D, BARE_ADVANTAGE = 0.6, 0.10
COVERAGE = (0.90, 0.98)
LEAST_AUC = 0.9
ROUNDING = 1e-9


class Bar(NamedTuple):
    """A requirement, the numbers, and whether it is met; None = its rows are missing."""

    asked: str
    numbers: str
    met: bool | None


class _Lines:
    """Summary lines by depth, set, start and method: of all pairs, or of those with small or large motions."""

    def __init__(self, rows: Sequence[Row], category: str = "all") -> None:
        kept = [line for line in summarise(rows) if line["category"] == category]
        self._lines = {(line["depth"], line["set"], line["start"], line["method"]): line for line in kept}

    def sets(self, depth: str) -> list[str]:
        """Real sets of a depth."""
        return list(dict.fromkeys(key[1] for key in self._lines if key[0] == depth and key[1] != BARE_ROOMS))

    def value(self, table: tuple[str, str, str], method: str, name: str) -> float:
        """A figure, NaN where the method was not run."""
        return float(self._lines.get((*table, method), {}).get(name, float("nan")))

    def best(self, table: tuple[str, str, str], methods: Iterable[str], name: str) -> tuple[float, str]:
        """The best figure of some methods and whose it is; NaN unless all of them were run."""
        values = {method: self.value(table, method, name) for method in methods}
        if np.isnan(list(values.values())).any():
            return float("nan"), "not all run: " + ", ".join(m for m, value in values.items() if np.isnan(value))
        better: Callable[..., str] = max if name in ("success", "map_free") else min
        method = better(values, key=values.__getitem__)
        return values[method], method


def bars(rows: Sequence[Row]) -> list[Bar]:
    """Every bar, in the order of the tables."""
    lines = _Lines(rows)
    found = [bar for name in lines.sets("sensor") for bar in _sensor(lines, name)]
    found += [bar for name in lines.sets("monocular") for bar in _monocular(lines, name)]
    return [*found, *_bare(lines), _far_apart(_Lines(rows, "large")), *_confidence(rows), *_learned(rows)]


def _compared(asked: str, own: float, limit: float, whose: str, unit: str = "m", larger: bool = False) -> Bar:
    """GARPS' figure against a limit that it may reach but not cross."""
    met = None
    if not np.isnan([own, limit]).any():
        met = own >= limit - ROUNDING if larger else own <= limit + ROUNDING
    return Bar(asked, f"{own:.4g} against {limit:.4g}{' ' + unit if unit else ''} ({whose})", met)


def _sensor(lines: _Lines, name: str) -> Iterator[Bar]:
    table = ("sensor", name, "disturbed")
    limit = lines.best(table, REGISTRATION, "e_3d_m")
    title = f"sensor, {name}, disturbed"
    yield _compared(f"{title}: median E_3D <= best registration", lines.value(table, GARPS, "e_3d_m"), *limit)
    limit = lines.best(table, REGISTRATION, "success")
    own = lines.value(table, GARPS, "success")
    yield _compared(f"{title}: success >= best registration", own, *limit, unit="", larger=True)
    table = ("sensor", name, "identity")
    limit = lines.best(table, ("open3d-gicp",), "success")
    own = lines.value(table, GARPS, "success")
    yield _compared(f"sensor, {name}, identity: success >= open3d-gicp", own, *limit, unit="", larger=True)


def _monocular(lines: _Lines, name: str) -> Iterator[Bar]:
    table = ("monocular", name, "disturbed")
    for metric, share, unit in (("e_3d_m", MONOCULAR_E_3D, "m"), ("e_rot_deg", MONOCULAR_E_ROT, "deg")):
        yield _share_of_start(lines, table, metric, share, unit)
    table = ("monocular", name, "features")
    others = [lines.value(table, GARPS, metric) for metric in ("e_trans_m", "e_rot_deg")]
    for peer in ("sift-pnp", START):
        theirs = [lines.value(table, peer, metric) for metric in ("e_trans_m", "e_rot_deg")]
        shown = f"; E_trans {others[0]:.4g} / {theirs[0]:.4g} m, E_rot {others[1]:.3g} / {theirs[1]:.3g} deg"
        for metric, text in (("e_3d_m", "median E_3D"), ("p90_e_3d_m", "P90 of E_3D")):
            own, limit = lines.value(table, GARPS, metric), lines.value(table, peer, metric)
            bar = _compared(f"monocular, {name}, features: {text} <= that of {peer}", own, limit, peer)
            yield bar._replace(numbers=bar.numbers + shown)


def _share_of_start(lines: _Lines, table: tuple[str, str, str], metric: str, share: float, unit: str) -> Bar:
    own, start = (lines.value(table, method, metric) for method in (GARPS, START))
    text = {"e_3d_m": "median E_3D", "e_rot_deg": "median E_rot"}[metric]
    asked = f"{', '.join(table)}: {text} <= {share:g} x start's"
    return _compared(asked, own, share * start, f"start {start:.4g}, ratio {own / start:.2f}", unit)


def _bare(lines: _Lines) -> Iterator[Bar]:
    table = ("monocular", BARE_ROOMS, "none")
    title = f"{', '.join(table)}:"
    yield _advantage(lines, title)
    best, whose = lines.best(table, BARE_PEERS, "e_3d_m")
    own = lines.value(table, GARPS, "e_3d_m")
    bar = _compared(f"{title} median E_3D < each peer's", own, best, whose)
    yield bar if bar.met is None else bar._replace(met=own < best)
    yield _share_of_start(lines, ("monocular", BARE_ROOMS, "disturbed"), "e_3d_m", BARE_E_3D, "m")


def _far_apart(lines: _Lines) -> Bar:
    """The bar on large motions; most small ones are within 25 cm and 5 deg already, so that all peers succeed."""
    return _advantage(lines, f"monocular, {BARE_ROOMS}, none, large motions:")


def _advantage(lines: _Lines, title: str) -> Bar:
    table = ("monocular", BARE_ROOMS, "none")
    best, whose = lines.best(table, BARE_PEERS, "map_free")
    own = lines.value(table, GARPS, "map_free")
    asked = f"{title} success (25 cm, 5 deg) >= best peer's + {BARE_ADVANTAGE:g}"
    return _compared(asked, own, best + BARE_ADVANTAGE, f"{whose} {best:.2f}", unit="", larger=True)


def _confidence(rows: Sequence[Row]) -> Iterator[Bar]:
    for depth in ("sensor", "monocular"):
        own = [row for row in rows if row["method"] == GARPS and row.get("depth") == depth]
        share, n = coverage(own)
        surely, m = coverage([row for row in own if row.get("status") == "converged"])
        numbers = f"{100 * share:.1f} % of {n} poses; of the {m} that converged {100 * surely:.1f} %"
        met = COVERAGE[0] <= share <= COVERAGE[1] if n else None
        yield Bar(f"{depth}: NEES coverage {100 * COVERAGE[0]:g} to {100 * COVERAGE[1]:g} %", numbers, met)
        area, text = quality_auc(own) if own else (float("nan"), "not run")
        met = None if np.isnan(area) else area >= LEAST_AUC
        yield Bar(f"{depth}: AUC of quality >= {LEAST_AUC:g}", text, met)


def _learned(rows: Sequence[Row]) -> Iterator[Bar]:
    """On learned depth: surely better than a disturbed start, and not worse than a start from PnP."""
    for start, asked in (("disturbed", "lower"), ("features", "not_higher")):
        words = "surely lower" if asked == "lower" else "not surely higher"
        for name, found in differences(rows, ("demo_net", LEARNED_ROOMS, start)).items():
            title = f"demo_net, {LEARNED_ROOMS}, {start}: {name} E_3D {words} than the start's"
            if found is None:
                yield Bar(title, "not run", None)
            else:
                yield Bar(title, f"{found} m, 95 %", getattr(found, asked))


def differences(
    rows: Sequence[Row], table: tuple[str, str, str], method: str = GARPS, other: str = START
) -> dict[str, Difference | None]:
    """Median and mean of E_3D (m) of a method minus those of another, over the pairs for which the other has a pose.

    Where the method itself has none, the other's pose is what its user is left with, and so counts. None without rows.
    """
    own = [row for row in rows if (row.get("depth"), row["set"], row["start"]) == table]
    of = {name: {row["pair"]: row for row in own if row["method"] == name} for name in (method, other)}
    pairs = [pair for pair, row in of[other].items() if row["found"] and pair in of[method]]
    theirs = np.array([of[other][pair]["e_3d_m"] for pair in pairs])
    ours = np.array([of[method][pair]["e_3d_m"] for pair in pairs])
    ours = np.where(np.isfinite(ours), ours, theirs)
    statistics = {"median": np.median, "mean": np.mean}
    return {name: paired_difference(ours, theirs, what) if pairs else None for name, what in statistics.items()}


def answer(bar: Bar) -> str:
    """Yes, no or not run."""
    return "not run" if bar.met is None else "yes" if bar.met else "no"


def print_bars(console: Console, found: Sequence[Bar]) -> None:
    """The table that ends a full run."""
    table = Table(title="Acceptance", title_justify="left")
    for heading in Bar._fields:
        table.add_column(heading)
    for bar in found:
        table.add_row(bar.asked, bar.numbers, answer(bar))
    console.print(table)
    console.print(f"{sum(bar.met is True for bar in found)} of {len(found)} met")


def markdown_bars(found: Sequence[Bar]) -> str:
    """Markdown of the table that `print_bars` prints."""
    text = ["\n### Acceptance\n", "| asked | numbers | met |", "|---|---|---|"]
    return "\n".join([*text, *(f"| {bar.asked} | {bar.numbers} | {answer(bar)} |" for bar in found), ""])
