# SPDX-License-Identifier: Apache-2.0
"""Wall time end to end from two 640x480 RGB-D images, against peers in the same run, and peak memory.

    python -m bench.speed

Every call starts from the images: lifting, features, clouds, voxels and normals are inside. After one warm-up call
each, the methods take turns, so that whatever else the machine does hits all alike.
"""

from __future__ import annotations

import json
import resource
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer
from rich.console import Console
from rich.progress import track
from rich.table import Table

from bench.baselines import METHODS
from bench.datasets import DATA, Pair, available, disturbed_prior, load_pairs, scene_points
from bench.tables import machine_facts
from garps_core import Config, PoseEstimate, View, estimate_relative_pose, metrics
from garps_core.checks import Float64Array

GARPS, GARPS_PRIOR = "garps", "garps, start given"
PEERS = ("open3d-colored", "open3d-colored-fast", "small-gicp", "sift-pnp")
Row = dict[str, Any]


def room_pair(width: int = 640, height: int = 480) -> Pair:
    """A generated room with sensor-like depth (10 deg, 0.25 m apart)."""
    from bench.rooms import make_pair

    made = make_pair(seed=1, level=2, width=width, height=height, depth_noise="sensor")
    source, target = View(made.rgb0, made.K0, made.depth0), View(made.rgb1, made.K1, made.depth1)
    points = scene_points(View(made.rgb0, made.K0, made.true_depth0))
    return Pair("room", "room-1-2", "small", source, target, made.T_1_0, points)


def measure(pair: Pair, config: Config, runs: int, console: Console | None = None) -> list[Row]:
    """Time every method on one pair, interleaved: rows with the times of all runs (s) and the last pose's error."""
    prior = disturbed_prior(pair)
    estimates: dict[str, PoseEstimate] = {}

    def garps(name: str, given: Any) -> Float64Array | None:
        estimates[name] = estimate_relative_pose(pair.source, pair.target, config, given)
        return estimates[name].T_target_source

    calls: dict[str, Callable[[], Float64Array | None]] = {
        GARPS: lambda: garps(GARPS, None),
        GARPS_PRIOR: lambda: garps(GARPS_PRIOR, prior),
    }
    for name in PEERS:
        calls[name] = lambda name=name: METHODS[name](pair.source, pair.target, prior.T_target_source).T
    rows: dict[str, Row] = {name: {"pair": pair.id, "method": name, "times": [], "stages": {}} for name in calls}
    for run in track(range(runs + 1), f"{pair.set}", console=console, disable=console is None):
        for name, call in calls.items():
            began = time.perf_counter()
            T = call()
            seconds = time.perf_counter() - began
            rows[name]["e_3d_m"] = _error(T, pair)
            if run == 0:  # warm-up: compilation, thread pools, caches
                continue
            rows[name]["times"].append(seconds)
            for stage, value in estimates[name].seconds.items() if name in estimates else ():
                rows[name]["stages"].setdefault(stage, []).append(value)
    return list(rows.values())


def _error(T: Float64Array | None, pair: Pair) -> float:
    return float("inf") if T is None else metrics.error_3d_m(T, pair.T_target_source, pair.points)


def print_times(console: Console, title: str, rows: list[Row]) -> None:
    """Median and best times, and how many times as long as GARPS the others take."""
    own = {row["method"]: float(np.median(row["times"])) for row in rows}
    table = Table(title=title, title_justify="left")
    for heading in ("method", "median s", "best s", f"x {GARPS}", f"x {GARPS_PRIOR}", "E_3D m"):
        table.add_column(heading, justify="left" if heading == "method" else "right")
    for row in rows:
        median = own[row["method"]]
        ratios = [f"{median / own[name]:.2f}" for name in (GARPS, GARPS_PRIOR)]
        table.add_row(row["method"], f"{median:.3f}", f"{min(row['times']):.3f}", *ratios, f"{row['e_3d_m']:.4f}")
    console.print(table)
    for row in rows:
        if row["stages"]:
            stages = ", ".join(f"{stage} {np.median(values) * 1e3:.0f} ms" for stage, values in row["stages"].items())
            console.print(f"{row['method']}: {stages}")


