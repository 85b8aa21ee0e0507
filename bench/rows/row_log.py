# SPDX-License-Identifier: Apache-2.0
"""Rows of a run on disk: written as they come, so that a run can go on where it was stopped or lend its peers' rows."""

from __future__ import annotations

import dataclasses
import json
import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from bench.peers.methods import METHODS, NEED_NO_START
from bench.rows.row import ERRORS, Row

ROWS, PREVIOUS = "rows.jsonl", "rows.previous.jsonl"
Key = tuple[str, str, str, str]
"""Depth, set, start, pair."""


def key_of(row: Row) -> Key:
    """The table and pair that a row belongs to."""
    return row["depth"], row["set"], row["start"], row["pair"]


class RowLog:
    """Rows in a file, one line per pair and depth; the first line holds the options they were made with.

    Args:
        folder: of the run; the file in it is `ROWS`.
        options: everything that decides about the rows, but for the code itself.
        resume: go on with the rows that are there; False starts anew, and keeps those that were there as `PREVIOUS`.
    Raises:
        ValueError: to be resumed, and there is nothing, or it was made with other options.
    """

    def __init__(self, folder: Path, options: Mapping[str, Any], resume: bool = False) -> None:
        self.check(folder, resume)
        self.path = folder / ROWS
        self.rows: list[Row] = []
        given = json.loads(json.dumps(options, default=dataclasses.asdict))
        if resume:
            self.rows = self._read(given)
        folder.mkdir(parents=True, exist_ok=True)
        groups: dict[tuple[str, str, str], list[Row]] = {}
        for row in self.rows:
            groups.setdefault((row["depth"], row["set"], row["pair"]), []).append(row)
        lines = [json.dumps(part) for part in (given, *groups.values())]  # without the line that an interruption tore
        if self.path.is_file() and not resume:
            self.path.replace(self.path.with_name(PREVIOUS))
        unfinished = self.path.with_suffix(".unfinished")
        unfinished.write_text("\n".join(lines) + "\n")
        unfinished.replace(self.path)
        self.done = {key_of(row) for row in self.rows}

    def add(self, rows: Sequence[Row]) -> None:
        """The rows of one pair."""
        self._append(rows)
        self.rows += rows
        self.done |= {key_of(row) for row in rows}

    def _append(self, rows: Sequence[Row]) -> None:
        with self.path.open("a") as file:
            file.write(json.dumps(rows) + "\n")

    @staticmethod
    def check(folder: Path, resume: bool) -> None:
        """Raise ValueError where there is nothing to resume. Called before pairs are made, which takes minutes."""
        path = folder / ROWS
        if resume and not path.is_file():
            raise ValueError(f"{path} does not exist: there is nothing to resume. Run without --resume")

    def _read(self, given: Any) -> list[Row]:
        first, *lines = self.path.read_text().splitlines() or ["{}"]
        stored = json.loads(first)
        if stored != given:
            raise ValueError(
                f"{self.path} was made with other settings ({_differences(stored, given)}): "
                "resume with the same ones, or run without --resume"
            )
        rows: list[Row] = []
        for i, line in enumerate(lines):
            try:
                rows += json.loads(line)
            except json.JSONDecodeError:
                if i + 1 < len(lines):
                    raise ValueError(f"{self.path} is damaged in line {i + 2}: run without --resume") from None
        return rows


def _differences(stored: Any, given: Any, name: str = "") -> str:
    """Names of what differs, with both values."""
    if isinstance(stored, dict) and isinstance(given, dict):
        names = dict.fromkeys([*stored, *given])
        texts = [_differences(stored.get(k), given.get(k), f"{name}.{k}" if name else k) for k in names]
        return "; ".join(text for text in texts if text)
    return "" if stored == given else f"{name} was {stored!r:.100}, is {given!r:.100}"


def reusable_rows(path: Path, seed: int) -> dict[Key, dict[str, Row]]:
    """Peers' rows of an earlier run.json that owe nothing to GARPS' code, per pair and method.

    Rows of peers that started from GARPS' own features are left out. "reused" in each row is the commit it is from.

    Raises:
        ValueError: no run.json, rows from before depth was told apart, or starts drawn from another seed.
    """
    try:
        run = json.loads(path.read_text())
        rows, earlier_seed, commit = run["rows"], run["facts"]["seed"], run["facts"].get("commit") or "unknown"
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise ValueError(
            f"{path} is no run.json with rows and facts ({error!r}): give that of an earlier run"
        ) from None
    if earlier_seed != seed:
        raise ValueError(f"{path} was made with seed {earlier_seed}, not {seed}: its starts and depth differ")
    found: dict[Key, dict[str, Row]] = {}
    for row in rows:
        if not {"depth", "e_c_m"} <= row.keys():
            raise ValueError(f"{path} has rows without depth or e_c_m: an earlier version made it; run its peers anew")
        method = row["method"]
        if method in METHODS and (row["start"] != "features" or method in NEED_NO_START):
            found.setdefault(key_of(row), {})[method] = {"reused": commit} | _with_infinities(row)
    return found


def _with_infinities(row: Row) -> Row:
    """The row with infinity in place of None, by which run.json stands for it."""
    return {name: float("inf") if name in ERRORS and value is None else value for name, value in row.items()}


def reuse_note(rows: Sequence[Row], path: Path) -> str:
    """A sentence on the number of peers' rows that come from an earlier run."""
    peers = [row for row in rows if row["method"] in METHODS]
    commits = [row["reused"] for row in peers if "reused" in row]
    origin = f"{os.path.relpath(path)} (commit {', '.join(dict.fromkeys(commits)) or 'none'})"
    return f"{len(commits)} of {len(peers)} rows of peers, times included, were not run anew but taken from {origin}."
