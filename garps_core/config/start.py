# SPDX-License-Identifier: Apache-2.0
"""The settings of the start, the part of `Config` that says where the alignment begins."""

from __future__ import annotations

from dataclasses import dataclass

from garps_core.config.field import Checked, setting

TWO_VIEW = ("mast3r", "dust3r", "adapter")
"""Starts by a two-view network."""
STARTS = ("auto", "features", "identity", *TWO_VIEW)


@dataclass(frozen=True)
class Start(Checked):
    """Where the alignment starts (`initialise`)."""

    method: str = setting(
        "auto",
        "auto = the given prior and features together, or the one there is, else identity when `identity_fallback`; "
        "mast3r, dust3r, adapter = a two-view network, and the prior",
        choices=STARTS,
        live=False,
    )
    weights: str = setting(
        "", "of mast3r, dust3r or the adapter: a name or a file; empty = the first installed", live=False
    )
    adapter: str = setting("", "name of an installed two-view adapter (docs/two_view_models.md)", live=False)
    pose_from: str = setting(
        "maps", "a two-view network's point maps, or matches of its descriptors", choices=("maps", "matches")
    )
    scale: str = setting(
        "auto",
        "whose metres a two-view network's pose gets: its own, or the depth's; auto = its own if it has any",
        choices=("auto", "network", "depth"),
    )
    min_confidence: float = setting(
        3.0, "points of which a two-view network is less sure are not used", unit="", low=0, high=1e6
    )
    network_scale_sigma: float = setting(0.1, "relative error of a two-view network's metre", low=0, high=1)
    network_warp_sigma: float = setting(0.02, "relative smooth warp of a two-view network's points", low=0, high=1)
    focal_sigma: float = setting(0.05, "relative error of a focal length that a network has estimated", low=0, high=1)
    features: bool = setting(True, "match features also where a prior is given: they check and fit_brightness it")
    max_contradiction: float = setting(
        5.0, "given prior and features further apart than this are two rivals", unit="sigma", low=1, high=1e6
    )
    max_features: int = setting(2000, "SIFT features per image", low=50, high=20000)
    match_ratio: float = setting(0.8, "ratio test of the feature matches", unit="", low=0.1, high=1)
    ransac_px: float = setting(3.0, "inlier threshold of the pose estimate", unit="px", low=0.1, high=50)
    min_inliers: int = setting(8, "fewer inliers than this is no pose", low=4, high=10000)
    covariance_inflation: float = setting(
        2.5, "sigmas of the feature pose are multiplied by this (calibrated)", unit="", low=0.1, high=100
    )
    identity_fallback: bool = setting(True, "start from identity when features fail and no prior is given")
    identity_sigma_m: float = setting(0.3, "sigma of the identity start, translation", unit="m", low=1e-4, high=100)
    identity_sigma_rad: float = setting(0.2, "sigma of the identity start, rotation", unit="rad", low=1e-4, high=3)
