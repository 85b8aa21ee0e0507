# SPDX-License-Identifier: Apache-2.0
"""Weights files in the published layout, filled by `golden_rule`, in a folder of weights; and small views."""

import re
from argparse import Namespace
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import cv2
import golden_rule
import numpy as np
import torch
from box_room import TRUTH, K, room
from safetensors.torch import save_file
from torch import nn
from torch.nn.modules.module import register_module_forward_pre_hook

from garps_core import View, align
from garps_core.models.in_use import Networks
from garps_core.models.two_view import Architecture, Stack, TwoView
from garps_core.weights.manifest import BY_NAME

DEPTH, FLASH3D, BACKBONE = "depth-anything-v2-indoor-small", "flash3d", "dinov2-small"
GOLDEN = {
    DEPTH: ("dav2_vits_metric", None),
    FLASH3D: ("flash3d", None),
    BACKBONE: ("dinov2_vits14_ade20k", "backbone"),
    "dinov2-small-ade20k-linear": ("dinov2_vits14_ade20k", "linear"),
    "dinov2-small-ade20k-ms": ("dinov2_vits14_ade20k", "ms"),
}


def tensors(name: str) -> dict[str, torch.Tensor]:
    """Tensors of the official file of that name in `garps weights list`."""
    return {key: torch.from_numpy(value) for key, value in golden_rule.state(*GOLDEN[name]).items()}


def install(folder: Path, *names: str) -> Path:
    """Write the official files into a folder for $GARPS_WEIGHTS."""
    torch.exp(torch.zeros(1))  # the first large one of a process may be wrong
    for name in names:
        torch.save(tensors(name), folder / BY_NAME[name].local)
    return folder


def pair(depth: bool = False) -> tuple[View, View]:
    """Two views of 160x120 of a room, the second moved by TRUTH; with exact depth where asked for."""
    found = [room(T) for T in (np.eye(4), TRUTH)]
    return tuple(View(rgb, K, metres if depth else None) for rgb, metres in found)


def write_pair(folder: Path) -> dict[str, str]:
    """Write the views of `pair` as files: a, b, and their depth a_mm, b_mm."""
    paths = {}
    for name, view in zip("ab", pair(depth=True), strict=True):
        paths[name], paths[f"{name}_mm"] = str(folder / f"{name}.png"), str(folder / f"{name}_mm.png")
        cv2.imwrite(paths[name], view.rgb[:, :, ::-1])
        cv2.imwrite(paths[f"{name}_mm"], np.rint(view.depth * 1000).astype(np.uint16))
    return paths


def shared() -> Networks:
    """The networks that `estimate_relative_pose` uses."""
    return align.NETWORKS


@contextmanager
def passes(network: type[nn.Module]) -> Iterator[list[tuple[int, ...]]]:
    """Shapes of what enters networks of a class, pass by pass, whoever owns them."""
    seen: list[tuple[int, ...]] = []

    def note(module: nn.Module, given: tuple[torch.Tensor, ...]) -> None:
        if isinstance(module, network):
            seen.append(tuple(given[0].shape))

    hook = register_module_forward_pre_hook(note)
    try:
        yield seen
    finally:
        hook.remove()


TWO_VIEW = {"mast3r_small": "mast3r", "dust3r_dpt_small": "dust3r", "dust3r_linear_small": "dust3r"}
"""Reduced two-view networks with golden values -> their kind."""


def two_view_architecture(name: str) -> Architecture:
    """Architecture of a golden two-view network; the reduced ones have attention heads that are not 64 wide."""
    told = golden_rule.keys(name)["arch"]
    sizes = (tuple(told[f"{part}_{what}"] for what in ("embed_dim", "depth", "num_heads")) for part in ("enc", "dec"))
    encoder, decoder = (Stack(*size) for size in sizes)
    return Architecture(encoder, decoder, told["head_type"] == "linear", 24 if told.get("two_confs") else 0)


def two_view_tensors(name: str) -> dict[str, torch.Tensor]:
    """Tensors as in a safetensors file, without second names."""
    return {key: torch.from_numpy(value) for key, value in golden_rule.state(name).items()}


def with_aliases(name: str, held: dict[str, torch.Tensor]) -> dict[str, torch.Tensor]:
    """Tensors as in a torch file, some under two names."""
    return held | {alias: held[own] for alias, own in golden_rule.keys(name)["aliases"].items()}


def _two_view(width: int, decoder: int, **told: Any) -> Architecture:
    return Architecture(Stack(width, 2, width // 64), Stack(decoder, 4, decoder // 64), **told)


REDUCED = {
    "mast3r": _two_view(128, 64, descriptors=24),
    "dust3r-dpt": _two_view(128, 64),
    "dust3r-linear": _two_view(128, 64, linear=True),
    "dust3r-linear-224": _two_view(64, 64, linear=True),
}
"""Published two-view files -> networks with attention heads as wide, so that a file tells their sizes."""
AHEAD, SURE = 1.0, 3.0
"""Added to z and to the confidence, before their activations: 1.7 m, and all pixels are trusted."""


def reduced_tensors(name: str, sureness: float = SURE) -> dict[str, torch.Tensor]:
    """Tensors of a reduced network with random parameters, as in its safetensors file; its points lie ahead."""
    torch.manual_seed(len(name))
    state = TwoView(REDUCED[name]).state_dict()
    for head in ("downstream_head1", "downstream_head2"):
        if REDUCED[name].linear:
            state[f"{head}.proj.bias"].view(4, -1)[2:] += torch.tensor([[AHEAD], [sureness]])
        else:
            state[f"{head}.dpt.head.4.bias"][2:] += torch.tensor([AHEAD, sureness])
    return state


def install_reduced(folder: Path, *names: str, **changed: float) -> Path:
    """Write reduced two-view files under the published names; those that end in -pth as the authors wrote them."""
    for name in names:
        held, path = reduced_tensors(name.removesuffix("-pth"), **changed), folder / BY_NAME[name].local
        if path.suffix == ".safetensors":
            save_file(held, path)
        else:
            torch.save({"args": Namespace(model="AsymmetricMASt3R"), "model": held | second_names(held)}, path)
    return folder


def second_names(held: dict[str, torch.Tensor]) -> dict[str, torch.Tensor]:
    """The parts of a dense head that torch files hold twice, under their other names."""
    found = re.compile(r"(.*\.scratch\.)layer([1-4])_rn\.(.*)")
    told = {key: found.fullmatch(key) for key in held}
    return {f"{m[1]}layer_rn.{int(m[2]) - 1}.{m[3]}": held[key] for key, m in told.items() if m}
