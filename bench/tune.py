# SPDX-License-Identifier: Apache-2.0
"""Choose settings with Optuna on one half of the pairs, and say what they are worth on the other.

    python -m bench.tune --depth sensor --trials 40      # searches; goes on with the study that is in --out
    python -m bench.tune --depth sensor --trials 0       # only reports: default against best, on both halves
    python -m bench.tune --depth monocular --data pairs=FOLDER --data bare=out/bare_rooms

The best settings are written to --out as DEPTH.yaml: for `garps align --settings`, `garps-replay --settings`,
`python -m bench.run --settings` and the node's parameter `settings_file`.

Settings are chosen on the dev half of recorded pairs and on the generated rooms to tune on (`bench.run --half dev`):
sensor depth on recorded pairs, monocular depth on these and bare rooms, the demonstration network's on its own rooms.
The held-out half and the other rooms are looked at once, by the report. A trial is worth the mean over all tables of

    log10(median E_3D) + log10(P90 E_3D) + share of failures        (beyond 25 cm or 5 deg; errors from 1 mm to 1 m)

plus how far the share of errors inside their own 95 % bound is from 95 % (in units of 5 %, free up to 2.5 %).
Trials that fall behind the median of the others are given up early.
"""

from __future__ import annotations

import sys
from collections.abc import Iterator, Sequence
from functools import lru_cache
from pathlib import Path
from typing import Annotated, Any, NamedTuple

import numpy as np
import optuna
import typer
from rich.console import Console
from rich.progress import Progress
from rich.table import Table

from bench.pairs.depths import DEMO_NET, MONOCULAR, SENSOR, config_of, usable, with_depth_of
from bench.pairs.pair import Pair
from bench.pairs.sources import BARE, PAIRS, ROOMS, defaults_of, named, pairs_of, sources_there
from bench.rows.pair_rows import rows_of_pairs
from bench.rows.row import GARPS, Row
from bench.scoring.summary import MAP_FREE_DEG, MAP_FREE_M, is_right
from garps_core import Config, GarpsError
from garps_core.config.text import write_settings
from garps_core.metrics import CHI2_6_95

SPACES: dict[str, dict[str, tuple[float, float]]] = {
    SENSOR: {
        "alignment.effective_measurements": (10.0, 120.0),
        "alignment.colour_variance": (0.005, 0.1),
        "alignment.outlier_floor": (3e-4, 0.03),
        "start.covariance_inflation": (1.5, 4.0),
    },
    MONOCULAR: {
        "alignment.effective_measurements": (1.5, 20.0),
        "alignment.brightness_measurements": (0.01, 0.2),
        "alignment.colour_variance": (0.005, 0.1),
        "alignment.outlier_floor": (3e-4, 0.03),
        "start.covariance_inflation": (1.5, 4.0),
        "lifting.scale_sigma": (0.01, 0.06),
        "lifting.warp_sigma": (0.01, 0.05),
        "lifting.patch_sigma": (0.01, 0.1),
    },
    DEMO_NET: {
        "alignment.effective_measurements": (0.03, 10.0),
        "alignment.brightness_measurements": (5e-4, 0.1),
        "alignment.outlier_floor": (3e-4, 0.03),
        "start.covariance_inflation": (2.0, 40.0),
        "lifting.scale_sigma": (0.03, 0.4),
        "lifting.common_scale_sigma": (0.02, 0.3),
        "lifting.warp_sigma": (0.03, 0.4),
        "lifting.patch_sigma": (0.05, 0.6),
    },
}
"""Ranges that are searched, all on a logarithmic scale: few settings, so that half of the pairs can decide."""
TUNED_ON = {SENSOR: (PAIRS,), MONOCULAR: (PAIRS, BARE), DEMO_NET: (ROOMS,)}
"""Kinds of sources that decide about a depth."""
SMALLEST_M, LARGEST_M = 1e-3, 1.0


