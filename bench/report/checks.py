# SPDX-License-Identifier: Apache-2.0
"""Measured numbers against their bars, and the tables that show them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

from rich.console import Console
from rich.table import Table

Row = dict[str, Any]


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
        """Name, measured number, bar and verdict as text."""
        bar = "" if self.bar is None else f"{'>=' if self.at_least else '<='} {self.bar:g}"
        return [self.what, f"{self.value:.4g}", bar, {None: "", True: "yes", False: "NO"}[self.met]]


@dataclass(frozen=True)
class Section:
    """Results of a section: checks against bars, rows of a table, notes, and raw numbers to keep."""

    title: str
    checks: list[Check]
    rows: list[Row] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)
    raw: Any = None

    def as_json(self) -> Row:
        """For run.json; a check's number comes with its bar and verdict."""
        checks = [{"what": c.what, "value": c.value, "bar": c.bar, "met": c.met} for c in self.checks]
        return {"title": self.title, "checks": checks, "rows": self.rows, "notes": self.notes, "raw": self.raw}


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
