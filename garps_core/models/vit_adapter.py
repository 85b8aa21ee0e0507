# SPDX-License-Identifier: Apache-2.0
"""ViT-Adapter (Chen et al., 2022) around DINOv2: four maps at 1/4, 1/8, 1/16 and 1/32 of a picture.

Beside the transformer runs a pyramid of convolutions. Between groups of its blocks, the transformer reads from the
pyramid (injector) and the pyramid from the transformer (extractor), both by deformable attention.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from itertools import pairwise

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from garps_core.errors import InputError
from garps_core.models.deformable import (
    POINTS,
    DeformableAttention,
    Grid,
    as_maps,
    as_tokens,
    centres,
    map_size,
)
from garps_core.models.vit import EPSILON, GRID, PATCH, Attention, PatchEmbed

COARSEST = 32
"""Sides of the picture are multiples of this: the coarsest map is 1/32."""
HEAD_WIDTH = 64
"""Width of an attention head of DINOv2, in all sizes."""
PYRAMID = (64, 128, 256, 256)
"""Channels of the convolutions at 1/4, 1/8, 1/16, 1/32."""
EXTRA_EXTRACTORS = 2
"""Additional extractors behind the last group of blocks."""


@dataclass(frozen=True)
class AdapterSize:
    """Transformer: width D, blocks, inner width of the gated layers. Adapter: groups that the blocks are in, heads and
    width of the values of its attention, inner width of its convolutions.
    """

    width: int
    blocks: int
    hidden: int
    groups: int
    heads: int
    values: int
    convolved: int


def adapter_size(tensors: Mapping[str, Tensor]) -> AdapterSize:
    """The sizes that these tensors have, named as in `ViTAdapter`. Raises KeyError for a name that is missing."""
    extractor = "interactions.0.extractor"
    return AdapterSize(
        width=tensors["cls_token"].shape[-1],
        blocks=counted(tensors, "blocks."),
        hidden=len(tensors["blocks.0.mlp.w1.weight"]),
        groups=counted(tensors, "interactions."),
        heads=len(tensors[f"{extractor}.attn.attention_weights.weight"]) // POINTS,
        values=len(tensors[f"{extractor}.attn.value_proj.weight"]),
        convolved=len(tensors[f"{extractor}.ffn.fc1.weight"]),
    )


def counted(tensors: Mapping[str, Tensor], start: str) -> int:
    """Number of numbered parts whose names start with `start`."""
    return len({key.removeprefix(start).split(".")[0] for key in tensors if key.startswith(start)})


class GatedMlp(nn.Module):
    """Two layers, the first one twice and multiplied, once through SiLU."""

    def __init__(self, width: int, hidden: int) -> None:
        super().__init__()
        self.w1 = nn.Linear(width, hidden)
        self.w2 = nn.Linear(width, hidden)
        self.w3 = nn.Linear(hidden, width)

    def forward(self, x: Tensor) -> Tensor:  # noqa: D102
        y: Tensor = self.w3(F.silu(self.w1(x)) * self.w2(x))
        return y


class Block(nn.Module):
    """A block of the transformer, as its larger size names its parameters here."""

    def __init__(self, width: int, hidden: int) -> None:
        super().__init__()
        self.gamma1 = nn.Parameter(torch.ones(width))
        self.gamma2 = nn.Parameter(torch.ones(width))
        self.norm1 = nn.LayerNorm(width, eps=EPSILON)
        self.attn = Attention(width, width // HEAD_WIDTH)
        self.norm2 = nn.LayerNorm(width, eps=EPSILON)
        self.mlp = GatedMlp(width, hidden)

    def forward(self, x: Tensor) -> Tensor:  # noqa: D102
        x = x + self.gamma1 * self.attn(self.norm1(x))
        x = x + self.gamma2 * self.mlp(self.norm2(x))
        return x


def _convolved(channels: int, out: int, stride: int) -> list[nn.Module]:
    return [nn.Conv2d(channels, out, 3, stride=stride, padding=1, bias=False), nn.BatchNorm2d(out), nn.ReLU()]


class SpatialPrior(nn.Module):
    """Picture (B, 3, H, W) -> maps of width D at 1/4, 1/8, 1/16, 1/32."""

    def __init__(self, width: int) -> None:
        super().__init__()
        first = PYRAMID[0]
        stem = [*_convolved(3, first, 2), *_convolved(first, first, 1), *_convolved(first, first, 1)]
        self.stem = nn.Sequential(*stem, nn.MaxPool2d(3, stride=2, padding=1))
        self.conv2, self.conv3, self.conv4 = (nn.Sequential(*_convolved(a, b, 2)) for a, b in pairwise(PYRAMID))
        self.fc1, self.fc2, self.fc3, self.fc4 = (nn.Conv2d(channels, width, 1) for channels in PYRAMID)

    def forward(self, picture: Tensor) -> list[Tensor]:  # noqa: D102
        maps = [self.stem(picture)]
        for step in (self.conv2, self.conv3, self.conv4):
            maps.append(step(maps[-1]))
        widen = (self.fc1, self.fc2, self.fc3, self.fc4)
        return [layer(one) for layer, one in zip(widen, maps, strict=True)]


class Injector(nn.Module):
    """Attention of the transformer's tokens to the pyramid."""

    def __init__(self, size: AdapterSize) -> None:
        super().__init__()
        self.query_norm = nn.LayerNorm(size.width, eps=EPSILON)
        self.feat_norm = nn.LayerNorm(size.width, eps=EPSILON)
        self.attn = DeformableAttention(size.width, size.heads, len(PYRAMID) - 1, size.values)
        self.gamma = nn.Parameter(torch.zeros(size.width))

    def forward(self, x: Tensor, places: Tensor, pyramid: Tensor, grids: list[Grid]) -> Tensor:  # noqa: D102
        x = x + self.gamma * self.attn(self.query_norm(x), places, self.feat_norm(pyramid), grids)
        return x


