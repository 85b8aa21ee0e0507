# SPDX-License-Identifier: Apache-2.0
"""Settings of the published method, used by `method` paper only; the defaults are the published values."""

from __future__ import annotations

from dataclasses import dataclass

from garps_core.config.field import Checked, setting


@dataclass(frozen=True)
class Paper(Checked):
    """Candidate pairs and optimiser of the published method (Li and Campbell)."""

    opacity_threshold: float = setting(
        0.5, "smallest weight of a component that the published method uses, 0 = all", low=0, high=1, expert=True
    )
    component_stride: int = setting(
        32, "every n-th component is used by the published method, 1 = all", low=1, high=100_000, expert=True
    )
    neighbours: int = setting(
        30, "number of nearest neighbours per component, chosen once at the start pose", low=1, high=200, expert=True
    )
    max_distance_m: float = setting(
        2.5, "largest distance between a component and its partner", unit="m", low=1e-3, high=1000, expert=True
    )
    covariance_scale: float = setting(
        90.0, "factor on the covariance of every component", low=1e-3, high=1e4, expert=True
    )
    colour_variance: float = setting(
        0.4, "variance of each colour channel, for channels from 0 to 1", low=1e-4, high=100, expert=True
    )
    semantic_discount: float = setting(
        0.92, "factor on the weight of a pair of components with different labels", low=0, high=1, expert=True
    )
    steps: int = setting(1000, "number of steps that Adam takes", low=1, high=100_000, expert=True)
    rate_translation: float = setting(
        9e-5, "learning rate of Adam for the translation", unit="m", low=0, high=1, expert=True
    )
    rate_rotation: float = setting(
        3e-6, "learning rate of Adam for the rotation, a unit quaternion", low=0, high=1, expert=True
    )
