# SPDX-License-Identifier: Apache-2.0
"""Attention that looks at a few learnt places instead of everywhere (Zhu et al., Deformable DETR, 2020).

Maps of several sizes are lists of tokens, row-major, one map behind the other; their sizes (rows, columns) go along.
A place is (x, y) in 0..1 of the whole map, so it is the same in every map.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from itertools import pairwise

import torch
from torch import Tensor, nn
from torch.nn import functional as F

POINTS = 4
"""Places that a head looks at in every map; the shapes of the weights tell only their product with the heads."""
TEMPERATURE = 10000.0
"""Ratio of the longest to the shortest wave of the sine positions."""

Grid = tuple[int, int]


class DeformableAttention(nn.Module):
    """Queries (B, N, D) at places -> (B, N, D), sums of what bilinear sampling finds near their places in each map.

    Args:
        width: D.
        heads: each looks at `POINTS` places in each of `levels` maps.
        value_width: width of what is sampled, a multiple of the heads.
    """

    def __init__(self, width: int, heads: int, levels: int, value_width: int) -> None:
        super().__init__()
        self.heads, self.levels = heads, levels
        self.sampling_offsets = nn.Linear(width, heads * levels * POINTS * 2)
        self.attention_weights = nn.Linear(width, heads * levels * POINTS)
        self.value_proj = nn.Linear(width, value_width)
        self.output_proj = nn.Linear(value_width, width)

    def forward(self, query: Tensor, places: Tensor, tokens: Tensor, grids: Sequence[Grid]) -> Tensor:
        """Attend to tokens at places (N, 2); tokens: (B, sum of rows * columns of `grids`, D)."""
        shape = (*query.shape[:2], self.heads, self.levels, POINTS)
        offsets: Tensor = self.sampling_offsets(query).reshape(*shape, 2)
        weights: Tensor = self.attention_weights(query).reshape(*shape[:3], -1).softmax(dim=-1).reshape(shape)
        maps = as_maps(self.value_proj(tokens), grids)
        total = torch.zeros((), device=query.device)
        for level, (values, (rows, columns)) in enumerate(zip(maps, grids, strict=True)):
            step = torch.tensor((columns, rows), device=query.device)  # offsets count cells
            at = places[:, None, None] + offsets[:, :, :, level] / step
            total = total + _looked_up(values, at, weights[:, :, :, level])
        found: Tensor = self.output_proj(total)
        return found


def _looked_up(values: Tensor, places: Tensor, weights: Tensor) -> Tensor:
    """Sample values (B, C, h, w), places (B, N, heads, points, 2), weights (B, N, heads, points) -> (B, N, C)."""
    batch, queries, heads = places.shape[:3]
    per_head = values.reshape(batch * heads, -1, *values.shape[-2:])
    grid = (2 * places - 1).transpose(1, 2).flatten(0, 1)
    sampled = F.grid_sample(per_head, grid.to(values.dtype), mode="bilinear", padding_mode="zeros", align_corners=False)
    summed = (sampled * weights.transpose(1, 2).flatten(0, 1)[:, None]).sum(dim=-1)
    return summed.reshape(batch, -1, queries).transpose(1, 2)


def centres(grids: Sequence[Grid], like: Tensor) -> Tensor:
    """Centres of the cells of maps, (sum of rows * columns, 2) as (x, y) in 0..1, on the device of `like`."""
    found = []
    for rows, columns in grids:
        y = (torch.arange(rows, device=like.device) + 0.5) / rows
        x = (torch.arange(columns, device=like.device) + 0.5) / columns
        found.append(torch.stack(torch.meshgrid(x, y, indexing="xy"), dim=-1).flatten(0, 1))
    return torch.cat(found)


def as_maps(tokens: Tensor, grids: Sequence[Grid]) -> list[Tensor]:
    """Tokens (B, N, C) of maps one behind the other -> the maps (B, C, rows, columns)."""
    ends = [0]
    for rows, columns in grids:
        ends.append(ends[-1] + rows * columns)
    parts = [tokens[:, a:b] for a, b in pairwise(ends)]
    return [part.transpose(1, 2).reshape(len(part), -1, *grid) for part, grid in zip(parts, grids, strict=True)]


def as_tokens(maps: Sequence[Tensor]) -> Tensor:
    """Maps (B, C, rows, columns) -> tokens (B, N, C), one map behind the other."""
    return torch.cat([one.flatten(2).transpose(1, 2) for one in maps], dim=1)


def map_size(one: Tensor) -> Grid:
    """Rows and columns of a map (..., rows, columns)."""
    rows, columns = one.shape[-2:]
    return rows, columns


def sine_positions(grid: Grid, width: int, like: Tensor) -> Tensor:
    """Waves of the row and of the column, (rows * columns, width): the first half of the width tells the row.

    A row counts 1..rows over rows + 1e-6, in full turns; sine and cosine of a frequency stand side by side.
    """
    turns = [torch.arange(1, n + 1, device=like.device) / (n + 1e-6) * 2 * math.pi for n in grid]
    pair = torch.arange(width // 4, device=like.device)
    slowness = TEMPERATURE ** (4 * pair / width)
    row, column = (
        torch.stack(((turn[:, None] / slowness).sin(), (turn[:, None] / slowness).cos()), dim=-1).flatten(1)
        for turn in turns
    )
    waves = torch.cat((row[:, None].expand(*grid, -1), column[None].expand(*grid, -1)), dim=-1)
    return waves.flatten(0, 1)
