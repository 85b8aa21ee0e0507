# SPDX-License-Identifier: Apache-2.0
"""The settings of the reconstruction, the part of `Config` that says whose depth a mixture is made of."""

from __future__ import annotations

import sys
from dataclasses import dataclass
from functools import lru_cache
from importlib.metadata import EntryPoint

from garps_core import plugins
from garps_core.config.field import Checked, setting

DEPTH_NETWORKS = {
    "depth_anything_v2": "garps_core.models.depth_anything:NETWORK",
    "demo_net": "garps_core.models.demo_net:NETWORK",
}
"""Depth networks of this package by name, each with its `DepthNetwork` as "module:object"."""
DEPTH_PLUGINS = "garps_core.depth"
"""Entry point group of the depth networks that other distributions add (docs/extending.md)."""
SCENES = ("any", "indoor", "outdoor")
_BEFORE, _AFTER = ("auto", "rgbd"), ("flash3d", "two_view", "ply")


def methods() -> tuple[str, ...]:
    """Return what `reconstruction.method` may be."""
    return *_BEFORE, *depth_networks(), *_AFTER


def depth_networks() -> tuple[str, ...]:
    """Return the names of the networks that give depth of one image: those of this package, then the installed ones."""
    return *DEPTH_NETWORKS, *installed_depth_networks()


def installed_depth_networks() -> dict[str, EntryPoint]:
    """Return the entry points of the depth networks that other distributions add, by name. Nothing is imported.

    None can take a name that means something else already.
    """
    return _installed(tuple(sys.path))


@lru_cache(maxsize=4)
def _installed(path: tuple[str, ...]) -> dict[str, EntryPoint]:
    """`installed_depth_networks` for this `sys.path`; settings are made too often to look there every time."""
    taken = {*_BEFORE, *DEPTH_NETWORKS, *_AFTER}
    return {name: point for name, point in plugins.installed(DEPTH_PLUGINS).items() if name not in taken}


@dataclass(frozen=True)
class Reconstruction(Checked):
    """What turns a view into a mixture (`reconstruct`), and which weights it uses (`docs/weights.md`)."""

    method: str = setting(
        "auto",
        "rgbd = the sensor's depth; a network; demo_net = the one in the package, a demonstration; two_view = that of "
        "start.method, which then runs once for both; ply = mixtures from files; auto = depth_anything_v2 without a "
        "sensor",
        choices=methods,
        live=False,
    )
    depth_weights: str = setting(
        "", "of the depth network: a name or a file; empty = the first that is installed", live=False
    )
    flash3d_weights: str = setting("", "of Flash3D, likewise", live=False)
    scene: str = setting(
        "any", "what depth_weights must be made for; told here where the file does not", choices=SCENES, live=False
    )
    depth_scale: float = setting(1.0, "factor on the network's depth", unit="", low=1e-3, high=1e3)
    focal_correction: bool = setting(
        False, "network's depth times the focal length over that of its training, both over the image's width"
    )
    drop_border: bool = setting(False, "leave out the Gaussians that Flash3D sets around the picture")
    semantics: str = setting(
        "none",
        "labels by DINOv2 (linear, ms) or Mask2Former; none = `alignment.semantic_discount` has no effect",
        choices=("none", "linear", "ms", "m2f"),
        live=False,
    )
    semantic_weights: str = setting(
        "", "of the head, or of all of m2f: a name or a file; empty = the first installed", live=False
    )
    semantic_backbone: str = setting("", "weights of DINOv2 for linear and ms, likewise", live=False)
    network_dtype: str = setting(
        "float32", "what networks compute in; the other two for GPUs", choices=("float32", "float16", "bfloat16")
    )
