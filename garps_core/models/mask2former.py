# SPDX-License-Identifier: Apache-2.0
"""Mask2Former (Cheng et al., 2021) on ViT-Adapter: the largest published ADE20K segmenter on DINOv2 (ViT-g).

A pixel decoder refines three maps by deformable attention and adds the finest; queries look at the three in turn, each
only where its own last mask is; a pixel's classes are the queries' classes, weighted by their masks there.

Sizes come from the shapes of the weights, but for the heads of plain attention: as many as the deformable one has. The
names within the parts are those of the framework it was trained with and were not checked against the real file;
strict loading tells the first that differs.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor, nn
from torch.nn import functional as F

from garps_core.errors import ModelError, WeightsError
from garps_core.models.deformable import (
    POINTS,
    DeformableAttention,
    Grid,
    as_maps,
    as_tokens,
    centres,
    map_size,
    sine_positions,
)
from garps_core.models.depth_anything import DEVIATION, MEAN, RGBImage, checked_image
from garps_core.models.semantics import Labels, Scores, best_classes, stretching
from garps_core.models.vit import PATCH
from garps_core.models.vit_adapter import COARSEST, AdapterSize, ViTAdapter, adapter_size, counted
from garps_core.weights.state_dict import load_strictly

GROUPS = 32
"""Groups of every group normalisation."""
LEVELS = 3
"""Maps that deformable attention and the queries look at."""
SIDE = math.lcm(PATCH, COARSEST)
"""Sides of the network's input are multiples of this, pixels."""


@dataclass(frozen=True)
class HeadSize:
    """Width of the decoders and of their masks, heads, encoder and decoder layers, inner widths, queries, classes."""

    width: int
    masks: int
    heads: int
    encoder_layers: int
    decoder_layers: int
    encoder_hidden: int
    decoder_hidden: int
    queries: int
    classes: int


def head_size(tensors: Mapping[str, Tensor]) -> HeadSize:
    """The sizes that these tensors have, named as in `Mask2FormerHead`. Raises KeyError for a name that is missing."""
    encoder, decoder = "pixel_decoder.encoder.layers.", "transformer_decoder.layers."
    queries, width = tensors["query_feat.weight"].shape
    return HeadSize(
        width=width,
        masks=len(tensors["pixel_decoder.mask_feature.weight"]),
        heads=len(tensors[f"{encoder}0.attentions.0.attention_weights.weight"]) // (LEVELS * POINTS),
        encoder_layers=counted(tensors, encoder),
        decoder_layers=counted(tensors, decoder),
        encoder_hidden=len(tensors[f"{encoder}0.ffns.0.layers.0.0.weight"]),
        decoder_hidden=len(tensors[f"{decoder}0.ffns.0.layers.0.0.weight"]),
        queries=queries,
        classes=len(tensors["cls_embed.weight"]) - 1,
    )


class FeedForward(nn.Module):
    """Two layers with ReLU between, added to the tokens."""

    def __init__(self, width: int, hidden: int) -> None:
        super().__init__()
        self.layers = nn.Sequential(nn.Sequential(nn.Linear(width, hidden), nn.ReLU()), nn.Linear(hidden, width))

    def forward(self, x: Tensor) -> Tensor:  # noqa: D102
        y: Tensor = x + self.layers(x)
        return y


