# SPDX-License-Identifier: Apache-2.0
"""Train the demonstration depth network (`garps_core/models/demo_net.py`) on generated rooms, on a CPU.

    python -m bench.training.rooms                 # the rooms, once
    python -m bench.train_depth                # goes on where it was stopped
    python -m bench.train_depth --steps 200    # a try

Every step is drawn from its own number and the seed, so that a training that was stopped and resumed is the same as one
that was not. Pictures are cropped, mirrored and recoloured; a crop changes the intrinsics, which the network is told.
The last weights are averaged over steps, batch norms folded into convolutions, and written as float16.
"""

from __future__ import annotations

import copy
import json
import math
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import torch
import typer
from rich.console import Console
from rich.progress import Progress
from torch import Tensor, nn
from torch.nn.utils.fusion import fuse_conv_bn_eval

from bench.machine.facts import machine_facts
from bench.rows.depth_errors import DepthErrors, depth_errors
from bench.training.pictures import BATCH, Pictures, batches
from bench.training.rooms import FIRST_SEED, FOLDER, render
from garps_core.models.demo_net import FILE, WHAT_IT_IS, DemoNet, Unit
from garps_core.weights.reader import write_tensors

HELD_OUT_SEED = 90_000
"""First seed of the rooms that only measure."""
RATE, DECAY = 2e-3, 1e-2
WARM_UP = 300
"""Steps of a rising rate, which then falls as a cosine to nothing."""
AVERAGE = 0.998
"""Decay of the running mean of the weights, per step."""
SLOPES_WEIGHT = 0.5
"""Weight of the differences between neighbours, against that of the values."""
SAVE_EVERY = 200


def loss_of(found: Tensor, wanted: Tensor) -> Tensor:
    """Mean error of the logarithm, and of its differences between pixels 1, 2, 4 and 8 apart; (B, h, w) each."""
    known = wanted.isfinite()
    off = torch.where(known, found - wanted, 0.0)
    total = off.abs().sum() / known.sum().clamp_min(1)
    for step in (1, 2, 4, 8):
        for a, b in (
            ((..., slice(step, None)), (..., slice(None, -step))),
            ((..., slice(step, None), slice(None)), (..., slice(None, -step), slice(None))),
        ):
            both = known[a] & known[b]
            total = total + SLOPES_WEIGHT / 4 * (((off[a] - off[b]).abs() * both).sum() / both.sum().clamp_min(1))
    return total


def rate_at(step: int, steps: int) -> float:
    """Learning rate."""
    if step < WARM_UP:
        return RATE * (step + 1) / WARM_UP
    return RATE * 0.5 * (1 + math.cos(math.pi * (step - WARM_UP) / max(steps - WARM_UP, 1)))


@dataclass
class Training:
    """Network, its averaged copy, optimiser and the step they are at."""

    network: DemoNet
    averaged: DemoNet
    optimiser: torch.optim.Optimizer
    step: int = 0

    @classmethod
    def begun(cls, seed: int) -> Training:
        """From random weights."""
        torch.manual_seed(seed)
        network = DemoNet(norm=True).to(memory_format=torch.channels_last)  # type: ignore[call-overload]
        averaged = copy.deepcopy(network).requires_grad_(False)
        return cls(network, averaged, torch.optim.AdamW(network.parameters(), RATE, weight_decay=DECAY))

    def save(self, path: Path) -> None:
        """All of it, whole or not at all."""
        parts = {name: getattr(self, name).state_dict() for name in ("network", "averaged", "optimiser")}
        unfinished = path.with_suffix(".unfinished")
        torch.save(parts | {"step": self.step}, unfinished)
        unfinished.replace(path)

    def resume(self, path: Path) -> None:
        """Go on from what `save` has written."""
        kept = torch.load(path, weights_only=True)
        for name in ("network", "averaged", "optimiser"):
            getattr(self, name).load_state_dict(kept[name])
        self.step = kept["step"]

    def take(self, seen: Tensor, wanted: Tensor, steps: int, bfloat16: bool = False) -> float:
        """One step; returns the loss."""
        for group in self.optimiser.param_groups:
            group["lr"] = rate_at(self.step, steps)
        with torch.autocast("cpu", torch.bfloat16, enabled=bfloat16):
            found = self.network(seen.contiguous(memory_format=torch.channels_last))
        loss = loss_of(found.float(), wanted)
        self.optimiser.zero_grad()
        loss.backward()  # type: ignore[no-untyped-call]
        nn.utils.clip_grad_norm_(self.network.parameters(), 5.0)
        self.optimiser.step()
        keep = min(AVERAGE, (self.step + 1) / (self.step + 10))
        for mean, now in zip(self.averaged.state_dict().values(), self.network.state_dict().values(), strict=True):
            mean.lerp_(now, 1 - keep) if mean.is_floating_point() else mean.copy_(now)
        self.step += 1
        return float(loss.detach())


