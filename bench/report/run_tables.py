# SPDX-License-Identifier: Apache-2.0
"""The tables of a run, for the console and for a document, and its files."""

from __future__ import annotations

import csv
import dataclasses
import json
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console
from rich.table import Table

from bench.rows.row import GARPS, Row
from bench.scoring.summary import SUCCESS_DEG, SUCCESS_M, _table_of, _tables_of, confidence_line, summarise

COLUMNS = {
    "n": "poses / pairs",
    "e_trans_m": "E_trans m",
    "e_rot_deg": "E_rot deg",
    "e_3d_m": "E_3D m",
    "p90_e_3d_m": "P90 E_3D m",
    "mean_e_trans_m": "mean E_trans m",
    "success": "success",
    "map_free": "< 25 cm & 5 deg",
    "seconds": "s",
    "nees_95": "NEES < 12.59",
    "wrong_ok": "wrong & converged",
    "statuses": "statuses",
}
CAPTION = (
    "Medians and 90th percentile over all pairs, failures at infinity; mean over the poses that exist; success: under "
    f"{SUCCESS_M:g} m and {SUCCESS_DEG:g} deg, of all pairs; NEES: share within the 95 % bound of chi-square, 6 dof; "
    "wrong & converged: share of pairs reported as converged that are no success; s: from the images, for the peers "
    "without the time of the start they were given."
)


def sections(rows: Sequence[Row]) -> Iterator[tuple[str, list[Row], list[str]]]:
    """Per table: title, lines, and what stands below it (after the last of a set, and the last of a depth)."""
    lines, keys = summarise(rows), _tables_of(rows)
    for key, following in zip(keys, [*keys[1:], ("", "", "")], strict=True):
        depth, name, start = key
        below = []
        pooled = [row for row in rows if _table_of(row)[0] == depth]
        if any(row["method"] == GARPS for row in pooled):
            if following[:2] != key[:2]:
                part = [row for row in pooled if row["set"] == name]
                below.append(confidence_line(part, f"{depth} depth, {name}, all starts"))
            if following[0] != depth or following[1] == "":
                below.append(confidence_line(pooled, f"{depth} depth, all sets and starts"))
        scales = {str(row.get("scale", "metres")).partition(" x")[0] for row in rows if _table_of(row) == key} - {
            "metres"
        }
        if scales:
            below.insert(
                0, f"Lengths are in the truth's own unit, not in measured metres: {', '.join(sorted(scales))}."
            )
        title = f"{depth} depth, {name}, start: {start}"
        yield title, [line for line in lines if _table_of(line) == key], below


def _cell(name: str, value: Any) -> str:
    if not isinstance(value, float):
        return "" if value is None else str(value)
    if np.isnan(value):
        return ""
    digits = {"e_rot_deg": 2, "success": 2, "map_free": 2, "nees_95": 2, "wrong_ok": 2, "seconds": 3}.get(name, 4)
    return f"{value:.{digits}f}"


def print_tables(console: Console, rows: Sequence[Row], facts: Row) -> None:
    """One table per depth, set and start."""
    for title, part, below in sections(rows):
        table = Table(title=title, title_justify="left")
        shown = [name for name in COLUMNS if any(_cell(name, line.get(name)) for line in part)]
        for heading in ("pairs", "method", *(COLUMNS[name] for name in shown)):
            left = heading in ("pairs", "method", "statuses")
            table.add_column(heading, justify="left" if left else "right", no_wrap=heading == "method")
        for i, line in enumerate(part):
            last = i + 1 == len(part) or part[i + 1]["category"] != line["category"]
            cells = [_cell(name, line.get(name)) for name in shown]
            table.add_row(line["category"], line["method"], *cells, end_section=last)
        console.print(table)
        for text in below:
            console.print(text)
    console.print(caption(facts))


def caption(facts: Row) -> str:
    """The meaning of the columns, and a note of rows that were taken from an earlier run."""
    if not facts.get("reused_peers"):
        return CAPTION
    return f"{CAPTION} {facts['reused_peers']}"


def markdown(rows: Sequence[Row], facts: Row) -> str:
    """Markdown of the tables that `print_tables` prints."""
    short = "; ".join(f"{name} {value}" for name, value in facts.items() if name not in ("settings", "reused_peers"))
    text = [f"{caption(facts)}\n", f"{short}\n"]
    headings = ["pairs", "method", *COLUMNS.values()]
    for title, part, below in sections(rows):
        text += [f"### {title}\n", f"| {' | '.join(headings)} |", "|---" * len(headings) + "|"]
        for line in part:
            cells = [line["category"], line["method"], *(_cell(name, line.get(name)) for name in COLUMNS)]
            text.append(f"| {' | '.join(cells)} |")
        text += ["", *(f"{line}\n" for line in below)]
    return "\n".join(text)


def write(out: Path, rows: Sequence[Row], facts: Row, end: str = "") -> None:
    """Write rows.csv, run.json (rows, facts) and table.md, which closes with `end`, into a folder."""
    out.mkdir(parents=True, exist_ok=True)
    columns = list(dict.fromkeys(name for row in rows for name in row))
    with (out / "rows.csv").open("w", newline="") as file:
        writer = csv.DictWriter(file, columns)
        writer.writeheader()
        writer.writerows(rows)
    finite = [{name: None if value in (np.inf, -np.inf) else value for name, value in row.items()} for row in rows]
    (out / "run.json").write_text(json.dumps({"facts": facts, "rows": finite}, indent=1, default=dataclasses.asdict))
    (out / "table.md").write_text(markdown(rows, facts) + end)