class NormedConv(nn.Module):
    """Convolution and group normalisation."""

    def __init__(self, channels: int, out: int, kernel: int, bias: bool = False) -> None:
        super().__init__()
        self.conv = nn.Conv2d(channels, out, kernel, padding=kernel // 2, bias=bias)
        self.gn = nn.GroupNorm(GROUPS, out)

    def forward(self, x: Tensor) -> Tensor:  # noqa: D102
        y: Tensor = self.gn(self.conv(x))
        return y


class EncoderLayer(nn.Module):
    """Deformable attention among all maps, then the two layers; each is normalised behind its sum."""

    def __init__(self, size: HeadSize) -> None:
        super().__init__()
        self.attentions = nn.ModuleList([DeformableAttention(size.width, size.heads, LEVELS, size.width)])
        self.ffns = nn.ModuleList([FeedForward(size.width, size.encoder_hidden)])
        self.norms = nn.ModuleList(nn.LayerNorm(size.width) for _ in range(2))

    def forward(self, x: Tensor, positions: Tensor, places: Tensor, grids: list[Grid]) -> Tensor:  # noqa: D102
        x = self.norms[0](x + self.attentions[0](x + positions, places, x, grids))
        x = self.norms[1](self.ffns[0](x))
        return x


class Encoder(nn.Module):
    """The layers one after the other."""

    def __init__(self, size: HeadSize) -> None:
        super().__init__()
        self.layers = nn.ModuleList(EncoderLayer(size) for _ in range(size.encoder_layers))

    def forward(self, x: Tensor, positions: Tensor, places: Tensor, grids: list[Grid]) -> Tensor:  # noqa: D102
        for layer in self.layers:
            x = layer(x, positions, places, grids)
        return x


class PixelDecoder(nn.Module):
    """Maps at 1/4 .. 1/32 -> features of the masks (B, M, ., .) at 1/4, and three refined maps, coarse to fine."""

    def __init__(self, size: HeadSize, channels: int) -> None:
        super().__init__()
        width = size.width
        self.input_convs = nn.ModuleList(NormedConv(channels, width, 1, bias=True) for _ in range(LEVELS))
        self.encoder = Encoder(size)
        self.level_encoding = nn.Embedding(LEVELS, width)
        self.lateral_convs = nn.ModuleList([NormedConv(channels, width, 1)])
        self.output_convs = nn.ModuleList([NormedConv(width, width, 3)])
        self.mask_feature = nn.Conv2d(width, size.masks, 1)

    def forward(self, maps: list[Tensor]) -> tuple[Tensor, list[Tensor]]:  # noqa: D102
        finest, *coarser = maps
        taken = [conv(one) for conv, one in zip(self.input_convs, reversed(coarser), strict=True)]
        grids = [map_size(one) for one in taken]
        x, places = as_tokens(taken), centres(grids, finest)
        positions = torch.cat(
            [sine_positions(grid, x.shape[-1], x) + self.level_encoding.weight[i] for i, grid in enumerate(grids)]
        )
        refined = as_maps(self.encoder(x, positions, places, grids), grids)
        lateral = self.lateral_convs[0](finest)
        summed = lateral + F.interpolate(refined[-1], lateral.shape[-2:], mode="bilinear", align_corners=False)
        return self.mask_feature(F.relu(self.output_convs[0](summed))), refined


class PlainAttention(nn.Module):
    """Attention of queries (B, Q, D) to keys and values (B, N, D), except where `blocked` (B * heads, Q, N)."""

    def __init__(self, width: int, heads: int) -> None:
        super().__init__()
        self.attn = nn.MultiheadAttention(width, heads, batch_first=True)

    def forward(self, query: Tensor, key: Tensor, value: Tensor, blocked: Tensor | None = None) -> Tensor:  # noqa: D102
        found: Tensor = self.attn(query, key, value, attn_mask=blocked, need_weights=False)[0]
        return found


class DecoderLayer(nn.Module):
    """Queries look at a map, at each other, and through the two layers; each is normalised behind its sum."""

    def __init__(self, size: HeadSize) -> None:
        super().__init__()
        self.attentions = nn.ModuleList(PlainAttention(size.width, size.heads) for _ in range(2))
        self.ffns = nn.ModuleList([FeedForward(size.width, size.decoder_hidden)])
        self.norms = nn.ModuleList(nn.LayerNorm(size.width) for _ in range(3))

    def forward(self, x: Tensor, own: Tensor, values: Tensor, positions: Tensor, blocked: Tensor) -> Tensor:
        """Update queries x (B, Q, D) with learnt positions `own` by a map `values` (B, N, D) with its positions."""
        x = self.norms[0](x + self.attentions[0](x + own, values + positions, values, blocked))
        x = self.norms[1](x + self.attentions[1](x + own, x + own, x))
        x = self.norms[2](self.ffns[0](x))
        return x


class Decoder(nn.Module):
    """The layers, and the norm through which queries are read between them."""

    def __init__(self, size: HeadSize) -> None:
        super().__init__()
        self.layers = nn.ModuleList(DecoderLayer(size) for _ in range(size.decoder_layers))
        self.post_norm = nn.LayerNorm(size.width)


class Mask2FormerHead(nn.Module):
    """Maps at 1/4 .. 1/32 -> scores (B, classes, ., .) at 1/4, at least 0; keys behind `decode_head.`."""

    def __init__(self, size: HeadSize, channels: int) -> None:
        super().__init__()
        self.heads = size.heads
        self.pixel_decoder = PixelDecoder(size, channels)
        self.transformer_decoder = Decoder(size)
        self.query_embed = nn.Embedding(size.queries, size.width)
        self.query_feat = nn.Embedding(size.queries, size.width)
        self.level_embed = nn.Embedding(LEVELS, size.width)
        self.cls_embed = nn.Linear(size.width, size.classes + 1)
        steps = [nn.Linear(size.width, size.width), nn.ReLU(), nn.Linear(size.width, size.width), nn.ReLU()]
        self.mask_embed = nn.Sequential(*steps, nn.Linear(size.width, size.masks))

    def forward(self, maps: list[Tensor]) -> Tensor:  # noqa: D102
        features, refined = self.pixel_decoder(maps)
        grids = [map_size(one) for one in refined]
        values = [as_tokens([one]) + self.level_embed.weight[i] for i, one in enumerate(refined)]
        positions = [sine_positions(grid, tokens.shape[-1], tokens) for grid, tokens in zip(grids, values, strict=True)]
        x = self.query_feat.weight.expand(len(features), -1, -1)
        for index, layer in enumerate(self.transformer_decoder.layers):
            level = index % LEVELS
            blocked = self._blocked(self._masks(x, features), grids[level])
            x = layer(x, self.query_embed.weight, values[level], positions[level], blocked)
        shares = self.cls_embed(self.transformer_decoder.post_norm(x)).softmax(dim=-1)[..., :-1]
        return torch.einsum("bqc,bqhw->bchw", shares, self._masks(x, features).sigmoid())

    def _masks(self, x: Tensor, features: Tensor) -> Tensor:
        """Logits (B, Q, ., .) of where each query is, at 1/4."""
        embedded = self.mask_embed(self.transformer_decoder.post_norm(x))
        return torch.einsum("bqc,bchw->bqhw", embedded, features)

    def _blocked(self, masks: Tensor, grid: Grid) -> Tensor:
        """(B * heads, Q, rows * columns), True where a query does not look; one that is nowhere looks everywhere."""
        small = F.interpolate(masks, grid, mode="bilinear", align_corners=False).flatten(2)
        blocked = small.sigmoid() < 0.5
        blocked = blocked & ~blocked.all(dim=-1, keepdim=True)
        return blocked.repeat_interleave(self.heads, dim=0)


class Mask2Former(nn.Module):
    """Picture (B, 3, H, W), normalised, sides multiples of 224 -> scores (B, classes, H / 4, W / 4), float32."""

    def __init__(self, adapter: AdapterSize, head: HeadSize) -> None:
        super().__init__()
        self.backbone = ViTAdapter(adapter)
        self.decode_head = Mask2FormerHead(head, adapter.width)

    def forward(self, picture: Tensor) -> Tensor:  # noqa: D102
        scores: Tensor = self.decode_head(self.backbone(picture))
        return scores.float()


def mask2former_of(tensors: Mapping[str, Tensor]) -> Mask2Former:
    """The network for inference, float32 on the CPU; its sizes are those of the tensors.

    Raises WeightsError for tensors that are missing, too many, misshaped or not finite.
    """
    parts = [
        {key.removeprefix(prefix): value for key, value in tensors.items() if key.startswith(prefix)}
        for prefix in ("backbone.", "decode_head.")
    ]
    try:
        sizes = adapter_size(parts[0]), head_size(parts[1])
    except KeyError as error:
        raise WeightsError(
            f"no {error.args[0]} among {len(tensors)} tensors ({', '.join(list(tensors)[:3])}): expected DINOv2 with "
            "ViT-Adapter and a Mask2Former head, keys backbone.* and decode_head.*"
        ) from None
    with torch.device("meta"):
        network = Mask2Former(*sizes)
    load_strictly(network, tensors, "Mask2Former on ViT-Adapter")
    return network.eval().requires_grad_(False)


def segment_by_masks(network: Mask2Former, image: RGBImage) -> Labels:
    """Class of every pixel, HxW int16, in one pass over the whole HxWx3 uint8 picture; zeros fill it up to 224 n.

    Raises InputError for what is no such image; ModelError for scores that are not finite, or too little memory.
    """
    height, width = checked_image(image).shape[:2]
    device = next(network.parameters()).device
    normalised = (image / 255.0 - np.array(MEAN)) / np.array(DEVIATION)
    padded = np.pad(normalised, ((0, -height % SIDE), (0, -width % SIDE), (0, 0)))
    picture = torch.from_numpy(np.ascontiguousarray(padded.transpose(2, 0, 1)[None], np.float32)).to(device)
    try:
        with torch.inference_mode():
            scores = network(picture)[0]
    except torch.cuda.OutOfMemoryError as error:
        raise ModelError(
            f"out of memory on {device} with {width}x{height} pixels: give a smaller image ({error})"
        ) from None
    if not scores.isfinite().all():
        raise ModelError("the network returned NaN or infinity: expected scores. Are the weights damaged?")
    rows, columns = (
        torch.from_numpy(stretching(cells, whole)[:side]).to(device, torch.float32)
        for cells, whole, side in zip(scores.shape[1:], picture.shape[2:], (height, width), strict=True)
    )
    return best_classes([Scores(scores @ columns.T, rows)])
