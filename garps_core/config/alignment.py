# SPDX-License-Identifier: Apache-2.0
"""The settings of the alignment: the objective, how it is maximised, and what a pose must fulfil."""

from __future__ import annotations

from dataclasses import dataclass

from garps_core.config.field import Checked, setting
from garps_core.config.ladders import SEARCH, SENSOR, SENSOR_SEARCH, Rung
from garps_core.errors import ConfigError


@dataclass(frozen=True)
class Alignment(Checked):
    """The objective, how `align_mixtures` maximises it, and what a pose must fulfil to be `converged`."""

    ladder: tuple[Rung, ...] = SENSOR
    """Rungs from the start pose."""
    search: tuple[Rung, ...] = SEARCH
    """Rungs that rank the starting poses of a search."""
    search_ladder: tuple[Rung, ...] = SENSOR_SEARCH
    """Rungs from the best poses of a search."""
    search_followed: int = setting(
        4, "largest number of starting poses that a search follows to the end", low=1, high=100, expert=True
    )
    partner_density: float = setting(
        1.0,
        "number of partners kept per kernel-sized patch of a mixture; never fewer than the rung's components",
        low=0,
        high=100,
        expert=True,
    )
    colour_variance: float = setting(
        0.02, "variance of each colour channel, for channels from 0 to 1", low=1e-4, high=100, expert=True
    )
    semantic_discount: float = setting(
        0.92, "factor on the weight of a pair of components with different labels", low=0, high=1, expert=True
    )
    outlier_floor: float = setting(
        0.003,
        "density of outliers, as a share of the density that one perfect partner gives",
        low=0,
        high=10,
        expert=True,
    )
    max_distance_m: float = setting(
        2.5, "largest distance between a component and its partner", unit="m", low=1e-3, high=1000, expert=True
    )
    occlusion_ratio: float = setting(
        0.1,
        "share of the other view's depth by which a component may lie behind it without counting as hidden",
        low=0,
        high=10,
        expert=True,
    )
    depth_errors: bool = setting(
        False,
        "solve for an error of scale and a smooth warp of each depth map together with the pose; their sigmas are "
        "`lifting.scale_sigma` and `lifting.warp_sigma`",
        expert=True,
    )
    brightness_measurements: float = setting(
        0.0,
        "number of independent measurements that the brightness of a point counts for, 0 = brightness does not refine "
        "the pose",
        low=0,
        high=10,
        expert=True,
    )
    effective_measurements: float = setting(
        30.0,
        "number of independent measurements that the shape of the scene counts for against the start pose (calibrated)",
        low=1e-3,
        high=1e6,
        expert=True,
    )
    tolerance: float = setting(
        0.02, "length of a step below which the solver has converged", unit="sigma", low=1e-9, high=1, expert=True
    )
    min_overlap: float = setting(
        0.1, "smallest share of components that both views must see, else low_overlap", low=0, high=1, expert=True
    )
    max_prior_sigmas: float = setting(
        8.0,
        "largest distance of the pose from the start pose, else inconsistent",
        unit="sigma",
        low=1,
        high=1e6,
        expert=True,
    )
    min_support: float = setting(
        0.35,
        "smallest share of components that must find a partner under the final pose, else poor_fit",
        low=0,
        high=1,
        expert=True,
    )
    guess_uncertainty: float = setting(
        0.1,
        "share of their range by which scene points may be uncertain under the start pose before it counts as a guess",
        low=0,
        high=1e6,
        expert=True,
    )
    guess_support: float = setting(
        0.8,
        "value that replaces `alignment.min_support` after a guess when the views have no brightness to compare",
        low=0,
        high=1,
        expert=True,
    )
    min_correlation: float = setting(
        0.6,
        "smallest correlation of the views' brightness under the final pose, else poor_fit; -1 = not tested",
        low=-1,
        high=1,
        expert=True,
    )
    guess_correlation: float = setting(
        0.76, "value that replaces `alignment.min_correlation` after a guess", low=-1, high=1, expert=True
    )
    enough_correlation: float = setting(
        0.95,
        "correlation of the views' brightness at which a search stops and takes the pose it has found",
        low=-1,
        high=1,
        expert=True,
    )
    max_uncertainty: float = setting(
        0.05,
        "share of their range by which scene points may be uncertain under the final pose, else degenerate",
        low=1e-6,
        high=1e6,
        expert=True,
    )

    def __post_init__(self) -> None:
        super().__post_init__()
        if not self.ladder or not all(isinstance(rung, Rung) for rung in self.ladder):
            raise ConfigError(f"alignment.ladder is {self.ladder!r}: expected a tuple of at least one Rung")
