# SPDX-License-Identifier: Apache-2.0
"""Settings with default, range, unit and meaning. `config.py` holds `Config` and the presets."""

from garps_core.config.alignment import Alignment
from garps_core.config.config import PRESETS, Config
from garps_core.config.ladders import Rung
from garps_core.config.lifting import Lifting
from garps_core.config.paper import Paper
from garps_core.config.reconstruction import SCENES, Reconstruction, depth_networks, methods
from garps_core.config.start import TWO_VIEW, Start, start_methods

__all__ = [
    "PRESETS",
    "SCENES",
    "TWO_VIEW",
    "Alignment",
    "Config",
    "Lifting",
    "Paper",
    "Reconstruction",
    "Rung",
    "Start",
    "depth_networks",
    "methods",
    "start_methods",
]
