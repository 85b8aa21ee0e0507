# SPDX-License-Identifier: Apache-2.0
"""Time of each stage of a whole pair that comes without depth: both depths, mixtures, start, alignment.

The weights are random, so the depth network computes all it has to, and then its output is replaced by a generated
room's depth as such a network gives it. Otherwise the other stages would have nothing to work on. Flash3D keeps its own
output, which means nothing: with it the start and the alignment cost what they cost on a pair that cannot be aligned.
"""

from __future__ import annotations

import os
import statistics
import tempfile
from collections.abc import Callable
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch

from bench.machine.cost import peak_mib, seconds_of
from bench.report.checks import Row
from bench.rooms import RoomPair, make_pair
from garps_core import Config, PoseEstimate, View, estimate_relative_pose
from garps_core.align import NETWORKS
from garps_core.models.depth_anything import DepthAnythingV2
from garps_core.models.flash3d import Flash3D
from garps_core.weights.manifest import BY_NAME

METHODS = ("depth_anything_v2", "flash3d")
STAGES = ("depth", "reconstruct", "initialise", "align")
ROOM = 3
"""Seed of the room; its views are 0.25 m and 10 degrees apart."""


def install(folder: Path, method: str) -> None:
    """Put random weights of the networks that a method needs where GARPS looks for them from now on."""
    networks: dict[str, torch.nn.Module] = {"depth-anything-v2-indoor-small": DepthAnythingV2("vits", 20.0)}
    if method == "flash3d":
        networks["flash3d"] = Flash3D()
    for name, network in networks.items():
        torch.save(network.state_dict(), folder / BY_NAME[name].local)
    os.environ["GARPS_WEIGHTS"] = str(folder)


def answering(depths: tuple[Any, Any]) -> Callable[..., torch.Tensor]:
    """A hook that computes nothing away: it replaces a network's output (2, h, w) by these depths, HxW m."""

    def hook(_module: Any, _given: Any, out: torch.Tensor) -> torch.Tensor:
        rows, columns = out.shape[-2:]
        return torch.from_numpy(np.stack([cv2.resize(depth, (columns, rows)) for depth in depths])).to(out)

    return hook


def views_of(pair: RoomPair) -> tuple[View, View]:
    """Both views without any depth."""
    return View(pair.rgb0, pair.K0), View(pair.rgb1, pair.K1)


def measured_pair(method: str, runs: int, threads: int) -> Row:
    """One line: medians of the stages and of the whole; for a process of its own, whose peak memory counts."""
    torch.set_num_threads(threads)
    imported = peak_mib()
    pair = make_pair(ROOM, level=2, depth_noise="monocular")
    config = Config.preset("monocular").replace({"reconstruction.method": method})
    found: list[PoseEstimate] = []
    with tempfile.TemporaryDirectory() as folder:
        install(Path(folder), method)
        NETWORKS.depth_network(config).register_forward_hook(answering((pair.depth0, pair.depth1)))

        def call() -> None:
            found.append(estimate_relative_pose(*views_of(pair), config))

        call()  # loads, compiles, warms up
        peak = peak_mib()
        whole = [seconds_of(call) for _ in range(runs)]
    stages = {f"{name} s": statistics.median(one.seconds[name] for one in found[1:]) for name in STAGES}
    wall, cpu = (statistics.median(one[i] for one in whole) for i in (0, 1))
    told = {"wall s": wall, "CPU s": cpu, "peak MiB": peak, "beyond imports MiB": peak - imported}
    return {"reconstruction.method": method} | stages | told | {"status": found[-1].status.value}


def pair_lines(runs: int, threads: int) -> list[Row]:
    """A line per method, each from a process of its own."""
    with get_context("spawn").Pool(1, maxtasksperchild=1) as pool:
        return [pool.apply(measured_pair, (method, runs, threads)) for method in METHODS]