def loss_of(tables: Sequence[Sequence[Row]]) -> float:
    """The loss of a trial (module docstring), less is better. Rows are those of GARPS, a table at a time."""
    inside = [row["nees"] < CHI2_6_95 for rows in tables for row in rows if "nees" in row]
    missed = max(0.0, abs(float(np.mean(inside)) - 0.95) - 0.025) if inside else 1.0
    return float(np.mean([_table_loss(rows) for rows in tables])) + missed / 0.05


def _table_loss(rows: Sequence[Row]) -> float:
    errors = np.clip([row["e_3d_m"] for row in rows], SMALLEST_M, LARGEST_M)
    failed = np.mean([not is_right(row, MAP_FREE_M, MAP_FREE_DEG) for row in rows])
    return float(np.log10(np.median(errors)) + np.log10(np.percentile(errors, 90)) + failed)


class Part(NamedTuple):
    """One table that counts."""

    depth: str
    source: str
    start: str
    half: str
    limit: int | None


def run(config: Config, planned: Sequence[Part]) -> Iterator[list[Row]]:
    """GARPS' rows of one table after the other."""
    for part in planned:
        rows = rows_of_pairs(config, _pairs(part.depth, part.source, part.half, part.limit), part.start, [GARPS])
        yield [row for row in rows if row["method"] == GARPS]


@lru_cache(maxsize=16)
def _pairs(depth: str, source: str, half: str, limit: int | None) -> list[Pair]:
    """With the depth in question."""
    found = pairs_of(source, limit, 1, Console(quiet=True), half)
    return [with_depth_of(pair, depth) for pair in found if usable(pair, depth)]


def search(study: optuna.Study, planned: Sequence[Part], trials: int, console: Console) -> None:
    """Run this many more trials; the first of a study is the preset as it is."""
    depth = planned[0].depth
    preset = config_of(depth)
    if not _completed(study):
        study.enqueue_trial({name: preset.settings()[name] for name in SPACES[depth]})

    def objective(trial: optuna.Trial) -> float:
        changes = {name: trial.suggest_float(name, *limits, log=True) for name, limits in SPACES[depth].items()}
        tables: list[list[Row]] = []
        for rows in run(preset.replace(changes), planned):
            tables.append(rows)
            trial.report(loss_of(tables), len(tables))
            if trial.should_prune():
                raise optuna.TrialPruned
        return loss_of(tables)

    with Progress(console=console) as progress:
        task = progress.add_task(f"{depth}: trials", total=trials)
        study.optimize(objective, n_trials=trials, callbacks=[lambda *_: progress.advance(task)])


def report(study: optuna.Study, planned: Sequence[Part], console: Console) -> Table:
    """Default against best, table by table, on the half that chose and on the one that was held out."""
    preset = config_of(planned[0].depth)
    table = Table("half", "set", "start", "median default", "best", "P90 default", "best", "in bound", "best")
    for half in ("dev", "held-out"):
        parts = [part._replace(half=half) for part in planned]
        runs = [list(run(config, parts)) for config in (preset, preset.replace(study.best_params))]
        for part, before, after in zip(parts, *runs, strict=True):
            cells = [f"{value:.4f}" for pick in (50, 90) for rows in (before, after) for value in [_error(rows, pick)]]
            cells += [
                f"{np.mean([row.get('nees', np.inf) < CHI2_6_95 for row in rows]):.2f}" for rows in (before, after)
            ]
            table.add_row(half, before[0]["set"], part.start, *cells)
        console.print(
            f"{half}: loss {loss_of(runs[0]):.3f} with the preset, {loss_of(runs[1]):.3f} with the best trial"
        )
    return table


def _error(rows: Sequence[Row], percentile: float) -> float:
    return float(np.percentile([min(row["e_3d_m"], 1e3) for row in rows], percentile))


