# SPDX-License-Identifier: Apache-2.0
"""The start without any measurement: no motion."""

from __future__ import annotations

import numpy as np

from garps_core.config import Config
from garps_core.start.methods import Ask
from garps_core.types import Prior, View


def find(source: View, target: View, config: Config, ask: Ask) -> Prior:
    """Return `identity`; nothing is read but the settings."""
    return identity(config, "asked for by start.method")


def identity(config: Config, reason: str) -> Prior:
    """Return no motion with the sigmas of `start.identity_sigma_*`, a guess without any measurement."""
    sigmas = [config.start.identity_sigma_m] * 3 + [config.start.identity_sigma_rad] * 3
    return Prior(np.eye(4), np.diag(np.square(sigmas)), "identity", reason)
