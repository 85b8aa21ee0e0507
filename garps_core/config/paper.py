# SPDX-License-Identifier: Apache-2.0
"""Settings of the published method, used by `method` paper only; the defaults are the published values."""

from __future__ import annotations

from dataclasses import dataclass

from garps_core.config.field import Checked, setting


@dataclass(frozen=True)
class Paper(Checked):
    """Candidate pairs and optimiser of the published method (Li and Campbell)."""

    opacity_threshold: float = setting(0.5, "components of smaller opacity are dropped", low=0, high=1)
    component_stride: int = setting(32, "every n-th of the remaining components is used", low=1, high=100_000)
    neighbours: int = setting(30, "nearest neighbours per component, chosen once at the start", low=1, high=200)
    max_distance_m: float = setting(2.5, "neighbours further apart are ignored", unit="m", low=1e-3, high=1000)
    covariance_scale: float = setting(90.0, "factor on every component's covariance", low=1e-3, high=1e4)
    colour_variance: float = setting(0.4, "variance of each colour channel (0..1)", low=1e-4, high=100)
    semantic_discount: float = setting(0.92, "weight of a pair with different labels", low=0, high=1)
    steps: int = setting(1000, "steps of Adam", low=1, high=100_000)
    rate_translation: float = setting(9e-5, "learning rate of Adam for the translation", unit="m", low=0, high=1)
    rate_rotation: float = setting(3e-6, "learning rate of Adam for the quaternion", low=0, high=1)
