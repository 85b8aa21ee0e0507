# SPDX-License-Identifier: Apache-2.0
"""Dense prediction head (Ranftl et al. 2021) as Depth Anything V2 has it; parameters named as in its files.

Four maps of one transformer become a pyramid (4, 2, 1 and 1/2 times the patch grid), which is fused from coarse to
fine. `FusionBlock` and `Fusion` are what other heads of this family share.
"""

from __future__ import annotations

from collections.abc import Sequence

from torch import Tensor, nn
from torch.nn import functional as F

from garps_core.models.vit import PATCH

Grid = tuple[int, int]
"""Rows and columns."""


class ResidualConvUnit(nn.Module):
    """Two convolutions, each after a ReLU, added to what came in."""

    def __init__(self, features: int) -> None:
        super().__init__()
        self.conv1 = nn.Conv2d(features, features, kernel_size=3, padding=1)
        self.conv2 = nn.Conv2d(features, features, kernel_size=3, padding=1)

    def forward(self, x: Tensor) -> Tensor:
        """(B, C, h, w) -> (B, C, h, w)."""
        y: Tensor = self.conv2(F.relu(self.conv1(F.relu(x)), inplace=True))
        return y + x


class FusionBlock(nn.Module):
    """Joins a coarse map with a finer one and enlarges the result."""

    def __init__(self, features: int) -> None:
        super().__init__()
        self.resConfUnit1 = ResidualConvUnit(features)
        self.resConfUnit2 = ResidualConvUnit(features)
        self.out_conv = nn.Conv2d(features, features, kernel_size=1)

    def forward(self, x: Tensor, skip: Tensor | None = None, grid: Grid | None = None) -> Tensor:
        """Fuse x and skip (B, C, h, w) -> (B, C, *grid); without a grid, twice the size.

        The 1x1 convolution stands before the enlargement, where it costs a quarter: both are linear and the weights of
        the enlargement sum to one, so it is the same up to rounding.
        """
        if skip is not None:
            x = x + self.resConfUnit1(skip)
        x = self.out_conv(self.resConfUnit2(x))
        return enlarged(x, grid or (2 * x.shape[-2], 2 * x.shape[-1]))


class Fusion(nn.Module):
    """The pyramid's levels, each brought to the same number of channels, and the blocks that fuse them."""

    def __init__(self, channels: Sequence[int], features: int) -> None:
        super().__init__()
        for level, width in enumerate(channels, 1):
            self.add_module(f"layer{level}_rn", nn.Conv2d(width, features, kernel_size=3, padding=1, bias=False))
            self.add_module(f"refinenet{level}", FusionBlock(features))

    def fuse(self, pyramid: Sequence[Tensor]) -> Tensor:
        """Levels, fine to coarse, (B, channels[i], h_i, w_i) -> (B, features, 2 h_0, 2 w_0)."""
        named = dict(self.named_children())
        levels: list[Tensor] = [named[f"layer{i}_rn"](level) for i, level in enumerate(pyramid, 1)]
        path: Tensor = named[f"refinenet{len(levels)}"](levels[-1], None, levels[-2].shape[-2:])
        for i in range(len(levels) - 1, 0, -1):
            finer = levels[i - 2].shape[-2:] if i > 1 else None
            path = named[f"refinenet{i}"](path, levels[i - 1], finer)
        return path


class DepthScratch(Fusion):
    """Fusion and the last convolutions, which give one number per pixel."""

    def __init__(self, channels: Sequence[int], features: int) -> None:
        super().__init__(channels, features)
        self.output_conv1 = nn.Conv2d(features, features // 2, kernel_size=3, padding=1)
        self.output_conv2 = nn.Sequential(
            nn.Conv2d(features // 2, 32, kernel_size=3, padding=1),
            nn.ReLU(inplace=True),
            nn.Conv2d(32, 1, kernel_size=1),
        )


class DptHead(nn.Module):
    """Maps of four blocks -> one number per pixel of the network's input, before any activation."""

    def __init__(self, width: int, channels: Sequence[int], features: int) -> None:
        super().__init__()
        self.projects = nn.ModuleList(nn.Conv2d(width, c, kernel_size=1) for c in channels)
        first, second, _, last = channels
        self.resize_layers = nn.ModuleList(
            (
                nn.ConvTranspose2d(first, first, kernel_size=4, stride=4),
                nn.ConvTranspose2d(second, second, kernel_size=2, stride=2),
                nn.Identity(),
                nn.Conv2d(last, last, kernel_size=3, stride=2, padding=1),
            )
        )
        self.scratch = DepthScratch(channels, features)

    def forward(self, maps: Sequence[Tensor]) -> Tensor:
        """Four maps (B, D, rows, columns), shallow to deep -> (B, 1, 14 rows, 14 columns)."""
        parts = zip(maps, self.projects, self.resize_layers, strict=True)
        path = self.scratch.fuse([resize(project(found)) for found, project, resize in parts])
        rows, columns = maps[0].shape[-2:]
        pixels: Tensor = enlarged(self.scratch.output_conv1(path), (PATCH * rows, PATCH * columns))
        logit: Tensor = self.scratch.output_conv2(pixels)
        return logit


def enlarged(x: Tensor, grid: Grid) -> Tensor:
    """Bilinear to `grid`, corner pixels on corner pixels."""
    return F.interpolate(x, tuple(grid), mode="bilinear", align_corners=True)
