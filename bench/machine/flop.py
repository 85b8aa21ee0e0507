# SPDX-License-Identifier: Apache-2.0
"""Floating-point operations of a call."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import torch
from torch.utils.flop_counter import FlopCounterMode, sdpa_flop_count

Call = Callable[[], Any]


def counted_flop(call: Call) -> int:
    """Floating-point operations of matrix products, convolutions and attention in a call; a multiply-add is two."""
    attention = {torch.ops.aten._scaled_dot_product_flash_attention_for_cpu: _attention_flop}
    with FlopCounterMode(display=False, custom_mapping=attention) as counter:
        call()
    return int(counter.get_total_flops())


def _attention_flop(query: Any, key: Any, value: Any, *_: Any, **__: Any) -> int:
    return int(sdpa_flop_count(query, key, value))
