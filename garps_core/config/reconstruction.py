# SPDX-License-Identifier: Apache-2.0
"""The settings of the reconstruction: whose depth a mixture is made of, and which weights networks use."""

from __future__ import annotations

from dataclasses import dataclass
from importlib.metadata import EntryPoint

from garps_core.config.field import Checked, setting
from garps_core.plugins import installed_besides

DEPTH_NETWORKS = {
    "depth_anything_v2": "garps_core.models.depth_anything:NETWORK",
    "demo_net": "garps_core.models.demo_net:NETWORK",
}
"""Depth networks of this package by name, each with its `DepthNetwork` as "module:object"."""
DEPTH_PLUGINS = "garps_core.depth"
"""Entry point group of the depth networks that other distributions add (docs/extending.md)."""
SCENES = ("any", "indoor", "outdoor")
"""Kinds of scene that weights of a depth network are made for."""
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
    return installed_besides(DEPTH_PLUGINS, frozenset((*_BEFORE, *DEPTH_NETWORKS, *_AFTER)))


@dataclass(frozen=True)
class Reconstruction(Checked):
    """Settings by which `reconstruct` turns a view into a mixture, and the weights it uses (docs/weights.md)."""

    method: str = setting(
        "auto",
        "source of the depth: rgbd = the sensor; two_view = the network of `start.method`, asked once for both views; "
        "ply = mixtures from files; demo_net = the demonstration network in the package; auto = the sensor, or "
        "depth_anything_v2 for views without depth; else the network of that name",
        choices=methods,
        live=False,
    )
    depth_weights: str = setting(
        "", "weights of the depth network: name or file; empty = the first installed", live=False
    )
    flash3d_weights: str = setting(
        "", "weights of Flash3D: name or file; empty = the first installed", live=False, expert=True
    )
    scene: str = setting(
        "any",
        "kind of scene that the depth network's weights must be made for; a file that names none counts as this",
        choices=SCENES,
        live=False,
    )
    depth_scale: float = setting(1.0, "factor on the depth of the depth network", low=1e-3, high=1e3)
    focal_correction: bool = setting(
        False,
        "multiply the network's depth by the focal length over that of its training, both relative to the image width",
        expert=True,
    )
    drop_border: bool = setting(
        False, "leave out the Gaussians that Flash3D puts around the image, outside its border", expert=True
    )
    semantics: str = setting(
        "none",
        "source of semantic labels: linear, ms = heads on DINOv2; m2f = Mask2Former; none = no labels, so that "
        "`alignment.semantic_discount` has no effect",
        choices=("none", "linear", "ms", "m2f"),
        live=False,
        expert=True,
    )
    semantic_weights: str = setting(
        "",
        "weights of the semantic head, or of all of Mask2Former: name or file; empty = the first installed",
        live=False,
        expert=True,
    )
    semantic_backbone: str = setting(
        "",
        "weights of DINOv2 below the heads linear and ms: name or file; empty = the first installed",
        live=False,
        expert=True,
    )
    network_dtype: str = setting(
        "float32",
        "arithmetic of the networks; float16 and bfloat16 are for GPUs",
        choices=("float32", "float16", "bfloat16"),
        expert=True,
    )