def measure_memory(pair: Pair, preset: str) -> Row:
    """Peak resident memory of a fresh process that does nothing but estimate this pair, MiB."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "pair.npz"
        arrays = {"rgb": pair.source.rgb, "K": pair.source.K, "depth": pair.source.depth}
        arrays |= {"rgb1": pair.target.rgb, "K1": pair.target.K, "depth1": pair.target.depth}
        np.savez(path, **{name: value for name, value in arrays.items() if value is not None})
        command = [sys.executable, "-m", "bench.speed", "--memory-of", str(path), "--preset", preset]
        done = subprocess.run(command, capture_output=True, text=True, cwd=Path(__file__).parents[1])
    if done.returncode != 0:
        return {"failed": (done.stderr.strip().splitlines() or ["no message"])[-1]}
    return dict(json.loads(done.stdout.strip().splitlines()[-1]))


def _report_memory(path: Path, config: Config) -> None:
    """What the fresh process does: prints its memory as JSON."""
    with np.load(path) as held:
        views = [View(held[f"rgb{i}"], held[f"K{i}"], held[f"depth{i}"]) for i in ("", "1")]
    memory = {"imports and images MiB": _peak_mib()}
    estimate_relative_pose(views[0], views[1], config)
    memory["first estimate MiB"] = _peak_mib()
    estimate_relative_pose(views[0], views[1], config)
    memory["second estimate MiB"] = _peak_mib()
    print(json.dumps(memory | {"open3d imported": "open3d" in sys.modules, "torch imported": "torch" in sys.modules}))


def _peak_mib() -> float:
    """Peak resident memory of this process so far.

    Linux hands the parent's peak on to a forked child's ru_maxrss; VmHWM begins anew with each program.
    """
    status = Path("/proc/self/status")
    if status.is_file():
        peaks = [line for line in status.read_text().splitlines() if line.startswith("VmHWM")]
        if peaks:
            return round(int(peaks[0].split()[1]) / 1024, 1)
    unit = 2**20 if sys.platform == "darwin" else 2**10
    return round(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / unit, 1)


def main(
    preset: Annotated[str, typer.Option(help="settings of GARPS")] = "sensor",
    runs: Annotated[int, typer.Option(min=1, help="timed calls of each method")] = 7,
    data: Annotated[Path, typer.Option(help="folder that holds dev/<set>/pairs.json")] = DATA,
    out: Annotated[Path, typer.Option(help="where the times go")] = Path("out/speed"),
    memory_of: Annotated[Path | None, typer.Option(hidden=True)] = None,
) -> None:
    """Wall time against peers, and peak memory."""
    config = Config.preset(preset)
    if memory_of is not None:
        _report_memory(memory_of, config)
        return
    console, results = Console(), []
    pairs = [room_pair()]
    if "tum_fr1_rpy" in available(data):
        pairs += load_pairs("tum_fr1_rpy", data, limit=1)
    facts = machine_facts()
    console.print("; ".join(f"{name} {value}" for name, value in facts.items()))
    memory = measure_memory(pairs[0], preset)
    for pair in pairs:
        rows = measure(pair, config, runs, console)
        height, width = pair.source.rgb.shape[:2]
        print_times(console, f"{pair.set} {pair.id}, {width}x{height}, {runs} runs", rows)
        results += rows
    console.print("fresh process: " + ", ".join(f"{name} {value}" for name, value in memory.items()))
    out.mkdir(parents=True, exist_ok=True)
    (out / "run.json").write_text(json.dumps({"facts": facts, "memory": memory, "rows": results}, indent=1))


if __name__ == "__main__":
    typer.run(main)
