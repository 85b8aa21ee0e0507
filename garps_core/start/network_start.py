# SPDX-License-Identifier: Apache-2.0
"""The start from the point maps or the descriptors of a two-view network."""

from __future__ import annotations

import numpy as np

from garps_core.config import Config
from garps_core.config.combinations import check_start
from garps_core.errors import InitialisationError, ModelError, WeightsError
from garps_core.start.descriptors import match_descriptors
from garps_core.start.match_pose import pose_from_matches
from garps_core.start.methods import Ask
from garps_core.start.point_map_pose import pose_from_maps
from garps_core.types import Prior, View


def find(source: View, target: View, config: Config, ask: Ask) -> Prior:
    """Return the pose of a two-view network's answer.

    Raises:
        InitialisationError: the network fails, has too little memory, or its answer fits no pose.
        WeightsError: its weights are missing, or not what they should be.
        ConfigError: no such adapter, or metres from a network that has none.
    """
    check_start(config.start)
    try:
        maps = ask()
    except WeightsError:
        raise
    except ModelError as failure:
        raise InitialisationError(f"{config.start.method}: {failure}") from None
    if config.start.pose_from == "maps":
        return pose_from_maps(maps, source, target, config)
    matches = match_descriptors(maps, source, target, config)
    coarsest = max(1.0, *(1 / side for framing in maps.framings for side in framing.scale))  # its pixel, in the image's
    config = config.replace({"start.ransac_px": min(config.start.ransac_px * coarsest, 50.0)})
    if maps.gives_metres(config.start.scale):
        # PnP takes both views' scales for independent of each other: of one error it sees half the variance.
        errors = {"scale_sigma": np.sqrt(2) * config.start.network_scale_sigma}
        errors["warp_sigma"] = config.start.network_warp_sigma
        wider = {f"lifting.{name}": max(float(e), getattr(config.lifting, name)) for name, e in errors.items()}
        config = config.replace(wider | {"lifting.patch_sigma": 0.0})  # these points were seen with both views
    return pose_from_matches(matches, source, target, config, maps.origin)
