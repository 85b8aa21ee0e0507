# SPDX-License-Identifier: Apache-2.0
"""Heads of the two-view networks: tokens of one view -> a point, a confidence and a descriptor for every pixel.

DUSt3R (Wang et al. 2024) has a linear or a dense head, MASt3R (Leroy et al. 2024) a dense one and a small network for
descriptors. Parameters are named as in their files.
"""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from garps_core.errors import WeightsError
from garps_core.models.dpt import Fusion, Grid, enlarged

PATCH = 16
"""Side of a patch, pixels."""
CHANNELS = (96, 192, 384, 768)
"""Channels of the dense head's pyramid, fine to coarse."""
FEATURES = 256
"""Channels of the dense head's fusion."""
POINT_CHANNELS = 4
"""Channels of a point map: x, y, z and confidence, before the activations."""
LEAST_LENGTH = 1e-8


@dataclass(frozen=True, eq=False)
class ViewMaps:
    """The output of the network for the pixels of one view, B of them at once.

    Args:
        points: (B, h, w, 3), x right, y down, z forward in the first view's camera.
        confidence: (B, h, w), above 1.
        descriptors: (B, h, w, C) unit vectors, or None.
        descriptor_confidence: (B, h, w), above 0, or None.
    """

    points: Tensor
    confidence: Tensor
    descriptors: Tensor | None = None
    descriptor_confidence: Tensor | None = None


class CroppedFusion(Fusion):
    """The fusion with every map enlarged to exactly twice its size, and the coarsest cut to the size of the next."""

    def fuse(self, pyramid: Sequence[Tensor]) -> Tensor:
        """Levels, fine to coarse, (B, CHANNELS[i], h_i, w_i) -> (B, FEATURES, 2 h_0, 2 w_0)."""
        named = dict(self.named_children())
        levels: list[Tensor] = [named[f"layer{i}_rn"](level) for i, level in enumerate(pyramid, 1)]
        path: Tensor = named["refinenet4"](levels[3])
        path = path[..., : levels[2].shape[-2], : levels[2].shape[-1]]  # of an odd grid one more came out
        for i in (3, 2, 1):
            path = named[f"refinenet{i}"](path, levels[i - 1])
        return path


