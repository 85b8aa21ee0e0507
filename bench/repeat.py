# SPDX-License-Identifier: Apache-2.0
"""Differences of two runs of `bench.run` on the pairs that both hold, by method; a repeated run has none.

Run the benchmark again, then compare:

    python -m bench.run --limit 5 --out out/again
    python -m bench.repeat out/run out/again
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, NamedTuple

import numpy as np
import typer
from rich.console import Console

from bench.rows.row import Row
from bench.rows.row_log import ROWS, key_of


class Differences(NamedTuple):
    """Answers of a method that both runs hold, those with a pose in one run only, largest difference of a number."""

    answers: int
    one_sided: int
    largest: float


def rows_in(folder: Path) -> list[Row]:
    """The rows of a run. Raises ValueError where there are none, or a line is torn."""
    path = folder / ROWS
    if not path.is_file():
        raise ValueError(f"{path} does not exist: give the --out of a run")
    lines = path.read_text().splitlines()[1:]
    try:
        return [row for line in lines for row in json.loads(line)]
    except json.JSONDecodeError:
        raise ValueError(f"{path} is damaged, or its run was stopped: go on with it by --resume") from None


def differences(first: Sequence[Row], second: Sequence[Row]) -> dict[str, Differences]:
    """By method; numbers compared are those of poses (m, and entries of rotations) and covariances."""
    others = {(*key_of(row), row["method"]): row for row in second}
    found: dict[str, Differences] = {}
    for row in first:
        other = others.get((*key_of(row), row["method"]))
        if other is None:
            continue
        n, one_sided, largest = found.get(row["method"], Differences(0, 0, 0.0))
        if row["found"] == other["found"]:
            largest = max(largest, *(_apart(row.get(name), other.get(name)) for name in ("T", "covariance")))
        found[row["method"]] = Differences(n + 1, one_sided + (row["found"] != other["found"]), largest)
    return found


def _apart(ours: Sequence[float] | None, theirs: Sequence[float] | None) -> float:
    """Largest difference; infinite where one is missing, or not a number and the other is."""
    if ours is None or theirs is None:
        return 0.0 if ours is theirs else float("inf")
    if np.array_equal(ours, theirs, equal_nan=True):
        return 0.0
    apart = float(np.abs(np.subtract(ours, theirs)).max())
    return float("inf") if np.isnan(apart) else apart


def main(
    first: Annotated[Path, typer.Argument(help="--out of a run")],
    second: Annotated[Path, typer.Argument(help="--out of another")],
) -> None:
    """Compare two runs; exit status 1 where they differ."""
    console = Console(soft_wrap=True)
    try:
        found = differences(rows_in(first), rows_in(second))
        if not found:
            raise ValueError(f"{first} and {second} have no pair and method in common")
    except ValueError as error:
        console.print(str(error))
        raise typer.Exit(2) from None
    console.print("| method | answers | a pose in one only | largest difference |\n|---|---|---|---|")
    for name, line in found.items():
        console.print(f"| {name} | {line.answers} | {line.one_sided} | {line.largest:g} |", markup=False)
    if any(line.one_sided or line.largest for line in found.values()):
        raise typer.Exit(1)


if __name__ == "__main__":
    typer.run(main)