def folded(network: DemoNet) -> DemoNet:
    """An equal network without batch norms."""
    plain = copy.deepcopy(network).eval()
    for unit in [module for module in plain.modules() if isinstance(module, Unit)]:
        unit[0], unit[1] = fuse_conv_bn_eval(unit[0], unit[1]), nn.Identity()
    return plain


def measured(network: nn.Module, pictures: Pictures) -> dict[str, float]:
    """AbsRel and the share of pixels within a factor of 1.25, means over pictures; and AbsRel with the scale given."""
    network.eval()
    rows: list[DepthErrors] = []
    for i in range(0, len(pictures), BATCH):
        samples = [pictures.whole(j) for j in range(i, min(i + BATCH, len(pictures)))]
        with torch.inference_mode():
            found = network(torch.from_numpy(np.stack([one.seen for one in samples]))).numpy()
        rows += [depth_errors(np.exp(ours), np.exp(one.wanted)) for one, ours in zip(samples, found, strict=True)]
    mean = DepthErrors(*np.mean(rows, axis=0).tolist())
    return {"AbsRel": mean.abs_rel, "delta<1.25": mean.delta, "AbsRel, scale given": mean.shape}


def main(
    data: Annotated[Path, typer.Option(help="folder of the rooms")] = FOLDER,
    rooms: Annotated[int, typer.Option(help="to learn from; those that are there")] = 1000,
    held_out: Annotated[int, typer.Option(help="rooms to measure on; rendered if they are not there")] = 20,
    steps: Annotated[int, typer.Option(min=1, help=f"of {BATCH} pictures")] = 10_000,
    seed: Annotated[int, typer.Option(help="of weights and pictures")] = 0,
    threads: Annotated[int, typer.Option(min=1, help="of torch")] = 2,
    bfloat16: Annotated[bool, typer.Option(help="convolve in it: faster on processors that can")] = False,
    out: Annotated[Path, typer.Option(help="checkpoint, log and weights")] = Path("out/train_depth"),
) -> None:
    """Train the demonstration depth network."""
    torch.set_num_threads(threads)
    out.mkdir(parents=True, exist_ok=True)
    data.mkdir(parents=True, exist_ok=True)
    console, checkpoint = Console(), out / "checkpoint.pt"
    pictures = Pictures(data, range(FIRST_SEED, FIRST_SEED + rooms))
    unseen = range(HELD_OUT_SEED, HELD_OUT_SEED + held_out)
    for other in unseen:
        render(other, data)
    judged = Pictures(data, unseen)
    console.print(
        f"{len(pictures)} pictures of {pictures.rooms} rooms; measured on {len(judged)} of {judged.rooms} others"
    )
    training = Training.begun(seed)
    if checkpoint.is_file():
        training.resume(checkpoint)
        console.print(f"resumed at step {training.step}")
    _train(training, pictures, steps, seed, bfloat16, checkpoint, out / "log.jsonl")
    plain = folded(training.averaged)
    found = measured(plain, judged)
    facts: dict[str, Any] = {"what": WHAT_IT_IS, "licence": "Apache-2.0", "trained_by": "python -m bench.train_depth"}
    facts |= machine_facts()
    facts |= {"steps": steps, "rooms": pictures.rooms, "seed": seed, "bfloat16": bfloat16}
    facts |= found
    halved = {name: value.half().contiguous() for name, value in plain.state_dict().items()}
    write_tensors(out / FILE, halved, {name: str(value) for name, value in facts.items()})
    (out / "facts.json").write_text(json.dumps(facts, indent=1))
    console.print(found)


def _train(
    training: Training, pictures: Pictures, steps: int, seed: int, bfloat16: bool, checkpoint: Path, log: Path
) -> None:
    begin, recent = time.monotonic(), 0.0
    with Progress() as bars, log.open("a", encoding="utf-8") as lines:
        bar = bars.add_task("steps", total=steps, completed=training.step)
        for seen, wanted in batches(pictures, training.step, steps, seed):
            training.network.train()
            loss = training.take(seen, wanted, steps, bfloat16)
            recent = loss if recent == 0 else 0.98 * recent + 0.02 * loss
            bars.update(bar, completed=training.step, description=f"steps, loss {recent:.3f}")
            if training.step % SAVE_EVERY == 0 or training.step == steps:
                training.save(checkpoint)
                line = {"step": training.step, "loss": round(recent, 4), "s": round(time.monotonic() - begin)}
                lines.write(json.dumps(line) + "\n")
                lines.flush()


if __name__ == "__main__":
    typer.run(main)