class DensePrediction(nn.Module):
    """Four maps of one view -> four numbers for every pixel, before the activations."""

    def __init__(self, widths: Sequence[int]) -> None:
        super().__init__()
        first, second, _, last = CHANNELS
        resized: tuple[tuple[nn.Module, ...], ...] = (
            (nn.ConvTranspose2d(first, first, kernel_size=4, stride=4),),
            (nn.ConvTranspose2d(second, second, kernel_size=2, stride=2),),
            (),
            (nn.Conv2d(last, last, kernel_size=3, stride=2, padding=1),),
        )
        self.act_postprocess = nn.ModuleList(
            nn.Sequential(nn.Conv2d(width, channels, kernel_size=1), *resize)
            for width, channels, resize in zip(widths, CHANNELS, resized, strict=True)
        )
        self.scratch = CroppedFusion(CHANNELS, FEATURES)
        self.head = nn.Sequential(
            nn.Conv2d(FEATURES, FEATURES // 2, kernel_size=3, padding=1),
            Doubled(),
            nn.Conv2d(FEATURES // 2, FEATURES // 2, kernel_size=3, padding=1),
            nn.ReLU(inplace=True),
            nn.Conv2d(FEATURES // 2, POINT_CHANNELS, kernel_size=1),
        )

    def forward(self, maps: Sequence[Tensor]) -> Tensor:
        """Four maps (B, D_i, rows, columns), shallow to deep -> (B, 4, 16 rows, 16 columns)."""
        pyramid = [adapt(found) for adapt, found in zip(self.act_postprocess, maps, strict=True)]
        raw: Tensor = self.head(self.scratch.fuse(pyramid))
        return raw


class Doubled(nn.Module):
    """Twice the size, corner pixels on corner pixels."""

    def forward(self, x: Tensor) -> Tensor:
        """(B, C, h, w) -> (B, C, 2 h, 2 w)."""
        return enlarged(x, (2 * x.shape[-2], 2 * x.shape[-1]))


class LocalFeatures(nn.Module):
    """Token of the encoder and of the decoder -> descriptors of a patch's pixels and how sure they are."""

    def __init__(self, width: int, descriptors: int) -> None:
        super().__init__()
        self.fc1 = nn.Linear(width, 4 * width)
        self.fc2 = nn.Linear(4 * width, (descriptors + 1) * PATCH**2)

    def forward(self, tokens: Tensor) -> Tensor:
        """(B, N, D) -> (B, N, (C + 1) * 256)."""
        found: Tensor = self.fc2(F.gelu(self.fc1(tokens)))
        return found


class DenseHead(nn.Module):
    """Points by convolutions over four depths of the decoder; descriptors, if any, from the first and the last."""

    def __init__(self, encoder: int, decoder: int, blocks: int, descriptors: int) -> None:
        super().__init__()
        self.taps = (0, blocks // 2, 3 * blocks // 4, blocks)
        self.dpt = DensePrediction([encoder if tap == 0 else decoder for tap in self.taps])
        self.head_local_features = LocalFeatures(encoder + decoder, descriptors) if descriptors else None

    def forward(self, tokens: Sequence[Tensor], grid: Grid) -> ViewMaps:
        """Encoder's tokens, then those of every block, (B, N, D) each; grid: rows and columns, N in all."""
        maps = [tokens[tap].reshape(-1, *grid, tokens[tap].shape[-1]).permute(0, 3, 1, 2) for tap in self.taps]
        points, confidence = activated(self.dpt(maps).permute(0, 2, 3, 1))
        if self.head_local_features is None:
            return ViewMaps(points, confidence)
        local = pixels(self.head_local_features(torch.cat((tokens[0], tokens[-1]), dim=-1)), grid)
        return ViewMaps(points, confidence, F.normalize(local[..., :-1], dim=-1), local[..., -1].exp())


class LinearHead(nn.Module):
    """Points by one linear layer on the decoder's last tokens."""

    def __init__(self, decoder: int) -> None:
        super().__init__()
        self.proj = nn.Linear(decoder, POINT_CHANNELS * PATCH**2)

    def forward(self, tokens: Sequence[Tensor], grid: Grid) -> ViewMaps:
        """Return points and confidence as `DenseHead` does."""
        return ViewMaps(*activated(pixels(self.proj(tokens[-1]), grid)))


def activated(raw: Tensor) -> tuple[Tensor, Tensor]:
    """(B, h, w, 4) -> points (B, h, w, 3), whose distance is expm1 of the vector's length, and confidence (B, h, w)."""
    vector = raw[..., :3]
    length = vector.norm(dim=-1, keepdim=True)
    return vector / length.clamp(min=LEAST_LENGTH) * length.expm1(), 1 + raw[..., 3].exp()


def pixels(tokens: Tensor, grid: Grid) -> Tensor:
    """(B, rows * columns, C * 256), of a token channel by channel and row by row -> (B, 16 rows, 16 columns, C)."""
    rows, columns = grid
    patches = tokens.reshape(len(tokens), rows, columns, -1, PATCH, PATCH)
    return patches.permute(0, 1, 4, 2, 5, 3).reshape(len(tokens), PATCH * rows, PATCH * columns, -1)


_ALIAS = re.compile(r"(.*\.scratch\.)layer_rn\.([0-3])\.(.*)")


def without_aliases(tensors: Mapping[str, Tensor]) -> tuple[dict[str, Tensor], dict[str, int]]:
    """Every tensor under its one name; torch files name some of the dense head's twice.

    Returns them, and how many second names were left out, by how these begin. Raises WeightsError where both differ.
    """
    kept = {}
    left: Counter[str] = Counter()
    for key, tensor in tensors.items():
        alias = _ALIAS.fullmatch(key)
        name = f"{alias[1]}layer{int(alias[2]) + 1}_rn.{alias[3]}" if alias else key
        if alias and name in tensors:
            if not torch.equal(tensor, tensors[name]):
                raise WeightsError(f"{key} differs from {name}: expected the same values under both names")
            left[f"{alias[1]}layer_rn"] += 1
        else:
            kept[name] = tensor
    return kept, dict(left)