class Depthwise(nn.Module):
    """3x3 convolution of every channel for itself, on each map of the pyramid."""

    def __init__(self, width: int) -> None:
        super().__init__()
        self.dwconv = nn.Conv2d(width, width, 3, padding=1, groups=width)

    def forward(self, tokens: Tensor, grids: list[Grid]) -> Tensor:  # noqa: D102
        return as_tokens([self.dwconv(one) for one in as_maps(tokens, grids)])


class ConvFfn(nn.Module):
    """Two layers with a depthwise convolution and GELU between."""

    def __init__(self, width: int, hidden: int) -> None:
        super().__init__()
        self.fc1 = nn.Linear(width, hidden)
        self.dwconv = Depthwise(hidden)
        self.fc2 = nn.Linear(hidden, width)

    def forward(self, tokens: Tensor, grids: list[Grid]) -> Tensor:  # noqa: D102
        y: Tensor = self.fc2(F.gelu(self.dwconv(self.fc1(tokens), grids)))
        return y


class Extractor(nn.Module):
    """Attention of the pyramid to the transformer's tokens."""

    def __init__(self, size: AdapterSize) -> None:
        super().__init__()
        self.query_norm = nn.LayerNorm(size.width, eps=EPSILON)
        self.feat_norm = nn.LayerNorm(size.width, eps=EPSILON)
        self.attn = DeformableAttention(size.width, size.heads, 1, size.values)
        self.ffn_norm = nn.LayerNorm(size.width, eps=EPSILON)
        self.ffn = ConvFfn(size.width, size.convolved)

    def forward(self, pyramid: Tensor, grids: list[Grid], x: Tensor, patches: Grid) -> Tensor:  # noqa: D102
        places = centres(grids, pyramid)
        pyramid = pyramid + self.attn(self.query_norm(pyramid), places, self.feat_norm(x), [patches])
        pyramid = pyramid + self.ffn(self.ffn_norm(pyramid), grids)
        return pyramid


