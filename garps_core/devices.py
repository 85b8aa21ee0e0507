# SPDX-License-Identifier: Apache-2.0
"""Where torch computes: a device by its name, checked before anything is moved to it."""

from __future__ import annotations

import torch

from garps_core.errors import ConfigError


def checked_device(name: str) -> torch.device:
    """The device `name`. Raises ConfigError when it is none, or not there."""
    try:
        device = torch.device(name)
        if device.type in ("cpu", "cuda"):
            torch.empty(1, device=device)
            return device
    except (RuntimeError, AssertionError):  # an unknown name; torch without CUDA asserts
        pass
    there = ["cpu"] + [f"cuda:{i}" for i in range(torch.cuda.device_count())]
    raise ConfigError(
        f"device is {name!r}, which is not there: expected one of {', '.join(there)}; set device to 'cpu'"
    )
