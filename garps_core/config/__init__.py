# SPDX-License-Identifier: Apache-2.0
"""Settings: every one has a default, a range, a unit and a meaning. `config.py` holds `Config` and the presets."""

from garps_core.config.alignment import Alignment, Rung
from garps_core.config.config import PRESETS, Config, preset_for
from garps_core.config.lifting import Lifting
from garps_core.config.paper import Paper
from garps_core.config.reconstruction import DEPTH_NETWORKS, METHODS, SCENES, Reconstruction
from garps_core.config.start import STARTS, TWO_VIEW, Start

__all__ = [
    "DEPTH_NETWORKS",
    "METHODS",
    "PRESETS",
    "SCENES",
    "STARTS",
    "TWO_VIEW",
    "Alignment",
    "Config",
    "Lifting",
    "Paper",
    "Reconstruction",
    "Rung",
    "Start",
    "preset_for",
]
