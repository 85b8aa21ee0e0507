# SPDX-License-Identifier: Apache-2.0
"""A distribution with depth networks, installed for a test only: one with the depth of a file, and those that fail."""

from pathlib import Path

import numpy as np
from distributions import write_distribution

from garps_core.config.reconstruction import DEPTH_PLUGINS

NAME = "recorded_depth"
"""The network whose weights are a file by `write_depths`."""
MODULE = """
import numpy as np

from garps_core.errors import WeightsError
from garps_core.models.depth_networks import DepthNetwork


def load(weights, scene, device):
    if not weights:
        raise WeightsError("reconstruction.depth_weights is empty: expected an .npz file")
    with np.load(weights) as held:
        return held["rgb"].astype(float).mean((1, 2)), held["depth"]


def depths(network, views, settings):
    colours, depth = network
    return [depth[np.abs(colours - view.rgb.mean((0, 1))).sum(1).argmin()] for view in views]


def failing(answer):
    return DepthNetwork("it fails", lambda *given: None, lambda network, views, settings: answer(views))


recorded = DepthNetwork("the depth of a file", load, depths)
no_entry = 7
unloadable = DepthNetwork("it fails", lambda *given: 1 / 0, depths)
raising = failing(lambda views: [{}[0] for view in views])
too_few = failing(lambda views: [])
misshapen = failing(lambda views: [np.ones((2, 3), np.float32) for view in views])
doubles = failing(lambda views: [np.ones(view.rgb.shape[:2]) for view in views])
lists = failing(lambda views: [view.rgb[..., 0].tolist() for view in views])
unknown = failing(lambda views: [np.full(view.rgb.shape[:2], np.nan, np.float32) for view in views])
"""
FAILING = {
    "raising": "failed: KeyError: 0",
    "too_few": "returned 0 maps: expected 2",
    "misshapen": "returned float32 (2, 3): expected an array float32 (240, 320), metres",
    "doubles": "returned float64 (240, 320): expected an array float32 (240, 320), metres",
    "lists": "returned list: expected an array float32 (240, 320), metres",
    "unknown": "is not finite: expected metres, 0 = unknown",
}
"""Networks that fail when they are asked -> the reason in the estimate, for two images of 320x240."""


def install_depth_networks(folder: Path) -> Path:
    """Write the distribution `made_depth` 1.0; the folder belongs on the path."""
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "made_depth.py").write_text(MODULE, encoding="utf-8")
    names = {NAME: "recorded", **{name: name for name in FAILING}, "no_entry": "no_entry", "unloadable": "unloadable"}
    entries = {name: f"made_depth:{thing}" for name, thing in names.items()}
    absent = {"not_there": "no_such_package:NETWORK", "demo_net": "made_depth:raising"}
    return write_distribution(folder, "made_depth", DEPTH_PLUGINS, entries | absent)


def write_depths(path: Path, *pairs: tuple[np.ndarray, np.ndarray]) -> Path:
    """Write images HxWx3 uint8 and their depth HxW, m, all of one size; depth that is not known becomes 0."""
    rgb, depth = (np.stack(arrays) for arrays in zip(*pairs, strict=True))
    np.savez(path, rgb=rgb, depth=np.nan_to_num(depth).astype(np.float32))
    return path
