# SPDX-License-Identifier: Apache-2.0
"""DINOv2 vision transformer (Oquab et al. 2023), patches of 14 pixels, no registers; parameters named as in its files.

An image becomes a class token and one token per patch, row-major. Each block adds scaled attention and a scaled
two-layer network; others read the outputs of some blocks through the final norm, as maps (B, D, rows, columns).
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from garps_core.errors import InputError, WeightsError

PATCH = 14
"""Side of a patch, pixels."""
GRID = 37
"""Patches on each side of the square images whose positions were learned (518 pixels)."""
GRID_OFFSET = 0.1
"""Added to the wanted grid where positions are interpolated; it moves the samples, and the weights were trained so."""
EPSILON = 1e-6
"""Epsilon of every layer norm."""


@dataclass(frozen=True)
class VitSize:
    """Token width D, number of blocks and of attention heads, and whether the two-layer network is gated (SwiGLU)."""

    width: int
    blocks: int
    heads: int
    gated: bool = False


SIZES: Mapping[str, VitSize] = {
    "vits": VitSize(384, 12, 6),
    "vitb": VitSize(768, 12, 12),
    "vitl": VitSize(1024, 24, 16),
    "vitg": VitSize(1536, 40, 24, gated=True),
}


class PatchEmbed(nn.Module):
    """One token per patch of an image, row-major."""

    def __init__(self, width: int) -> None:
        super().__init__()
        self.proj = nn.Conv2d(3, width, kernel_size=PATCH, stride=PATCH)

    def forward(self, image: Tensor) -> Tensor:
        """(B, 3, H, W), sides multiples of 14 -> (B, H/14 * W/14, D)."""
        patches: Tensor = self.proj(image)
        return patches.flatten(2).transpose(1, 2)


class Attention(nn.Module):
    """Every token looks at all tokens of its image, with several heads."""

    def __init__(self, width: int, heads: int) -> None:
        super().__init__()
        self.heads = heads
        self.qkv = nn.Linear(width, 3 * width)
        self.proj = nn.Linear(width, width)

    def forward(self, x: Tensor) -> Tensor:
        """(B, N, D) -> (B, N, D)."""
        q, k, v = self.qkv(x).unflatten(-1, (3, self.heads, -1)).permute(2, 0, 3, 1, 4)
        seen: Tensor = self.proj(F.scaled_dot_product_attention(q, k, v).transpose(1, 2).flatten(2))
        return seen


class Mlp(nn.Module):
    """Two layers with exact GELU between, four times as wide inside."""

    def __init__(self, width: int) -> None:
        super().__init__()
        self.fc1 = nn.Linear(width, 4 * width)
        self.fc2 = nn.Linear(4 * width, width)

    def forward(self, x: Tensor) -> Tensor:
        """(B, N, D) -> (B, N, D)."""
        y: Tensor = self.fc2(F.gelu(self.fc1(x)))
        return y


class SwiGlu(nn.Module):
    """Two layers, the first in two halves that are multiplied, one through SiLU."""

    def __init__(self, width: int) -> None:
        super().__init__()
        hidden = (4 * width * 2 // 3 + 7) // 8 * 8
        self.w12 = nn.Linear(width, 2 * hidden)
        self.w3 = nn.Linear(hidden, width)

    def forward(self, x: Tensor) -> Tensor:
        """(B, N, D) -> (B, N, D)."""
        gate, value = self.w12(x).chunk(2, dim=-1)
        y: Tensor = self.w3(F.silu(gate) * value)
        return y


class LayerScale(nn.Module):
    """Learned factor per channel of the branch that is added to the tokens (layer scale)."""

    def __init__(self, width: int) -> None:
        super().__init__()
        self.gamma = nn.Parameter(torch.ones(width))

    def forward(self, x: Tensor, branch: Tensor) -> Tensor:
        """Add gamma * branch to x, both (B, N, D)."""
        return torch.addcmul(x, branch.to(x.dtype), self.gamma)


class Block(nn.Module):
    """Attention, then a two-layer network, each added to the tokens."""

    def __init__(self, size: VitSize) -> None:
        super().__init__()
        self.norm1 = nn.LayerNorm(size.width, eps=EPSILON)
        self.attn = Attention(size.width, size.heads)
        self.ls1 = LayerScale(size.width)
        self.norm2 = nn.LayerNorm(size.width, eps=EPSILON)
        self.mlp = SwiGlu(size.width) if size.gated else Mlp(size.width)
        self.ls2 = LayerScale(size.width)

    def forward(self, x: Tensor) -> Tensor:
        """(B, N, D) -> (B, N, D)."""
        x = self.ls1(x, self.attn(self.norm1(x)))
        x = self.ls2(x, self.mlp(self.norm2(x)))
        return x


class VisionTransformer(nn.Module):
    """The whole transformer; `state_dict` has the keys of the official backbone files."""

    def __init__(self, size: VitSize) -> None:
        super().__init__()
        self.size = size
        self.cls_token = nn.Parameter(torch.zeros(1, 1, size.width))
        self.pos_embed = nn.Parameter(torch.zeros(1, 1 + GRID * GRID, size.width))
        self.mask_token = nn.Parameter(torch.zeros(1, size.width))  # of the training; in every file
        self.patch_embed = PatchEmbed(size.width)
        self.blocks = nn.ModuleList(Block(size) for _ in range(size.blocks))
        self.norm = nn.LayerNorm(size.width, eps=EPSILON)

    def forward(self, image: Tensor, taps: Sequence[int]) -> list[Tensor]:
        """Outputs of the blocks `taps` (0-based) through the final norm, without the class token.

        image: (B, 3, H, W), normalised, H and W multiples of 14. Returns one (B, D, H/14, W/14) per tap, in the order
        of `taps`, a view of the tokens (channels last in memory). Blocks behind the last tap are not computed.
        Raises InputError for other sides.
        """
        grid = patch_grid(image)
        x, found = self.tokens(image), {}
        for index, block in enumerate(self.blocks[: max(taps) + 1]):
            x = block(x)
            if index in taps:
                found[index] = self.norm(x)[:, 1:].unflatten(1, grid).permute(0, 3, 1, 2)
        return [found[index] for index in taps]

    def tokens(self, image: Tensor) -> Tensor:
        """Input of the first block: class token and patches with their positions, (B, 1 + rows * columns, D)."""
        patches = self.patch_embed(image).to(self.cls_token.dtype)
        everything = torch.cat((self.cls_token.expand(len(patches), -1, -1), patches), dim=1)
        return everything + self.positions(patch_grid(image))

    def positions(self, grid: tuple[int, int]) -> Tensor:
        """Position embedding of a grid (rows, columns) of patches, class first: (1, 1 + rows * columns, D)."""
        if grid == (GRID, GRID):
            return self.pos_embed
        learned = self.pos_embed[:, 1:].reshape(1, GRID, GRID, -1).permute(0, 3, 1, 2)
        scale = tuple((n + GRID_OFFSET) / GRID for n in grid)
        resized = F.interpolate(learned.float(), scale_factor=scale, mode="bicubic", align_corners=False)
        return torch.cat((self.pos_embed[:, :1], resized.flatten(2).transpose(1, 2).to(self.pos_embed.dtype)), dim=1)


def patch_grid(image: Tensor) -> tuple[int, int]:
    """Rows and columns of patches of (B, 3, H, W). Raises InputError unless H and W are multiples of 14."""
    height, width = image.shape[-2:]
    if height % PATCH or width % PATCH or not height or not width:
        raise InputError(
            f"network input of {height}x{width} pixels (rows x columns): expected multiples of {PATCH}, resize or pad"
        )
    return height // PATCH, width // PATCH


def size_of(tensors: Mapping[str, Tensor], prefix: str = "") -> str:
    """Name in SIZES of the transformer whose parameters are `prefix` + its official keys, from the shapes alone.

    Raises WeightsError where there is none, or none of the known sizes.
    """
    token = tensors.get(f"{prefix}cls_token")
    if token is None:
        raise WeightsError(
            f"no {prefix}cls_token among {len(tensors)} tensors ({_some(tensors)}): expected the weights of a DINOv2 "
            "transformer. Is this the file of another network, or of a head alone?"
        )
    width = token.shape[-1]
    start = f"{prefix}blocks."
    blocks = len({key[len(start) :].split(".")[0] for key in tensors if key.startswith(start)})
    for name, size in SIZES.items():
        if (size.width, size.blocks) == (width, blocks):
            return name
    known = ", ".join(f"{name} {size.width} x {size.blocks}" for name, size in SIZES.items())
    raise WeightsError(f"a transformer of width {width} with {blocks} blocks: expected one of {known}")


_OTHER_NAMES = (
    (r"^embeddings\.position_embeddings$", "pos_embed"),
    (r"^embeddings\.(cls_token|mask_token)$", r"\1"),
    (r"^embeddings\.patch_embeddings\.projection\.", "patch_embed.proj."),
    (r"^layernorm\.", "norm."),
    (r"^encoder\.layer\.(\d+)\.(norm1|norm2|mlp\.fc1|mlp\.fc2)\.", r"blocks.\1.\2."),
    (r"^encoder\.layer\.(\d+)\.mlp\.weights_in\.", r"blocks.\1.mlp.w12."),
    (r"^encoder\.layer\.(\d+)\.mlp\.weights_out\.", r"blocks.\1.mlp.w3."),
    (r"^encoder\.layer\.(\d+)\.layer_scale([12])\.lambda1$", r"blocks.\1.ls\2.gamma"),
    (r"^encoder\.layer\.(\d+)\.attention\.(?:output\.dense|o_proj)\.", r"blocks.\1.attn.proj."),
    (r"^encoder\.layer\.(\d+)\.attention\.(?:attention\.query|q_proj)\.", r"blocks.\1.attn.q."),
    (r"^encoder\.layer\.(\d+)\.attention\.(?:attention\.key|k_proj)\.", r"blocks.\1.attn.k."),
    (r"^encoder\.layer\.(\d+)\.attention\.(?:attention\.value|v_proj)\.", r"blocks.\1.attn.v."),
)


def from_transformers(tensors: Mapping[str, Tensor]) -> dict[str, Tensor]:
    """Tensors of a DINOv2 backbone as the `transformers` library names them -> the same under the official names.

    Queries, keys and values, apart there, are stacked. Raises WeightsError for an unexpected name, or an
    incomplete stack.
    """
    named = renamed(tensors, _OTHER_NAMES)
    apart = re.compile(r"\.attn\.[qkv]\.")
    for stack in dict.fromkeys(apart.sub(".attn.qkv.", name) for name in named if apart.search(name)):
        parts = [stack.replace(".qkv.", f".{part}.") for part in "qkv"]
        missing = [part for part in parts if part not in named]
        if missing:
            raise WeightsError(f"no {', '.join(missing)} to make {stack} of: the file is damaged or incomplete")
        named[stack] = torch.cat([named.pop(part) for part in parts])
    return named


def renamed(tensors: Mapping[str, Tensor], names: Iterable[tuple[str, str]]) -> dict[str, Tensor]:
    """Tensors by the first of (pattern, replacement) that fits their name. Raises WeightsError where none does."""
    found = {}
    for key, value in tensors.items():
        fitting = [re.sub(pattern, other, key) for pattern, other in names if re.search(pattern, key)]
        if not fitting:
            raise WeightsError(f"{key} is no name that `transformers` gives to a part of this network: is it another?")
        found[fitting[0]] = value
    return found


def _some(keys: Iterable[str]) -> str:
    """The first names, for a message."""
    names = list(keys)
    return ", ".join(names[:3]) + (", ..." if len(names) > 3 else "") if names else "none"
