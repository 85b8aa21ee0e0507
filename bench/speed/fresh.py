# SPDX-License-Identifier: Apache-2.0
"""A fresh process that estimates one pair, or aligns two mixtures, and prints its peak memory and a digest as JSON.

    python -m bench.speed.fresh estimate|align FILE.npz PRESET

It imports what the task needs and nothing else, for its memory counts.
"""

from __future__ import annotations

import hashlib
import json
import subprocess
import sys
import tempfile
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from bench.machine.cost import peak_mib
from garps_core import Config, Mixture, PoseEstimate, Prior, View, align_mixtures, estimate_relative_pose
from garps_core.mixture import Frustum

if TYPE_CHECKING:
    from bench.pairs.pair import Pair

Task = Callable[[], PoseEstimate]
PARTS = ("means", "covariances", "weights", "colours")
STEPS = 3
"""Solver steps in every rung, whatever their effect, so that all sizes do the same work."""


def all_used(config: Config, n: int, k: int) -> Config:
    """The settings with n components, k neighbours and `STEPS` steps in every rung."""
    ladder = tuple(replace(rung, components=n, neighbours=k, steps=STEPS) for rung in config.alignment.ladder)
    return config.replace({"alignment.ladder": ladder, "alignment.tolerance": 1e-9})


def digest(estimate: PoseEstimate) -> str:
    """SHA-256 of status, pose and covariance."""
    hashed = hashlib.sha256(estimate.status.value.encode())
    for part in (estimate.T_target_source, estimate.covariance):
        hashed.update(b"none" if part is None else np.ascontiguousarray(part).tobytes())
    return hashed.hexdigest()


def arrays_of(pair: Pair) -> dict[str, Any]:
    """The images of a pair, for a file. Raises ValueError without depth."""
    arrays: dict[str, Any] = {}
    for i, view in enumerate((pair.source, pair.target)):
        if view.depth is None:
            raise ValueError(f"view {i} of {pair.id} has no depth: expected an RGB-D pair")
        arrays |= {f"rgb{i}": view.rgb, f"K{i}": view.K, f"depth{i}": view.depth}
    return arrays


def arrays_of_mixtures(source: Mixture, target: Mixture, prior: Prior) -> dict[str, Any]:
    """Two mixtures with frusta and a start, for a file."""
    arrays: dict[str, Any] = {"T": prior.T_target_source, "covariance": prior.covariance}
    for i, mixture in enumerate((source, target)):
        parts = {name: getattr(mixture, name) for name in PARTS}
        if mixture.frustum is not None:
            parts |= {"K": mixture.frustum.K, "depth": mixture.frustum.depth}
        arrays |= {f"{name}{i}": value for name, value in parts.items()}
    return arrays


def in_fresh_process(task: str, arrays: dict[str, Any], preset: str) -> dict[str, Any]:
    """Run this module on the arrays and return what it prints. Raises RuntimeError when it fails."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "input.npz"
        np.savez(path, **arrays)
        command = [sys.executable, "-m", "bench.speed.fresh", task, str(path), preset]
        done = subprocess.run(command, capture_output=True, text=True, cwd=Path(__file__).parents[2])
    if done.returncode != 0:
        raise RuntimeError(f"the fresh process failed: {(done.stderr.strip().splitlines() or ['no message'])[-1]}")
    return dict(json.loads(done.stdout.strip().splitlines()[-1]))


def main(task: str, path: Path, preset: str) -> None:
    """Do the task twice and print peak memory and the digest as JSON."""
    memory: dict[str, Any] = {"imports": peak_mib()}
    with np.load(path) as held:
        run = _estimation(held, preset) if task == "estimate" else _alignment(held, preset)
    memory["loaded"] = peak_mib()
    memory["digest"] = digest(run())
    memory["done"] = peak_mib()
    run()
    memory["done twice"] = peak_mib()
    memory["packages"] = ", ".join(name for name in ("torch", "numba", "open3d") if name in sys.modules)
    print(json.dumps(memory))


def _estimation(held: Any, preset: str) -> Task:
    source, target = (View(held[f"rgb{i}"], held[f"K{i}"], held[f"depth{i}"]) for i in range(2))
    return lambda: estimate_relative_pose(source, target, Config.preset(preset))


def _alignment(held: Any, preset: str) -> Task:
    source, target = _mixture(held, 0), _mixture(held, 1)
    prior = Prior(held["T"], held["covariance"])
    config = all_used(Config.preset(preset), len(source), int(held["neighbours"]))
    return lambda: align_mixtures(source, target, prior, config)


def _mixture(held: Any, i: int) -> Mixture:
    means, covariances, weights, colours = (held[f"{name}{i}"] for name in PARTS)
    frustum = Frustum(held[f"K{i}"], held[f"depth{i}"]) if f"K{i}" in held else None
    return Mixture(means, covariances, weights, colours, None, frustum)


if __name__ == "__main__":
    main(sys.argv[1], Path(sys.argv[2]), sys.argv[3])
