# SPDX-License-Identifier: Apache-2.0
"""Cost of the networks on this machine's CPU, and how close they come to its own matrix multiplication.

    python -m bench.networks [--only depth-anything,flash3d] [--sizes vits,vitb,vitl] [--runs 5] [--threads 2]

Each network runs as GARPS calls it, from images, with random weights (the cost does not depend on them), float32, in a
fresh process. Every timed call stands between multiplications of large matrices, so that whatever else the machine does
hits both; numbers are medians. The share by CPU time also bears a machine whose cores are taken by others. A second
table shows where the time of a whole pair goes (`bench/networks/pair.py`).
"""

from __future__ import annotations

import json
import statistics
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from multiprocessing import get_context
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import torch
import typer
from rich.console import Console

from bench.machine.cost import peak_mib, seconds_of
from bench.machine.facts import machine_facts
from bench.machine.flop import Call, counted_flop
from bench.networks.pair import pair_lines
from bench.report.checks import Check, Row, Section, markdown, print_section

BAR_SHARE = 0.5
"""Least share of the multiplication's throughput that the default depth network must reach on two images."""
MATRIX = 2048
"""Rows and columns of the multiplied matrices."""
MULTIPLICATIONS = 4
"""Before each timed call, and after."""


@dataclass(frozen=True)
class Case:
    """One line of the table: a network of one size on images of one size."""

    network: str
    size: str
    images: int
    rows: int
    columns: int
    bar: float | None = None

    def pictures(self) -> list[Any]:
        """The images, HxWx3 uint8, of noise."""
        rng = np.random.default_rng(0)
        return [rng.integers(0, 256, (self.rows, self.columns, 3), np.uint8) for _ in range(self.images)]


def depth_anything(case: Case) -> tuple[Call, str]:
    """Depth Anything V2, and the size its images get."""
    from garps_core.models.depth_anything import DepthAnythingV2, built_from, depth_of_images, network_size

    model = built_from(DepthAnythingV2(case.size, 20.0).state_dict(), max_depth=20.0)
    pictures = case.pictures()
    rows, columns = network_size(pictures[0])
    return lambda: depth_of_images(model, pictures), f"{rows}x{columns}"


def flash3d(case: Case) -> tuple[Call, str]:
    """Flash3D on depth that is there, up to the list of Gaussians; one image at a time."""
    from garps_core.mixtures.flash3d import predict_gaussians
    from garps_core.models.flash3d import PADDED, Flash3D, flash3d_network
    from garps_core.types import View

    network = flash3d_network(Flash3D().state_dict())
    K = np.array([[case.columns, 0, case.columns / 2], [0, case.columns, case.rows / 2], [0, 0, 1.0]])
    depth = np.full((case.rows, case.columns), 3, np.float32)
    views = [View(picture, K, depth) for picture in case.pictures()]
    return lambda: [predict_gaussians(network, view) for view in views], "x".join(map(str, PADDED))


def labels_by_dinov2(case: Case) -> tuple[Call, str]:
    """DINOv2 with the linear ADE20K head; one image at a time, each as large as it is."""
    from garps_core.models.semantics import Segmenter, padded_input, segment

    network = Segmenter(case.size, last_blocks=1, classes=150).eval().requires_grad_(False)
    pictures = case.pictures()
    rows, columns = padded_input(pictures[0]).shape[-2:]
    return lambda: [segment(network, picture) for picture in pictures], f"{rows}x{columns}"


MAKERS: Mapping[str, Callable[[Case], tuple[Call, str]]] = {
    "depth-anything": depth_anything,
    "flash3d": flash3d,
    "dinov2-linear": labels_by_dinov2,
}
"""By name of the network: what makes its call, and tells the size that its input has. Add a network here."""
CASES = (
    *(Case("depth-anything", size, 1, 518, 518) for size in ("vits", "vitb", "vitl")),
    *(Case("depth-anything", size, 2, 480, 640, bar=BAR_SHARE) for size in ("vits", "vitb", "vitl")),
    Case("flash3d", "", 1, 480, 640),
    Case("dinov2-linear", "vits", 1, 480, 640),
)
"""And its lines here; a network of one size only has size "" and is always among those measured."""


