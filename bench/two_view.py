# SPDX-License-Identifier: Apache-2.0
"""Cost of a two-view network on this machine's CPU, stage by stage, for one pair of pictures.

    python -m bench.two_view [--size full|small] [--head mast3r|dust3r|linear] [--runs 3] [--threads 2]

It runs as GARPS calls it, with random weights in the official layout (the cost does not depend on them), float32. Both
orders of the pair are decoded. The decoders' row contains the heads', which are timed again alone.
"""

from __future__ import annotations

import json
import statistics
from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import torch
import typer
from rich.console import Console

from bench.machine.cost import peak_mib, seconds_of
from bench.machine.facts import machine_facts
from bench.machine.flop import counted_flop
from bench.report.checks import Check, Row, Section, markdown
from garps_core.models.mast3r import NaverModel, cropped_input
from garps_core.models.two_view import Architecture, Stack, TwoView

Call = Callable[[], Any]
SIZES = {"full": (Stack(1024, 24, 16), Stack(768, 12, 12)), "small": (Stack(128, 3, 2), Stack(128, 12, 2))}
HEADS = {"mast3r": (False, 24), "dust3r": (False, 0), "linear": (True, 0)}


def random_network(architecture: Architecture) -> TwoView:
    """Ready to be used, filled without the initialisation that training would need."""
    with torch.device("meta"):
        network = TwoView(architecture)
    network.to_empty(device="cpu").eval().requires_grad_(False)
    for parameter in network.parameters():
        parameter.normal_(std=0.02) if parameter.dim() > 1 else parameter.fill_(1)
    return network


def stages(network: TwoView, pictures: list[Any]) -> dict[str, Call]:
    """Name -> what it does, in order; every part of a pair by itself, then the whole."""
    inputs, framings = zip(*map(cropped_input, pictures), strict=True)
    batch = torch.stack(inputs)
    rows, columns = (side // 16 for side in framings[0].size)
    with torch.inference_mode():
        tokens = network.encode(batch)
    heads, given = (network.downstream_head1, network.downstream_head2), []
    hooks = [head.register_forward_pre_hook(lambda _, args: given.append(args)) for head in heads]

    def decode() -> Any:
        return network.decode(tokens, (rows, columns), tokens.flip(0), (rows, columns))

    with torch.inference_mode():
        decode()
    for hook in hooks:
        hook.remove()
    return {
        "prepare both pictures": lambda: [cropped_input(picture) for picture in pictures],
        "encode both": lambda: network.encode(batch),
        "decode both orders, with the heads": decode,
        "heads alone, both orders": lambda: [head(*args) for head, args in zip(heads, given, strict=True)],
        "a whole pair": lambda: NaverModel(network)(*pictures),
    }


def measured(name: str, call: Call, runs: int) -> Row:
    """One line: medians; the peak is that of the process so far."""
    with torch.inference_mode():
        rounds = [seconds_of(call) for _ in range(runs)]
    wall, cpu = (statistics.median(one[i] for one in rounds) for i in (0, 1))
    return {"stage": name, "wall s": wall, "CPU s": cpu, "peak MiB": peak_mib()}


def counted(row: Row, call: Call) -> Row:
    """A line with its operations; counting them keeps intermediate results, so it comes after every peak."""
    with torch.inference_mode():
        flop = counted_flop(call) / 1e9
    return row | {"GFLOP": flop, "GFLOP per CPU s": flop / row["CPU s"]}


def main(
    size: Annotated[str, typer.Option(help=f"one of {', '.join(SIZES)}")] = "full",
    head: Annotated[str, typer.Option(help=f"one of {', '.join(HEADS)}")] = "mast3r",
    rows: Annotated[int, typer.Option(min=64, help="of the pictures")] = 360,
    columns: Annotated[int, typer.Option(min=64, help="of the pictures")] = 640,
    runs: Annotated[int, typer.Option(min=1, help="timed calls of each stage")] = 3,
    count: Annotated[bool, typer.Option(help="also the operations, by one more call of each stage")] = True,
    threads: Annotated[int, typer.Option(min=1, help="of torch")] = 2,
    out: Annotated[Path, typer.Option(help="where the results go")] = Path("out/two_view"),
) -> None:
    """Seconds, peak memory and operations of the stages of one pair."""
    for what, given, known in (("size", size, SIZES), ("head", head, HEADS)):
        if given not in known:
            raise typer.BadParameter(f"no {what} {given}: expected one of {', '.join(known)}")
    torch.set_num_threads(threads)
    console, told = Console(), machine_facts() | {"torch threads": threads, "imported MiB": round(peak_mib())}
    network = random_network(Architecture(*SIZES[size], *HEADS[head]))
    rng = np.random.default_rng(0)
    pictures = [rng.integers(0, 256, (rows, columns, 3), np.uint8) for _ in range(2)]
    parts = stages(network, pictures)
    lines = [measured(name, call, runs) for name, call in parts.items()]
    if count:
        lines = [counted(line, call) for line, call in zip(lines, parts.values(), strict=True)]
    parameters = sum(parameter.numel() for parameter in network.parameters()) / 1e6
    inside = "x".join(map(str, cropped_input(pictures[0])[1].size))
    title = f"{head} {size}, {parameters:.1f} M parameters, 2 of {rows}x{columns} seen as {inside}, medians of {runs}"
    section = Section(title, [Check("CPU seconds of a whole pair", lines[-1]["CPU s"])], lines)
    out.mkdir(parents=True, exist_ok=True)
    (out / "run.json").write_text(json.dumps({"facts": told, "pair": section.as_json()}, indent=1))
    (out / "table.md").write_text(markdown({"pair": section}, told))
    console.print((out / "table.md").read_text(), markup=False, soft_wrap=True)


if __name__ == "__main__":
    typer.run(main)
