# SPDX-License-Identifier: Apache-2.0
"""The settings of the lifting, the part of `Config` that says how a pixel with depth becomes a Gaussian."""

from __future__ import annotations

from dataclasses import dataclass

from garps_core.config.field import Checked, setting


@dataclass(frozen=True)
class Lifting(Checked):
    """How a pixel with depth becomes a Gaussian (`reconstruct`)."""

    stride: int = setting(2, "use every n-th pixel in both image directions", unit="px", low=1, high=32)
    noise_floor_m: float = setting(1.5e-3, "sigma of one depth reading at zero range", unit="m", low=0, high=1)
    noise_linear: float = setting(3e-3, "sigma of one depth reading per metre of range", unit="m/m", low=0, high=1)
    noise_quadratic_per_m: float = setting(
        0.0,
        "sigma of one depth reading per square metre of range (triangulation)",
        unit="1/m",
        low=0,
        high=0.1,
    )
    scale_sigma: float = setting(5e-3, "relative scale error that a whole depth map may share", low=0, high=1)
    warp_sigma: float = setting(2e-3, "relative smooth warp that a depth map may have", low=0, high=1)
    patch_sigma: float = setting(
        0.0, "relative error of depth that differs from place to place, too large for noise", low=0, high=1
    )
    common_scale_sigma: float = setting(
        0.0, "relative scale error that both depth maps have in common, so that no picture shows it", low=0, high=1
    )
    pointing_sigma_rad: float = setting(
        5e-4, "error of the direction a pixel looks in (0.25 px at a focal length of 500 px)", unit="rad", low=0, high=1
    )
    sigma_inflation: float = setting(
        1.0, "sigmas of what this depth says, times this: for errors of another kind (calibrated)", low=1, high=100
    )
    edge_ratio: float = setting(
        0.04, "drop pixels whose neighbours' depth differs by more than this share", unit="", low=1e-3, high=1
    )
    min_cosine: float = setting(
        0.15, "surfaces seen flatter than this cosine are treated as seen at it", unit="", low=0.01, high=1
    )
    min_range_m: float = setting(0.1, "ignore depth below", unit="m", low=0, high=100)
    max_range_m: float = setting(20.0, "ignore depth beyond", unit="m", low=0.1, high=1000)
    smoothing_px: int = setting(5, "diameter of the edge-keeping depth filter, 0 = off", unit="px", low=0, high=15)
    footprint: float = setting(0.5, "sigma of the footprint in pixel spacings", unit="px/px", low=0.05, high=5)
    weighting: str = setting(
        "area", "component weights: surface area seen, or one per pixel", choices=("area", "equal")
    )
