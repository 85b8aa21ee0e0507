# SPDX-License-Identifier: Apache-2.0
"""A Mask2Former of reduced width with random parameters."""

from __future__ import annotations

import math

import torch

from garps_core.models.mask2former import HeadSize
from garps_core.models.vit_adapter import AdapterSize

ADAPTER = AdapterSize(width=64, blocks=4, hidden=48, groups=4, heads=4, values=32, convolved=16)
HEAD = HeadSize(
    width=32,
    masks=24,
    heads=4,
    encoder_layers=2,
    decoder_layers=4,
    encoder_hidden=40,
    decoder_hidden=56,
    queries=9,
    classes=7,
)


def random_state(network: torch.nn.Module, seed: int = 0) -> dict[str, torch.Tensor]:
    generator = torch.Generator().manual_seed(seed)
    found = {}
    for key, like in network.state_dict().items():
        value = torch.randn(like.shape, generator=generator)
        if key.endswith("num_batches_tracked"):
            value = torch.zeros((), dtype=torch.int64)
        elif key.endswith("running_var"):
            value = 1 + 0.3 * value.tanh()
        elif like.dim() == 1 and key.endswith("weight"):
            value = 1 + 0.1 * value
        else:
            value = value * (0.2 if like.dim() == 1 else 1 / math.sqrt(like[0].numel()))
        found[key] = value
    return found
