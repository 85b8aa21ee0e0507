# SPDX-License-Identifier: Apache-2.0
"""Speed, memory and repeatability: ratios taken in one run on the same inputs, against their bars.

    python -m bench.speed [--only pairs,paper,autograd,stream,growth,determinism,memory]

Competing calls take turns after a warm-up, so that whatever else the machine does hits all alike; times are medians.
"""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Annotated

import torch
import typer
from rich.console import Console

from bench.machine.facts import machine_facts
from bench.pairs.pair import Pair, scene_points
from bench.pairs.readers.pairs_json import DATA, available, load_pairs
from bench.peers import registration
from bench.report.checks import Row, Section, markdown, print_section
from bench.speed.determinism import determinism_section
from bench.speed.growth import growth_section
from bench.speed.memory import memory_section
from bench.speed.pairs import pairs_section
from bench.speed.parts import Inputs, imported_numba
from bench.speed.solver import autograd_section, paper_section
from bench.speed.stream import stream_section
from garps_core import View

PEER_THREADS = 2
"""Threads of peers here, equal to those of GARPS; elsewhere peers get one, so that their poses repeat to the bit."""
SECTIONS: dict[str, Callable[[Inputs], Section]] = {
    "pairs": pairs_section,
    "paper": paper_section,
    "autograd": autograd_section,
    "stream": stream_section,
    "growth": growth_section,
    "determinism": determinism_section,
    "memory": memory_section,
}


def room_pair(width: int = 640, height: int = 480) -> Pair:
    """A generated room with sensor-like depth (10 deg, 0.25 m apart)."""
    from bench.rooms import make_pair

    made = make_pair(seed=1, level=2, width=width, height=height, depth_noise="sensor")
    source, target = View(made.rgb0, made.K0, made.depth0), View(made.rgb1, made.K1, made.depth1)
    points = scene_points(View(made.rgb0, made.K0, made.true_depth0))
    return Pair("room", "room-1-2", "small", source, target, made.T_1_0, points)


def chosen(only: str) -> list[str]:
    """Names of the sections to run, in their own order. Raises typer.BadParameter on another name."""
    wanted = [name.strip() for name in only.split(",")] if only else list(SECTIONS)
    unknown = [name for name in wanted if name not in SECTIONS]
    if unknown:
        raise typer.BadParameter(f"{', '.join(unknown)!r} is no section: expected some of {', '.join(SECTIONS)}")
    return [name for name in SECTIONS if name in wanted]


def facts() -> Row:
    """Machine and versions, and what decides how the kernel runs."""
    numba = "yes" if imported_numba() else "no"
    return machine_facts() | {"numba importable": numba, "torch threads": torch.get_num_threads()}


def write(out: Path, sections: dict[str, Section], told: Row) -> None:
    """Write run.json (everything) and table.md (for a document) into a folder."""
    out.mkdir(parents=True, exist_ok=True)
    held = {"facts": told, "sections": {name: section.as_json() for name, section in sections.items()}}
    (out / "run.json").write_text(json.dumps(held, indent=1))
    (out / "table.md").write_text(markdown(sections, told))


def main(
    only: Annotated[str, typer.Option(help=f"some of {', '.join(SECTIONS)}; all when empty")] = "",
    preset: Annotated[str, typer.Option(help="settings of GARPS")] = "sensor",
    runs: Annotated[int, typer.Option(min=1, help="timed calls of each method")] = 7,
    data: Annotated[Path, typer.Option(help="folder that holds dev/<set>/pairs.json")] = DATA,
    out: Annotated[Path, typer.Option(help="where the results go")] = Path("out/speed"),
) -> None:
    """Time against peers, the paper's solver and the memory bus; growth, determinism, peak memory."""
    registration.THREADS = PEER_THREADS
    names, console, told = chosen(only), Console(), facts()
    console.print("; ".join(f"{name} {value}" for name, value in told.items()), markup=False)
    pairs = [room_pair()]
    if "pairs" in names and "tum_fr1_rpy" in available(data):
        pairs += load_pairs("tum_fr1_rpy", data, limit=1)
    inputs = Inputs(preset, tuple(pairs), runs, console)
    sections: dict[str, Section] = {}
    for name in names:
        sections[name] = SECTIONS[name](inputs)
        print_section(console, sections[name])
        write(out, sections, told)  # what is there survives an interruption


if __name__ == "__main__":
    typer.run(main)