def chosen(only: str, sizes: str) -> list[Case]:
    """The cases of the named networks (all when empty) and sizes. Raises typer.BadParameter on another name."""
    networks, wanted = ([part.strip() for part in names.split(",") if part.strip()] for names in (only, sizes))
    for what, names, known in (("network", networks, set(MAKERS)), ("size", wanted, {case.size for case in CASES})):
        if unknown := set(names) - known:
            raise typer.BadParameter(f"no {what} {', '.join(sorted(unknown))}: expected some of {', '.join(known)}")
    return [case for case in CASES if case.network in (networks or MAKERS) and case.size in ("", *wanted)]


def measured(case: Case, runs: int, threads: int) -> Row:
    """One line of the table; for a process of its own, whose peak memory counts."""
    torch.set_num_threads(threads)
    imported = peak_mib()
    call, inside = MAKERS[case.network](case)
    call()  # warms up
    peak = peak_mib()  # counting keeps intermediate results and would add to it
    flop = counted_flop(call)
    rounds = [_round(call, flop) for _ in range(runs)]
    told = {name: statistics.median(one[name] for one in rounds) for name in rounds[0]}
    images = f"{case.images} of {case.rows}x{case.columns}"
    names = {"network": f"{case.network} {case.size}".strip(), "images": images, "inside": inside}
    return names | told | {"peak MiB": peak, "beyond imports MiB": peak - imported, "GFLOP": flop / 1e9}


def _round(call: Call, flop: int) -> dict[str, float]:
    """A call between multiplications: its cost, its rate, and its share of their rate by wall and by CPU time."""
    matrices = [torch.ones(MATRIX, MATRIX) for _ in range(3)]

    def multiply() -> None:
        for _ in range(MULTIPLICATIONS):
            torch.mm(matrices[0], matrices[1], out=matrices[2])

    before, own, after = (seconds_of(action) for action in (multiply, call, multiply))
    product_flop = 2 * 2 * MULTIPLICATIONS * MATRIX**3
    wall_rate, cpu_rate = (product_flop / (before[i] + after[i]) for i in (0, 1))
    return {
        "wall s": own[0],
        "CPU s": own[1],
        "GFLOP/s": flop / own[0] / 1e9,
        "matrices GFLOP/s": wall_rate / 1e9,
        "share": flop / own[0] / wall_rate,
        "share by CPU time": flop / own[1] / cpu_rate,
    }


def lines(cases: list[Case], runs: int, threads: int) -> Iterator[Row]:
    """A line per case, each from a process of its own."""
    with get_context("spawn").Pool(1, maxtasksperchild=1) as pool:
        for case in cases:
            yield pool.apply(measured, (case, runs, threads))


def main(
    only: Annotated[str, typer.Option(help=f"some of {', '.join(MAKERS)}; all when empty")] = "",
    sizes: Annotated[str, typer.Option(help="some of vits, vitb, vitl, where a network has sizes")] = "vits",
    runs: Annotated[int, typer.Option(min=1, help="timed calls of each")] = 5,
    threads: Annotated[int, typer.Option(min=1, help="of torch")] = 2,
    pairs: Annotated[bool, typer.Option(help="also the stages of a whole pair")] = True,
    out: Annotated[Path, typer.Option(help="where the results go")] = Path("out/networks"),
) -> None:
    """CPU seconds, peak memory and throughput of the networks, and their share of what matrices reach here."""
    cases, console = chosen(only, sizes), Console()
    told = machine_facts() | {"torch threads": threads}
    console.print("; ".join(f"{name} {value}" for name, value in told.items()), markup=False)
    rows, checks = [], []
    for case, row in zip(cases, lines(cases, runs, threads), strict=True):
        what = f"share of matrix multiplication, {row['network']}, {row['images']}"
        rows.append(row)
        checks += [Check(what, row["share"], case.bar, at_least=True)] if case.bar is not None else []
        console.print(f"{row['network']}, {row['images']}: {row['wall s']:.2f} s", markup=False)
    title = f"float32, {threads} threads, medians of {runs}"
    sections = {"networks": Section(f"Networks, {title}", checks, rows)}
    if pairs:
        sections["pairs"] = Section(f"A pair of 640x480 without depth, {title}", [], pair_lines(runs, threads))
    for section in sections.values():
        print_section(console, section)
    out.mkdir(parents=True, exist_ok=True)
    found = {name: section.as_json() for name, section in sections.items()}
    (out / "run.json").write_text(json.dumps({"facts": told} | found, indent=1))
    (out / "table.md").write_text(markdown(sections, told))


if __name__ == "__main__":
    typer.run(main)
