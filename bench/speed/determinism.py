# SPDX-License-Identifier: Apache-2.0
"""Whether the same images give the same bits: in one process, time after time, and in fresh ones."""

from __future__ import annotations

from rich.progress import track

from bench.report.checks import Check, Section
from bench.speed.fresh import arrays_of, digest, in_fresh_process
from bench.speed.parts import Inputs
from garps_core import estimate_relative_pose

SAME_PROCESS, FRESH = 10, 2


def determinism_section(inputs: Inputs, runs: int = SAME_PROCESS, fresh: int = FRESH) -> Section:
    """Whether pose and covariance of the first pair, from its images, are the same bits every time."""
    pair = inputs.pairs[0]
    found: dict[str, list[str]] = {"this process": [], "fresh processes": []}
    for _ in track(range(runs), "same process", console=inputs.console):
        found["this process"].append(digest(estimate_relative_pose(pair.source, pair.target, inputs.config)))
    for _ in track(range(fresh), "fresh processes", console=inputs.console):
        found["fresh processes"].append(in_fresh_process("estimate", arrays_of(pair), inputs.preset)["digest"])
    everything = {value for values in found.values() for value in values}
    rows = [{"where": name, "runs": len(v), "different results": len(set(v))} for name, v in found.items()]
    check = Check(f"different results in {runs} + {fresh} runs, pose and covariance to the bit", len(everything), 1)
    return Section("Same input, same bits", [check], rows, raw=found)
