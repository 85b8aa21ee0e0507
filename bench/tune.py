# SPDX-License-Identifier: Apache-2.0
"""Choose settings with Optuna on one half of the pairs, and say what they are worth on the other.

    python -m bench.tune --depth sensor --trials 40      # searches; goes on with the study that is in --out
    python -m bench.tune --depth sensor --trials 0       # only reports: default against best, on both halves

The best settings are written to --out as DEPTH.yaml: for `garps align --settings`, `garps-replay --settings`,
`python -m bench.run --settings` and, as a file of parameters, for the node.

Settings are chosen on `--half dev` of the recorded pairs and, for monocular depth, on the bare rooms to tune on; the
held-out half and the other rooms are looked at once, by the report. A trial is worth the mean over all tables of

    log10(median E_3D) + log10(P90 E_3D) + share of failures        (beyond 25 cm or 5 deg; errors from 1 mm to 1 m)

plus how far the share of errors inside their own 95 % bound is from 95 % (in units of 5 %, free up to 2.5 %).
Trials that fall behind the median of the others are given up early.
"""

from __future__ import annotations

import sys
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import optuna
import typer
from rich.console import Console
from rich.progress import Progress
from rich.table import Table

from bench import bare
from bench.datasets import DATA
from bench.evaluate import evaluate
from bench.plan import MONOCULAR, SENSOR, Part, pairs_of, parts
from bench.tables import GARPS, Row
from garps_core import Config
from garps_core.settings import write_settings

SPACES: dict[str, dict[str, tuple[float, float]]] = {
    SENSOR: {
        "alignment.information": (10.0, 120.0),
        "alignment.colour_variance": (0.005, 0.1),
        "alignment.outlier_floor": (3e-4, 0.03),
        "start.covariance_inflation": (1.5, 4.0),
    },
    MONOCULAR: {
        "alignment.information": (1.5, 20.0),
        "alignment.brightness": (0.01, 0.2),
        "alignment.colour_variance": (0.005, 0.1),
        "alignment.outlier_floor": (3e-4, 0.03),
        "start.covariance_inflation": (1.5, 4.0),
        "lifting.scale_sigma": (0.01, 0.06),
        "lifting.warp_sigma": (0.01, 0.05),
    },
}
"""What is searched, all on a logarithmic scale: few settings, so that half of the pairs can decide about them."""
BOUND_95 = 12.592
"""95 % of a chi squared of 6 degrees of freedom."""
SMALLEST_M, LARGEST_M = 1e-3, 1.0


def loss_of(tables: Sequence[Sequence[Row]]) -> float:
    """What a trial is worth (module docstring), less is better. Rows are those of GARPS, a table at a time."""
    inside = [row["nees"] < BOUND_95 for rows in tables for row in rows if "nees" in row]
    missed = max(0.0, abs(float(np.mean(inside)) - 0.95) - 0.025) if inside else 1.0
    return float(np.mean([_table_loss(rows) for rows in tables])) + missed / 0.05


def _table_loss(rows: Sequence[Row]) -> float:
    errors = np.clip([row["e_3d_m"] for row in rows], SMALLEST_M, LARGEST_M)
    failed = np.mean([row["e_trans_m"] >= 0.25 or row["e_rot_deg"] >= 5 for row in rows])
    return float(np.log10(np.median(errors)) + np.log10(np.percentile(errors, 90)) + failed)


def run(config: Config, planned: Sequence[Part], folders: tuple[Path, Path], half: str) -> Iterator[list[Row]]:
    """GARPS' rows of one table after the other."""
    data, bare_rooms = folders
    for part in planned:
        pairs = pairs_of(part, data, bare_rooms, half, None, 0, Console(quiet=True))
        yield [row for row in evaluate(config, pairs, part.start, [GARPS]) if row["method"] == GARPS]


