# SPDX-License-Identifier: Apache-2.0
"""What the sections of `bench.speed` share: their inputs and results, interleaved timing, one thread, tables."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import numpy as np
import torch
from rich.console import Console
from rich.progress import track
from rich.table import Table

from bench.pairs.datasets import Pair, disturbed_prior
from garps_core import Config, Mixture, Prior
from garps_core.mixtures.reconstruct import reconstruct

Row = dict[str, Any]


@dataclass(frozen=True, eq=False)
class Inputs:
    """What every section is given: settings, image pairs (the first is used where one will do), timed runs."""

    preset: str
    pairs: tuple[Pair, ...]
    runs: int
    console: Console = field(default_factory=lambda: Console(quiet=True))

    @cached_property
    def config(self) -> Config:
        """The settings of the preset."""
        return Config.preset(self.preset)

    @cached_property
    def prior(self) -> Prior:
        """The first pair's disturbed truth."""
        return disturbed_prior(self.pairs[0])

    @cached_property
    def mixtures(self) -> tuple[Mixture, Mixture]:
        """The first pair, lifted."""
        return lifted(self.pairs[0], self.config)


@dataclass(frozen=True)
class Check:
    """One measured number against its bar; `at_least` or else at most. A bar of None is none: it is only told."""

    what: str
    value: float
    bar: float | None = None
    at_least: bool = False

    @property
    def met(self) -> bool | None:
        """Whether the bar is met; None where there is none."""
        if self.bar is None:
            return None
        return self.value >= self.bar if self.at_least else self.value <= self.bar

    def cells(self) -> list[str]:
        """What, measured, bar, met: as text."""
        bar = "" if self.bar is None else f"{'>=' if self.at_least else '<='} {self.bar:g}"
        return [self.what, f"{self.value:.4g}", bar, {None: "", True: "yes", False: "NO"}[self.met]]


@dataclass(frozen=True)
class Section:
    """What a section found: checks against bars, rows of a table, remarks, and whatever else is worth keeping."""

    title: str
    checks: list[Check]
    rows: list[Row] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)
    raw: Any = None

    def as_json(self) -> Row:
        """For run.json; a check's number comes with its bar and verdict."""
        checks = [{"what": c.what, "value": c.value, "bar": c.bar, "met": c.met} for c in self.checks]
        return {"title": self.title, "checks": checks, "rows": self.rows, "notes": self.notes, "raw": self.raw}


def lifted(pair: Pair, config: Config) -> tuple[Mixture, Mixture]:
    """Both views of a pair as mixtures."""
    return reconstruct(pair.source, config), reconstruct(pair.target, config)


def interleaved(
    calls: Mapping[str, Callable[[], Any]], runs: int, what: str, console: Console
) -> dict[str, list[float]]:
    """Seconds of `runs` calls each, taking turns so that whatever else the machine does hits all alike.

    One round before it is not counted: compilation, thread pools, caches.
    """
    times: dict[str, list[float]] = {name: [] for name in calls}
    for run in track(range(runs + 1), what, console=console):
        for name, call in calls.items():
            began = time.perf_counter()
            call()
            if run > 0:
                times[name].append(time.perf_counter() - began)
    return times


def medians(times: Mapping[str, list[float]]) -> dict[str, float]:
    """Median seconds by name."""
    return {name: float(np.median(values)) for name, values in times.items()}


@contextmanager
def threads(count: int) -> Iterator[None]:
    """Torch, and numba where it is there, on `count` threads."""
    before = torch.get_num_threads()
    numba = imported_numba()
    numba_before = numba.get_num_threads() if numba else 0
    torch.set_num_threads(count)
    if numba:
        numba.set_num_threads(min(count, numba.config.NUMBA_NUM_THREADS))
    try:
        yield
    finally:
        torch.set_num_threads(before)
        if numba:
            numba.set_num_threads(numba_before)


def imported_numba() -> Any:
    """The numba package, or None where it cannot be imported."""
    try:
        import numba
    except ImportError:
        return None
    return numba


def print_section(console: Console, section: Section) -> None:
    """Checks and rows of a section as tables."""
    console.rule(section.title, align="left")
    for headings, lines in _tables(section):
        table = Table()
        for i, heading in enumerate(headings):
            table.add_column(heading, justify="left" if i == 0 else "right", overflow="fold")
        for line in lines:
            table.add_row(*line)
        console.print(table)
    for note in section.notes:
        console.print(note, markup=False)


def markdown(sections: Mapping[str, Section], facts: Row) -> str:
    """All checks first, then the sections' own tables."""
    text = ["; ".join(f"{name} {value}" for name, value in facts.items()), ""]
    text += _markdown_table(CHECK_HEADINGS, [c.cells() for s in sections.values() for c in s.checks])
    for section in sections.values():
        text += [f"### {section.title}", ""]
        for headings, lines in _tables(section)[1:]:
            text += _markdown_table(headings, lines)
        text += [f"- {note}" for note in section.notes] + [""]
    return "\n".join(text)


CHECK_HEADINGS = ["what", "measured", "bar", "met"]


def _tables(section: Section) -> list[tuple[list[str], list[list[str]]]]:
    """Headings and lines of the checks and, where there are any, of the rows."""
    tables = [(CHECK_HEADINGS, [check.cells() for check in section.checks])]
    if section.rows:
        headings = list(dict.fromkeys(name for row in section.rows for name in row))
        tables.append((headings, [[_text(row.get(name, "")) for name in headings] for row in section.rows]))
    return tables


def _text(value: Any) -> str:
    return f"{value:.4g}" if isinstance(value, float) else str(value)


def _markdown_table(headings: list[str], lines: list[list[str]]) -> list[str]:
    return [
        f"| {' | '.join(headings)} |",
        "|---" * len(headings) + "|",
        *(f"| {' | '.join(line)} |" for line in lines),
        "",
    ]