def planned_parts(depth: str, sources: Sequence[str], limit: int | None) -> list[Part]:
    """The tables that decide about a depth.

    Raises:
        ValueError: no such depth, none of the sources is of a kind that decides about it, or one has too few pairs.
    """
    if depth not in SPACES:
        raise ValueError(f"depth is {depth!r}: expected one of {', '.join(SPACES)}")
    chosen = [source for source in sources if named(source)[0] in TUNED_ON[depth]]
    if not chosen:
        kinds = ", ".join(f"{name}=FOLDER" for name in TUNED_ON[depth])
        raise ValueError(f"no data to tune {depth} on: give --data {kinds}")
    for source in chosen:
        if not all(_pairs(depth, source, half, limit) for half in ("dev", "held-out")):
            raise ValueError(f"{source} has no pair with {depth} depth in one of its halves: expected at least 2 pairs")
    return [Part(depth, source, start, "dev", limit) for source in chosen for start in defaults_of(source)[1]]


def main(
    depth: Annotated[str, typer.Option(help=f"which preset: {', '.join(SPACES)}")] = SENSOR,
    trials: Annotated[int, typer.Option(help="number of further trials; 0 = only report")] = 40,
    data: Annotated[list[str] | None, typer.Option(help="NAME=FOLDER, as of bench.run; repeat at will")] = None,
    limit: Annotated[int | None, typer.Option(help="largest number of pairs of a set, as of bench.run")] = None,
    out: Annotated[Path, typer.Option(help="folder of the study; one that is there goes on")] = Path("out/tune"),
) -> None:
    """Choose settings on one half of the pairs, report on the other."""
    console = Console(width=None if sys.stdout.isatty() else 160)
    try:
        planned = planned_parts(depth, data or sources_there(), limit)
        study = _study(out, planned)
        if not trials and not _completed(study):
            raise ValueError(f"{out} has no finished trial of {depth}: there is nothing to report; give --trials")
    except (OSError, ValueError, GarpsError) as error:
        console.print(str(error), soft_wrap=True, markup=False)
        raise typer.Exit(2) from None
    if trials:
        search(study, planned, trials, console)
    console.print(f"{len(study.trials)} trials, best {study.best_value:.3f}:")
    for name, value in study.best_params.items():
        console.print(f"  {name} = {value:.4g}   (preset: {Config.preset(depth).settings()[name]:g})")
    chosen = out / f"{depth}.yaml"
    comment = f"Best of {len(study.trials)} trials of python -m bench.tune --depth {depth}: loss {study.best_value:.4f}"
    write_settings(chosen, depth, study.best_params, comment)
    console.print(f"settings: {chosen}")
    console.print(report(study, planned, console))


def _completed(study: optuna.Study) -> list[optuna.trial.FrozenTrial]:
    return study.get_trials(deepcopy=False, states=(optuna.trial.TrialState.COMPLETE,))


def _study(out: Path, planned: Sequence[Part]) -> optuna.Study:
    """The study of a depth in a folder, begun unless it is there; seeded by how many trials it has.

    Raises:
        ValueError: the study that is there is of other pairs, or searched something else: losses do not compare.
    """
    depth = planned[0].depth
    out.mkdir(parents=True, exist_ok=True)
    optuna.logging.set_verbosity(optuna.logging.WARNING)
    storage = f"sqlite:///{out}/study.db"
    pruner = optuna.pruners.MedianPruner(n_startup_trials=6, n_warmup_steps=1)
    study = optuna.create_study(storage=storage, study_name=depth, pruner=pruner, load_if_exists=True)
    sampler: Any = optuna.samplers.TPESampler(seed=len(study.trials), multivariate=True)
    study.sampler = sampler
    made_of = {"tables": [list(part) for part in planned], "searched": sorted(SPACES[depth])}
    if study.user_attrs.get("made_of", made_of) != made_of:
        raise ValueError(f"the study of {depth} in {out} is of other pairs or settings: give another --out")
    study.set_user_attr("made_of", made_of)
    return study


if __name__ == "__main__":
    typer.run(main)
