# SPDX-License-Identifier: Apache-2.0
"""Two-view transformer of DUSt3R (Wang et al. 2024) and MASt3R (Leroy et al. 2024); parameters named as in their files.

Both views pass the same encoder. Two decoders then read them side by side, each block looking at its own view and at
the other one, and a head per view gives for every pixel the point that it sees, in the first view's camera frame.
Positions are rotations of queries and keys (RoPE), so that any grid of patches will do.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from garps_core.errors import InputError, WeightsError
from garps_core.models.dpt import Grid
from garps_core.models.two_view_heads import PATCH, DenseHead, LinearHead, ViewMaps, without_aliases
from garps_core.models.vit import EPSILON, Mlp
from garps_core.weights.state_dict import load_strictly, recognised

BASE = 100.0
"""Base of the rotations, which go from 1 radian per patch down to nearly 1/BASE."""
HEAD_WIDTH = 64
"""Channels of an attention head in every published network; the tensors do not tell."""
MOST_BLOCKS = 64

Rotation = tuple[Tensor, Tensor]
"""Cosine and sine per token, (N, 2, head width / 4): of its row, of its column."""


@dataclass(frozen=True)
class Stack:
    """Token width, number of blocks and of attention heads."""

    width: int
    blocks: int
    heads: int


@dataclass(frozen=True)
class Architecture:
    """Sizes of a network; with descriptors it is a MASt3R, with a linear head it has none."""

    encoder: Stack = Stack(1024, 24, 16)
    decoder: Stack = Stack(768, 12, 12)
    linear: bool = False
    descriptors: int = 0

    @property
    def name(self) -> str:
        """Name of the architecture in words."""
        return "MASt3R" if self.descriptors else f"DUSt3R with a {'linear' if self.linear else 'DPT'} head"


class PatchEmbed(nn.Module):
    """One token per patch of a picture, row-major."""

    def __init__(self, width: int) -> None:
        super().__init__()
        self.proj = nn.Conv2d(3, width, kernel_size=PATCH, stride=PATCH)

    def forward(self, pictures: Tensor) -> Tensor:
        """(B, 3, H, W), sides multiples of 16 -> (B, H/16 * W/16, D)."""
        patches: Tensor = self.proj(pictures)
        return patches.flatten(2).transpose(1, 2)


class SelfAttention(nn.Module):
    """Every token looks at all tokens of its view."""

    def __init__(self, width: int, heads: int) -> None:
        super().__init__()
        self.heads = heads
        self.qkv = nn.Linear(width, 3 * width)
        self.proj = nn.Linear(width, width)

    def forward(self, x: Tensor, turn: Rotation) -> Tensor:
        """(B, N, D) -> (B, N, D)."""
        q, k, v = self.qkv(x).unflatten(-1, (3, self.heads, -1)).permute(2, 0, 3, 1, 4)
        seen: Tensor = self.proj(attended(rotated(q, turn), rotated(k, turn), v))
        return seen


class CrossAttention(nn.Module):
    """Every token looks at all tokens of the other view."""

    def __init__(self, width: int, heads: int) -> None:
        super().__init__()
        self.heads = heads
        self.projq = nn.Linear(width, width)
        self.projk = nn.Linear(width, width)
        self.projv = nn.Linear(width, width)
        self.proj = nn.Linear(width, width)

    def forward(self, x: Tensor, other: Tensor, turn: Rotation, other_turn: Rotation) -> Tensor:
        """Attend from x (B, N, D) to other (B, M, D) -> (B, N, D)."""
        q, k, v = (
            project(tokens).unflatten(-1, (self.heads, -1)).transpose(1, 2)
            for project, tokens in ((self.projq, x), (self.projk, other), (self.projv, other))
        )
        seen: Tensor = self.proj(attended(rotated(q, turn), rotated(k, other_turn), v))
        return seen


class EncoderBlock(nn.Module):
    """Attention, then a two-layer network, each added to the tokens."""

    def __init__(self, size: Stack) -> None:
        super().__init__()
        self.norm1 = nn.LayerNorm(size.width, eps=EPSILON)
        self.attn = SelfAttention(size.width, size.heads)
        self.norm2 = nn.LayerNorm(size.width, eps=EPSILON)
        self.mlp = Mlp(size.width)

    def forward(self, x: Tensor, turn: Rotation) -> Tensor:
        """(B, N, D) -> (B, N, D)."""
        x = x + self.attn(self.norm1(x), turn)
        x = x + self.mlp(self.norm2(x))
        return x


class DecoderBlock(nn.Module):
    """A block with attention to the other view between."""

    def __init__(self, size: Stack) -> None:
        super().__init__()
        self.norm1 = nn.LayerNorm(size.width, eps=EPSILON)
        self.attn = SelfAttention(size.width, size.heads)
        self.norm2 = nn.LayerNorm(size.width, eps=EPSILON)
        self.norm_y = nn.LayerNorm(size.width, eps=EPSILON)
        self.cross_attn = CrossAttention(size.width, size.heads)
        self.norm3 = nn.LayerNorm(size.width, eps=EPSILON)
        self.mlp = Mlp(size.width)

    def forward(self, x: Tensor, other: Tensor, turn: Rotation, other_turn: Rotation) -> Tensor:
        """Attend from x (B, N, D) to other (B, M, D) -> (B, N, D)."""
        x = x + self.attn(self.norm1(x), turn)
        x = x + self.cross_attn(self.norm2(x), self.norm_y(other), turn, other_turn)
        x = x + self.mlp(self.norm3(x))
        return x


class TwoView(nn.Module):
    """The whole network; `state_dict` has the keys of the official files."""

    def __init__(self, architecture: Architecture) -> None:
        super().__init__()
        self.architecture = architecture
        encoder, decoder = architecture.encoder, architecture.decoder
        self.mask_token = nn.Parameter(torch.zeros(1, 1, decoder.width))  # of the training; in every file
        self.patch_embed = PatchEmbed(encoder.width)
        self.enc_blocks = nn.ModuleList(EncoderBlock(encoder) for _ in range(encoder.blocks))
        self.enc_norm = nn.LayerNorm(encoder.width, eps=EPSILON)
        self.decoder_embed = nn.Linear(encoder.width, decoder.width)
        self.dec_blocks = nn.ModuleList(DecoderBlock(decoder) for _ in range(decoder.blocks))
        self.dec_blocks2 = nn.ModuleList(DecoderBlock(decoder) for _ in range(decoder.blocks))
        self.dec_norm = nn.LayerNorm(decoder.width, eps=EPSILON)
        self.downstream_head1, self.downstream_head2 = (_head(architecture) for _ in range(2))

    def encode(self, pictures: Tensor) -> Tensor:
        """Pictures (B, 3, H, W), in -1..1 -> tokens (B, H/16 * W/16, D), row-major. InputError for other sides."""
        encoder = self.architecture.encoder
        turn = rotation(token_grid(pictures), encoder.width // encoder.heads, pictures.device)
        x: Tensor = self.patch_embed(pictures).to(self.mask_token.dtype)  # sums stay exact where autocast is on
        for block in self.enc_blocks:
            x = block(x, turn)
        x = self.enc_norm(x)
        return x

    def decode(self, first: Tensor, first_grid: Grid, second: Tensor, second_grid: Grid) -> tuple[ViewMaps, ViewMaps]:
        """Encoded views (B, N, D) and (B, M, D), and their rows and columns of patches -> what is seen in each.

        The points of both are in the frame of the first view's camera. The heads compute in float32 always.
        """
        decoder = self.architecture.decoder
        grids = first_grid, second_grid
        turns = [rotation(grid, decoder.width // decoder.heads, first.device) for grid in grids]
        one, two = (self.decoder_embed(tokens).to(tokens.dtype) for tokens in (first, second))
        found = [(first, second)]
        for block, block2 in zip(self.dec_blocks, self.dec_blocks2, strict=True):
            one, two = block(one, two, *turns), block2(two, one, *reversed(turns))
            found.append((one, two))
        found[-1] = self.dec_norm(one), self.dec_norm(two)
        with torch.autocast(first.device.type, enabled=False):
            heads = self.downstream_head1, self.downstream_head2
            seen = [
                head(tokens, grid) for head, tokens, grid in zip(heads, zip(*found, strict=True), grids, strict=True)
            ]
        return seen[0], seen[1]


def _head(architecture: Architecture) -> nn.Module:
    encoder, decoder = architecture.encoder, architecture.decoder
    if architecture.linear:
        return LinearHead(decoder.width)
    return DenseHead(encoder.width, decoder.width, decoder.blocks, architecture.descriptors)


def rotation(grid: Grid, width: int, device: torch.device | str = "cpu") -> Rotation:
    """Rotations of the head's channels for every patch of a grid, row-major; width: of an attention head."""
    rows, columns = (torch.arange(n, dtype=torch.float32, device=device) for n in grid)
    places = torch.cartesian_prod(rows, columns)  # (N, 2)
    steps = torch.arange(0, width // 2, 2, dtype=torch.float32, device=device) / (width // 2)
    angle = places[..., None] * (1 / BASE**steps)
    return angle.cos(), angle.sin()


def rotated(x: Tensor, turn: Rotation) -> Tensor:
    """(B, heads, N, width): half of the channels turned by the token's row, the other half by its column.

    Channel i of a half is turned together with the one a quarter of the width further on.
    """
    cosine, sine = turn
    u, v = x.reshape(*x.shape[:-1], 2, 2, -1).unbind(-2)
    return torch.stack((u * cosine - v * sine, v * cosine + u * sine), dim=-2).flatten(-3).to(x.dtype)


def attended(q: Tensor, k: Tensor, v: Tensor) -> Tensor:
    """(B, heads, N, width), (B, heads, M, width) twice -> (B, N, heads * width)."""
    return F.scaled_dot_product_attention(q, k, v).transpose(1, 2).flatten(2)


def token_grid(pictures: Tensor) -> Grid:
    """Rows and columns of patches of (B, 3, H, W). Raises InputError unless H and W are multiples of 16."""
    height, width = pictures.shape[-2:]
    if height % PATCH or width % PATCH or not height or not width:
        raise InputError(f"network input of {height}x{width} pixels (rows x columns): expected multiples of {PATCH}")
    return height // PATCH, width // PATCH


def built_from(tensors: Mapping[str, Tensor], architecture: Architecture | None = None) -> TwoView:
    """The network that the tensors of an official file make, with them as its float32 parameters, ready to be used.

    architecture: what the shapes cannot tell, for a network whose attention heads are not 64 wide; None = read from
    the shapes. Raises WeightsError where tensors are missing, too many, misshaped, contradicting or not finite.
    """
    kept, _ = without_aliases(tensors)
    if not any(key.startswith("dec_blocks2.") for key in kept):  # as before the training on two views began
        kept |= {key.replace("dec_blocks.", "dec_blocks2."): kept[key] for key in kept if key.startswith("dec_blocks.")}
    architecture = architecture or architecture_of(kept)
    with torch.device("meta"):  # nothing is allocated or initialised twice
        network = TwoView(architecture)
    load_strictly(network, kept, architecture.name, optional="^mask_token$")
    return network.eval().requires_grad_(False)


def architecture_of(tensors: Mapping[str, Tensor]) -> Architecture:
    """Sizes by the shapes of an official file's tensors. Raises WeightsError where they tell of no such network."""
    linear = "downstream_head1.proj.weight" in tensors
    if not linear and not any(key.startswith("downstream_head1.dpt.") for key in tensors):
        raise WeightsError(f"the file is {recognised(tensors)} by its names: expected MASt3R or DUSt3R")
    local = "downstream_head1.head_local_features.fc2.bias"
    descriptors = _first_side(tensors, local, 1) // PATCH**2 - 1 if local in tensors else 0
    return Architecture(
        _stack(tensors, "patch_embed.proj.weight", 4, "enc_blocks"),
        _stack(tensors, "decoder_embed.weight", 2, "dec_blocks"),
        linear,
        max(descriptors, 0),
    )


def _stack(tensors: Mapping[str, Tensor], key: str, dimensions: int, name: str) -> Stack:
    width = _first_side(tensors, key, dimensions)
    blocks = len({found.split(".")[1] for found in tensors if found.startswith(f"{name}.")})
    if not width or width % HEAD_WIDTH or not 0 < blocks <= MOST_BLOCKS:
        raise WeightsError(
            f"{name} of width {width}, {blocks} of them: expected a multiple of {HEAD_WIDTH} and at most {MOST_BLOCKS}"
        )
    return Stack(width, blocks, width // HEAD_WIDTH)


def _first_side(tensors: Mapping[str, Tensor], key: str, dimensions: int) -> int:
    tensor = tensors.get(key)
    if tensor is None or tensor.dim() != dimensions:
        told = "is missing" if tensor is None else f"has {tensor.dim()} dimensions"
        raise WeightsError(f"{key} {told}: expected {dimensions}; the file is {recognised(tensors)} by its names")
    return tensor.shape[0]
