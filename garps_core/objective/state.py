# SPDX-License-Identifier: Apache-2.0
"""The unknowns of the solver, pose and depth errors, and their prior."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from garps_core.geometry import Array, se3_exp


@dataclass(frozen=True)
class State:
    """Unknowns: pose T (4x4), and errors (12,) of the source's, then the target's depth map, or (0,) for none."""

    T: Array
    errors: Array = field(default_factory=lambda: np.zeros(0))

    def moved(self, step: Array) -> State:
        """The state after a step (6 + errors,): a left twist, then increments of the errors."""
        return State(se3_exp(np.asarray(step[:6], np.float64)) @ self.T, self.errors + step[6:])


@dataclass(frozen=True)
class WeightedStart:
    """Starting pose T with its precision (6, 6) over the left twist, and the precision (e,) of the depth errors."""

    T: Array
    precision: Array
    error_precision: Array = field(default_factory=lambda: np.zeros(0))

    def joint(self) -> Array:
        """Precision over all unknowns, (6 + e, 6 + e)."""
        joint = np.diag(np.concatenate([np.zeros(6), self.error_precision]))
        joint[:6, :6] = self.precision
        return joint
