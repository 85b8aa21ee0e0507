# SPDX-License-Identifier: Apache-2.0
"""The settings of the start: the pose that an alignment begins from."""

from __future__ import annotations

from dataclasses import dataclass
from importlib.metadata import EntryPoint

from garps_core.config.field import Checked, setting
from garps_core.plugins import installed_besides

TWO_VIEW = ("mast3r", "dust3r", "adapter")
"""Starts by a two-view network."""
STARTS = {
    "features": "garps_core.start.feature_start:find",
    "identity": "garps_core.start.identity_start:find",
    **dict.fromkeys(TWO_VIEW, "garps_core.start.network_start:find"),
}
"""Ways to start of this package by name, each with its function as "module:function" (`garps_core.start.methods`)."""
START_PLUGINS = "garps_core.start"
"""Entry point group of the ways to start that other distributions add (docs/extending.md)."""


def start_methods() -> tuple[str, ...]:
    """Return the values of `start.method`: auto, the ways to start of this package, then the installed ones."""
    return "auto", *STARTS, *installed_starts()


def installed_starts() -> dict[str, EntryPoint]:
    """Return the entry points of the ways to start that other distributions add, by name. Nothing is imported.

    None can take a name that means something else already; "given" is the origin of a prior.
    """
    return installed_besides(START_PLUGINS, frozenset(("auto", "given", *STARTS)))


@dataclass(frozen=True)
class Start(Checked):
    """Settings by which `initialise` finds the start pose."""

    method: str = setting(
        "auto",
        "source of the start pose: auto = the given prior and features together, or the one there is, else identity if "
        "`start.identity_fallback`; features; identity; mast3r, dust3r, adapter = a two-view network, and the prior; "
        "else the installed way to start of that name, and the prior",
        choices=start_methods,
        live=False,
    )
    weights: str = setting(
        "",
        "weights of the two-view network of `start.method`: name or file; empty = the first installed",
        live=False,
    )
    adapter: str = setting(
        "", "name of an installed two-view adapter (docs/two_view_models.md); empty = none", live=False
    )
    pose_from: str = setting(
        "maps",
        "part of a two-view network's answer that gives the pose: maps = point maps, matches = matched descriptors",
        choices=("maps", "matches"),
        expert=True,
    )
    scale: str = setting(
        "auto",
        "source of the metres of a two-view network's pose: network; depth = the views' depth; auto = the network if "
        "it is metric, else the depth",
        choices=("auto", "network", "depth"),
        expert=True,
    )
    min_confidence: float = setting(
        3.0, "smallest confidence of a two-view network's points that are used", low=0, high=1e6, expert=True
    )
    network_scale_sigma: float = setting(
        0.1, "sigma of the relative scale error of a two-view network's metres", low=0, high=1, expert=True
    )
    network_warp_sigma: float = setting(
        0.02, "sigma of each relative smooth warp of a two-view network's points", low=0, high=1, expert=True
    )
    focal_sigma: float = setting(
        0.05, "sigma of the relative error of a focal length that a network has estimated", low=0, high=1, expert=True
    )
    features: bool = setting(True, "match features also where a prior is given; they check it and make it more precise")
    max_contradiction: float = setting(
        5.0,
        "largest distance between the given prior and the pose of the features; beyond it both are aligned and the "
        "better result wins",
        unit="sigma",
        low=1,
        high=1e6,
        expert=True,
    )
    max_features: int = setting(2000, "largest number of SIFT features per image", low=50, high=20000)
    match_ratio: float = setting(
        0.8, "largest ratio of the distances to the best and the second-best match", low=0.1, high=1, expert=True
    )
    ransac_px: float = setting(
        3.0, "largest reprojection error of an inlier of the feature pose", unit="px", low=0.1, high=50, expert=True
    )
    min_inliers: int = setting(
        8, "smallest number of inliers of a pose from features or matches", low=4, high=10000, expert=True
    )
    covariance_inflation: float = setting(
        2.5, "factor on the sigmas of the feature pose (calibrated)", low=0.1, high=100, expert=True
    )
    identity_fallback: bool = setting(True, "start from the identity where no prior is given and features give no pose")
    identity_sigma_m: float = setting(
        0.3, "sigma of the translation of an identity start", unit="m", low=1e-4, high=100, expert=True
    )
    identity_sigma_rad: float = setting(
        0.2, "sigma of the rotation of an identity start", unit="rad", low=1e-4, high=3, expert=True
    )
