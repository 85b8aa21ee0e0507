# SPDX-License-Identifier: Apache-2.0
"""Devices of torch: a device by its name, checked before anything is moved to it."""

from __future__ import annotations

from typing import TypeVar

import torch
from torch import nn

from garps_core.errors import ConfigError, ModelError

Network = TypeVar("Network", bound=nn.Module)


def checked_device(name: str) -> torch.device:
    """Return the device `name`. Raises ConfigError when there is no such device."""
    try:
        device = torch.device(name)
        if device.type in ("cpu", "cuda"):
            torch.empty(1, device=device)
            return device
    except (RuntimeError, AssertionError):  # an unknown name; torch without CUDA asserts
        pass
    there = ["cpu"] + [f"cuda:{i}" for i in range(torch.cuda.device_count())]
    raise ConfigError(
        f"device is {name!r}, which is not there: expected one of {', '.join(there)}. Set device to 'cpu'"
    )


def on_device(network: Network, device: str) -> Network:
    """The network, moved there. Raises ConfigError for a device that is not there, ModelError where it does not fit."""
    try:
        return network.to(checked_device(device))
    except torch.cuda.OutOfMemoryError as error:
        raise ModelError(
            f"out of memory on {device} for the weights of {type(network).__name__}: expected them to fit. Free some, "
            f"choose a smaller network, or use the CPU ({error})"
        ) from None
