# SPDX-License-Identifier: Apache-2.0
"""From rows (one per pair, start and method, as `bench.rgbd.evaluate` gives them) to summaries, tables and files."""

from __future__ import annotations

import csv
import dataclasses
import importlib.metadata
import json
import os
import platform
import subprocess
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console
from rich.table import Table

from garps_core import metrics

Row = dict[str, Any]
SUCCESS_M, SUCCESS_DEG = 0.05, 2.0
COLUMNS = {
    "n": "poses / pairs",
    "e_trans_m": "E_trans m",
    "e_rot_deg": "E_rot deg",
    "e_3d_m": "E_3D m",
    "mean_e_trans_m": "mean E_trans m",
    "success": "success",
    "seconds": "s",
    "nees_95": "NEES < 12.59",
    "wrong_ok": "wrong & converged",
    "statuses": "statuses",
}
CAPTION = (
    f"Medians over all pairs, failures at infinity; mean over the poses that exist; success: under {SUCCESS_M:g} m "
    f"and {SUCCESS_DEG:g} deg, of all pairs; NEES: share within the 95 % bound of chi-square, 6 dof; "
    "wrong & converged: share of pairs reported as converged that are no success; s: from the images, for the peers "
    "without the time of the start they were given."
)


def summarise(rows: Sequence[Row]) -> list[Row]:
    """Rows -> one line per set, start, category (small, large, all) and method, in order of first appearance."""
    lines: list[Row] = []
    for key in dict.fromkeys((row["set"], row["start"]) for row in rows):
        group = [row for row in rows if (row["set"], row["start"]) == key]
        for category in (*sorted({row["category"] for row in group}, reverse=True), "all"):
            for method in dict.fromkeys(row["method"] for row in group):
                part = [r for r in group if r["method"] == method and category in ("all", r["category"])]
                names = {"set": key[0], "start": key[1], "category": category, "method": method}
                lines.append(names | _statistics(part))
    return lines


def _statistics(rows: Sequence[Row]) -> Row:
    found = [row for row in rows if row["found"]]
    good = [row["e_trans_m"] < SUCCESS_M and row["e_rot_deg"] < SUCCESS_DEG for row in rows]
    line: Row = {"n": f"{len(found)}/{len(rows)}"}
    line |= {name: float(np.median([row[name] for row in rows])) for name in ("e_trans_m", "e_rot_deg", "e_3d_m")}
    line["mean_e_trans_m"] = float(np.mean([row["e_trans_m"] for row in found])) if found else float("nan")
    line["success"] = float(np.mean(good))
    line["seconds"] = float(np.median([row["seconds"] for row in rows]))
    values = [row["nees"] for row in rows if "nees" in row]
    line["nees_95"] = float(np.mean(np.array(values) < metrics.CHI2_6_95)) if values else float("nan")
    states = [row["status"] for row in rows if "status" in row]
    if states:
        wrong = [row.get("status") == "converged" and not ok for row, ok in zip(rows, good, strict=True)]
        line["wrong_ok"] = float(np.mean(wrong))
    line["statuses"] = ", ".join(f"{state} {states.count(state)}" for state in dict.fromkeys(states))
    return line


def _cell(name: str, value: Any) -> str:
    if not isinstance(value, float):
        return "" if value is None else str(value)
    if np.isnan(value):
        return ""
    digits = {"e_rot_deg": 2, "success": 2, "nees_95": 2, "wrong_ok": 2, "seconds": 3}.get(name, 4)
    return f"{value:.{digits}f}"


def print_tables(console: Console, lines: Sequence[Row]) -> None:
    """One table per set and start."""
    for key in dict.fromkeys((line["set"], line["start"]) for line in lines):
        table = Table(title=f"{key[0]}, start: {key[1]}", title_justify="left")
        part = [line for line in lines if (line["set"], line["start"]) == key]
        shown = [name for name in COLUMNS if any(_cell(name, line.get(name)) for line in part)]
        for heading in ("pairs", "method", *(COLUMNS[name] for name in shown)):
            left = heading in ("pairs", "method", "statuses")
            table.add_column(heading, justify="left" if left else "right", no_wrap=heading == "method")
        for i, line in enumerate(part):
            last = i + 1 == len(part) or part[i + 1]["category"] != line["category"]
            cells = [_cell(name, line.get(name)) for name in shown]
            table.add_row(line["category"], line["method"], *cells, end_section=last)
        console.print(table)
    console.print(CAPTION)


def markdown(lines: Sequence[Row], facts: Row) -> str:
    """The same as `print_tables`, for a document."""
    text = [f"{CAPTION}\n", "; ".join(f"{name} {value}" for name, value in facts.items() if name != "settings") + "\n"]
    for key in dict.fromkeys((line["set"], line["start"]) for line in lines):
        headings = ["pairs", "method", *COLUMNS.values()]
        text += [f"### {key[0]}, start: {key[1]}\n", f"| {' | '.join(headings)} |", "|---" * len(headings) + "|"]
        for line in lines:
            if (line["set"], line["start"]) == key:
                cells = [line["category"], line["method"], *(_cell(name, line.get(name)) for name in COLUMNS)]
                text.append(f"| {' | '.join(cells)} |")
        text.append("")
    return "\n".join(text)


def machine_facts() -> Row:
    """What a reader needs to judge the numbers: processor, versions, commit."""
    names = ("numpy", "scipy", "numba", "torch", "opencv-python-headless", "open3d-cpu", "small_gicp", "poselib")
    cpuinfo = Path("/proc/cpuinfo")
    models = [line for line in cpuinfo.read_text().splitlines() if "model name" in line] if cpuinfo.is_file() else []
    facts = {"cpu": models[0].split(":")[1].strip() if models else platform.machine(), "cores": os.cpu_count() or ""}
    facts |= {"load": f"{os.getloadavg()[0]:.1f}", "python": platform.python_version(), "commit": _commit()}
    for name in names:
        try:
            facts[name] = importlib.metadata.version(name)
        except importlib.metadata.PackageNotFoundError:
            continue
    return facts


def _commit() -> str:
    try:
        described = ["git", "describe", "--always", "--dirty", "--abbrev=10", "--exclude=*"]
        return subprocess.run(described, cwd=Path(__file__).parent, capture_output=True, text=True).stdout.strip()
    except OSError:
        return ""


def write(out: Path, rows: Sequence[Row], facts: Row) -> None:
    """rows.csv, run.json (rows, facts) and table.md into a folder."""
    out.mkdir(parents=True, exist_ok=True)
    columns = list(dict.fromkeys(name for row in rows for name in row))
    with (out / "rows.csv").open("w", newline="") as file:
        writer = csv.DictWriter(file, columns)
        writer.writeheader()
        writer.writerows(rows)
    finite = [{name: None if value in (np.inf, -np.inf) else value for name, value in row.items()} for row in rows]
    (out / "run.json").write_text(json.dumps({"facts": facts, "rows": finite}, indent=1, default=dataclasses.asdict))
    (out / "table.md").write_text(markdown(summarise(rows), facts))