def search(study: optuna.Study, depth: str, trials: int, folders: tuple[Path, Path], console: Console) -> None:
    """Run so many trials more; the first of a study is the preset as it is."""
    planned = _planned(depth, "dev", folders[0])
    preset = Config.preset(depth)
    if not study.trials:
        study.enqueue_trial({name: preset.settings()[name] for name in SPACES[depth]})

    def objective(trial: optuna.Trial) -> float:
        changes = {name: trial.suggest_float(name, *limits, log=True) for name, limits in SPACES[depth].items()}
        tables: list[list[Row]] = []
        for rows in run(preset.replace(changes), planned, folders, "dev"):
            tables.append(rows)
            trial.report(loss_of(tables), len(tables))
            if trial.should_prune():
                raise optuna.TrialPruned
        return loss_of(tables)

    with Progress(console=console) as progress:
        task = progress.add_task(f"{depth}: trials", total=trials)
        study.optimize(objective, n_trials=trials, callbacks=[lambda *_: progress.advance(task)])


def report(study: optuna.Study, depth: str, folders: tuple[Path, Path], console: Console) -> Table:
    """Default against best, table by table, on the half that chose and on the one that was held out."""
    preset = Config.preset(depth)
    table = Table("half", "set", "start", "median default", "best", "P90 default", "best", "in bound", "best")
    for half in ("dev", "held-out"):
        planned = _planned(depth, half, folders[0])
        runs = [list(run(config, planned, folders, half)) for config in (preset, preset.replace(study.best_params))]
        for part, before, after in zip(planned, *runs, strict=True):
            cells = [f"{value:.4f}" for pick in (50, 90) for rows in (before, after) for value in [_error(rows, pick)]]
            cells += [
                f"{np.mean([row.get('nees', np.inf) < BOUND_95 for row in rows]):.2f}" for rows in (before, after)
            ]
            table.add_row(half, part.set, part.start, *cells)
        console.print(
            f"{half}: loss {loss_of(runs[0]):.3f} with the preset, {loss_of(runs[1]):.3f} with the best trial"
        )
    return table


def _error(rows: Sequence[Row], percentile: float) -> float:
    return float(np.percentile([min(row["e_3d_m"], 1e3) for row in rows], percentile))


def _planned(depth: str, half: str, data: Path) -> list[Part]:
    planned = parts(False, depth == MONOCULAR, [], [], half, data)
    if depth == MONOCULAR:
        planned += parts(False, True, [bare.SET], [], half, data)
    return planned


def main(
    depth: Annotated[str, typer.Option(help=f"which preset: {', '.join(SPACES)}")] = SENSOR,
    trials: Annotated[int, typer.Option(help="so many more; 0 = only report")] = 40,
    data: Annotated[Path, typer.Option(help="folder that holds dev/<set>/pairs.json")] = DATA,
    bare_rooms: Annotated[Path, typer.Option(help="folder of the generated bare rooms")] = bare.FOLDER,
    out: Annotated[Path, typer.Option(help="folder of the study")] = Path("out/tune"),
) -> None:
    """Choose settings on one half of the pairs, report on the other."""
    console = Console(width=None if sys.stdout.isatty() else 160)
    if depth not in SPACES:
        console.print(f"depth is {depth!r}: expected one of {', '.join(SPACES)}")
        raise typer.Exit(2)
    out.mkdir(parents=True, exist_ok=True)
    optuna.logging.set_verbosity(optuna.logging.WARNING)
    sampler: Any = optuna.samplers.TPESampler(seed=0, multivariate=True)
    study = optuna.create_study(
        storage=f"sqlite:///{out}/study.db",
        study_name=depth,
        sampler=sampler,
        pruner=optuna.pruners.MedianPruner(n_startup_trials=6, n_warmup_steps=1),
        load_if_exists=True,
    )
    if trials:
        search(study, depth, trials, (data, bare_rooms), console)
    console.print(f"{len(study.trials)} trials, best {study.best_value:.3f}:")
    for name, value in study.best_params.items():
        console.print(f"  {name} = {value:.4g}   (preset: {Config.preset(depth).settings()[name]:g})")
    chosen = out / f"{depth}.yaml"
    remark = f"Best of {len(study.trials)} trials of python -m bench.tune --depth {depth}: loss {study.best_value:.4f}"
    write_settings(chosen, depth, study.best_params, remark)
    console.print(f"settings: {chosen}")
    console.print(report(study, depth, (data, bare_rooms), console))


if __name__ == "__main__":
    typer.run(main)