class Interaction(nn.Module):
    """Injector before a group of blocks, extractor behind it, more of them behind the last group."""

    def __init__(self, size: AdapterSize, extra: int) -> None:
        super().__init__()
        self.injector = Injector(size)
        self.extractor = Extractor(size)
        self.extra_extractors = nn.ModuleList(Extractor(size) for _ in range(extra))

    def forward(
        self, tokens: Tensor, pyramid: Tensor, blocks: Iterable[nn.Module], grids: list[Grid], patches: Grid
    ) -> tuple[Tensor, Tensor]:
        """Tokens (B, 1 + patches, D) and pyramid (B, N, D) behind the group."""
        x = self.injector(tokens[:, 1:], centres([patches], tokens), pyramid, grids)
        tokens = torch.cat((tokens[:, :1], x), dim=1)
        for block in blocks:
            tokens = block(tokens)
        for extractor in (self.extractor, *self.extra_extractors):
            pyramid = extractor(pyramid, grids, tokens[:, 1:], patches)
        return tokens, pyramid


class ViTAdapter(nn.Module):
    """Transformer and adapter; parameters named as in the published segmenter, behind `backbone.`."""

    def __init__(self, size: AdapterSize) -> None:
        super().__init__()
        self.size = size
        self.cls_token = nn.Parameter(torch.zeros(1, 1, size.width))
        self.pos_embed = nn.Parameter(torch.zeros(1, 1 + GRID * GRID, size.width))
        self.level_embed = nn.Parameter(torch.zeros(len(PYRAMID) - 1, size.width))
        self.patch_embed = PatchEmbed(size.width)
        self.blocks = nn.ModuleList(Block(size.width, size.hidden) for _ in range(size.blocks))
        self.spm = SpatialPrior(size.width)
        last = size.groups - 1
        self.interactions = nn.ModuleList(
            Interaction(size, EXTRA_EXTRACTORS if index == last else 0) for index in range(size.groups)
        )
        self.up = nn.ConvTranspose2d(size.width, size.width, 2, stride=2)
        self.norm1, self.norm2, self.norm3, self.norm4 = (nn.BatchNorm2d(size.width) for _ in PYRAMID)

    def forward(self, picture: Tensor) -> list[Tensor]:
        """(B, 3, H, W), normalised -> maps (B, D, ., .) at 1/4, 1/8, 1/16, 1/32.

        Raises InputError unless H and W are multiples of 14 and of 32.
        """
        height, width = picture.shape[-2:]
        if height % PATCH or width % PATCH or height % COARSEST or width % COARSEST:
            raise InputError(f"network input of {height}x{width} pixels: expected multiples of {PATCH} and {COARSEST}")
        patches = (height // PATCH, width // PATCH)
        finest, *coarser = self.spm(picture)
        grids = [map_size(one) for one in coarser]
        pyramid = as_tokens([one + self.level_embed[i][:, None, None] for i, one in enumerate(coarser)])
        tokens = self.tokens(picture, patches)
        share = self.size.blocks // self.size.groups
        seen = []
        for index, group in enumerate(self.interactions):
            blocks = self.blocks[index * share : (index + 1) * share]
            tokens, pyramid = group(tokens, pyramid, blocks, grids, patches)
            seen += as_maps(tokens[:, 1:], [patches])
        maps = as_maps(pyramid, grids)
        maps = [finest + self.up(maps[0]), *maps]
        norms = (self.norm1, self.norm2, self.norm3, self.norm4)
        return [norm(one + _resized(vit, one)) for norm, one, vit in zip(norms, maps, seen, strict=True)]

    def tokens(self, picture: Tensor, patches: Grid) -> Tensor:
        """Class token and patches with their positions, (B, 1 + rows * columns, D)."""
        cls = (self.cls_token + self.pos_embed[:, :1]).expand(len(picture), -1, -1)
        return torch.cat((cls, self.patch_embed(picture) + self.positions(patches)), dim=1)

    def positions(self, patches: Grid) -> Tensor:
        """Positions of the patches, (1, rows * columns, D), resized bicubically to this very size."""
        (learned,) = as_maps(self.pos_embed[:, 1:], [(GRID, GRID)])
        resized = F.interpolate(learned.float(), size=patches, mode="bicubic", align_corners=False)
        return as_tokens([resized]).to(self.pos_embed.dtype)


def _resized(one: Tensor, like: Tensor) -> Tensor:
    return F.interpolate(one, size=like.shape[-2:], mode="bilinear", align_corners=False)
