# SPDX-License-Identifier: Apache-2.0
"""The settings of the lifting: how a pixel with depth becomes a Gaussian, and what is known of the depth's errors."""

from __future__ import annotations

from dataclasses import dataclass

from garps_core.config.field import Checked, setting


@dataclass(frozen=True)
class Lifting(Checked):
    """Settings by which `reconstruct` makes a Gaussian of a pixel with depth."""

    stride: int = setting(
        2, "every n-th pixel is used, in both directions of the image; 1 = all", unit="px", low=1, high=32
    )
    noise_floor_m: float = setting(1.5e-3, "sigma of one depth reading at zero range", unit="m", low=0, high=1)
    noise_linear: float = setting(
        3e-3, "growth of the sigma of one depth reading with range", unit="m/m", low=0, high=1
    )
    noise_quadratic_per_m: float = setting(
        0.0,
        "growth of the sigma of one depth reading with the square of range, as in triangulation",
        unit="1/m",
        low=0,
        high=0.1,
    )
    scale_sigma: float = setting(5e-3, "sigma of the relative scale error of a whole depth map", low=0, high=1)
    warp_sigma: float = setting(
        2e-3, "sigma of each relative smooth warp (tilts, bowls) of a whole depth map", low=0, high=1, expert=True
    )
    patch_sigma: float = setting(
        0.0,
        "sigma of the relative error of depth from one place to the next, beyond the noise",
        low=0,
        high=1,
        expert=True,
    )
    common_scale_sigma: float = setting(
        0.0,
        "sigma of a relative scale error that both depth maps share, which no comparison of the two can show",
        low=0,
        high=1,
        expert=True,
    )
    pointing_sigma_rad: float = setting(
        5e-4,
        "sigma of the direction that a pixel looks in; the default is 0.25 px at a focal length of 500 px",
        unit="rad",
        low=0,
        high=1,
        expert=True,
    )
    sigma_inflation: float = setting(
        1.0,
        "factor on the sigmas that depth contributes to the covariance, 1 = off (calibrated)",
        low=1,
        high=100,
        expert=True,
    )
    edge_ratio: float = setting(
        0.04,
        "largest relative difference of depth between neighbouring pixels; pixels at larger steps are dropped",
        low=1e-3,
        high=1,
        expert=True,
    )
    min_cosine: float = setting(
        0.15,
        "smallest cosine between a surface's normal and the viewing ray; flatter surfaces are treated as if at it",
        low=0.01,
        high=1,
        expert=True,
    )
    min_range_m: float = setting(0.1, "smallest depth that is used", unit="m", low=0, high=100)
    max_range_m: float = setting(20.0, "largest depth that is used", unit="m", low=0.1, high=1000)
    smoothing_px: int = setting(
        5, "diameter of the edge-preserving filter of depth, 0 = off", unit="px", low=0, high=15, expert=True
    )
    footprint: float = setting(
        0.5,
        "sigma of a component across its ray, in spacings of the pixels",
        unit="px/px",
        low=0.05,
        high=5,
        expert=True,
    )
    weighting: str = setting(
        "area",
        "weight of a component: area = the area of surface it stands for, equal = the same for all",
        choices=("area", "equal"),
        expert=True,
    )
