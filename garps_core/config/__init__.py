# SPDX-License-Identifier: Apache-2.0
"""Settings with default, range, unit and meaning. `config.py` holds `Config` and the presets."""

from garps_core.config.alignment import Alignment
from garps_core.config.config import PRESETS, Config, preset_for
from garps_core.config.ladders import Rung
from garps_core.config.lifting import Lifting
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
    "Reconstruction",
    "Rung",
    "Start",
    "preset_for",
]
