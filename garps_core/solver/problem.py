# SPDX-License-Identifier: Apache-2.0
"""One alignment problem: what travels together through every solver."""

from __future__ import annotations

from concurrent.futures import Executor
from dataclasses import dataclass

import numpy as np

from garps_core.config import Alignment, Config
from garps_core.geometry import Array
from garps_core.objective.pairs import DeviceMixture
from garps_core.objective.state import State, WeightedStart


@dataclass(frozen=True)
class Problem:
    """Two mixtures on the device, the start with its precision, the settings, and the pool of the second direction.

    Compiled loops release the interpreter, so `pool` computes target to source beside source to target. One thread is
    enough. The caller opens and closes it: a pool that outlives the call would hang a forked child.
    """

    source: DeviceMixture
    target: DeviceMixture
    start: WeightedStart
    config: Config
    pool: Executor
    guess: bool = False
    """The start is a guess that carries next to no information, so a solver may search around it."""

    @property
    def settings(self) -> Alignment:
        """Settings of the alignment."""
        return self.config.alignment

    def state(self, T: Array) -> State:
        """The state at a pose (4x4), without depth errors."""
        return State(T, np.zeros(len(self.start.error_precision)))
