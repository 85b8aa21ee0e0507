# SPDX-License-Identifier: Apache-2.0
"""The folder of a run of `bench.run`: rows, tables, plots, and pictures of pairs before and after."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path

import numpy as np
from rich.console import Console

from bench.pairs.depths import with_depth_of
from bench.pairs.pair import Pair
from bench.report import acceptance
from bench.report.ablations import ablation_tables
from bench.report.depth_tables import depth_tables
from bench.report.paper_tables import paper_tables
from bench.report.plots import write_plots
from bench.report.run_tables import print_tables, write
from bench.rows.row import GARPS, START, Row
from bench.scoring.statistics import pair_of
from garps_core import Config, reconstruct
from garps_core.cli.figure import before_after

MAX_PICTURES = 8


def write_report(
    out: Path,
    rows: Sequence[Row],
    facts: Row,
    pairs: Sequence[Pair],
    configs: Mapping[str, Config],
    left_out: Sequence[str],
    console: Console,
) -> None:
    """Everything into a folder, the short tables also to the console.

    Args:
        out: the folder.
        rows: of all jobs.
        facts: machine, versions, commit, seeds, settings.
        pairs: those the rows are of, with their own depth.
        configs: settings of GARPS by depth.
        left_out: what could not be run, in words.
        console: where the tables are printed.
    """
    print_tables(console, rows, facts)
    found = acceptance.bars(rows)
    answered = [bar for bar in found if bar.met is not None]
    if answered:
        acceptance.print_bars(console, answered)
        console.print(f"{len(found) - len(answered)} more were not run")
    short = [ablation_tables(rows), depth_tables(rows), left_out_text(left_out)]
    console.print("\n".join(filter(None, short)), markup=False, soft_wrap=True)
    parts = [acceptance.markdown_bars(answered) if answered else "", *short, paper_tables(rows)]
    write(out, rows, facts, "\n" + "\n".join(filter(None, parts)))
    seed = int(facts.get("seed", 0))
    for path in (*write_plots(rows, out / "plots"), *write_pictures(rows, pairs, configs, out / "pictures", seed)):
        console.print(f"picture: {path}", soft_wrap=True)
    console.print(f"rows, tables, plots and pictures: {out}", soft_wrap=True)


def left_out_text(left_out: Sequence[str]) -> str:
    """Markdown of what could not be run."""
    return "\n".join(["### Left out\n", *(f"- {line}" for line in left_out), ""]) if left_out else ""


def write_pictures(
    rows: Sequence[Row], pairs: Sequence[Pair], configs: Mapping[str, Config], out: Path, seed: int
) -> Iterator[Path]:
    """The pair of median error of every table, at the start and as GARPS leaves it; at most `MAX_PICTURES`."""
    of_pair = {(pair.set, pair.id): pair for pair in pairs}
    starts = {pair_of(row): row for row in rows if row["method"] == START and row["found"]}
    own = [row for row in rows if row["method"] == GARPS and row["found"] and pair_of(row) in starts]
    tables = list(dict.fromkeys(pair_of(row)[:3] for row in own))
    for table in tables[:MAX_PICTURES]:
        chosen = sorted((row for row in own if pair_of(row)[:3] == table), key=lambda row: float(row["e_3d_m"]))
        row = chosen[len(chosen) // 2]
        if (pair := of_pair.get((row["set"], row["pair"]))) is None:
            continue
        out.mkdir(parents=True, exist_ok=True)
        seen = with_depth_of(pair, row["depth"], seed)
        mixtures = [reconstruct(view, configs[row["depth"]]) for view in (seen.source, seen.target)]
        start = starts[pair_of(row)]
        title = (
            f"{row['set']}, {row['pair']}, depth {row['depth']}, start {row['start']}: E_3D {start['e_3d_m']:.4f} m "
            f"before, {row['e_3d_m']:.4f} m after"
        )
        yield before_after(*mixtures, _pose(start), _pose(row), out / f"{'_'.join(table)}.png", title)


def _pose(row: Row) -> np.ndarray:
    return np.vstack([np.reshape(row["T"], (3, 4)), [0, 0, 0, 1]])
