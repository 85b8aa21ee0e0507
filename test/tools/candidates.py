# SPDX-License-Identifier: Apache-2.0
"""Candidates without an alignment, for tests of the verdict."""

import numpy as np
from surfaces import TRUTH

from garps_core.objective.brightness import BrightnessFit
from garps_core.objective.shape import Evaluation
from garps_core.objective.state import State
from garps_core.solver.ladder import Solution
from garps_core.verdict.candidate import Candidate

SMALL = np.diag([0.005**2] * 3 + [0.002**2] * 3)


def candidate(
    T=TRUTH, support=0.95, correlation=0.95, share=0.8, converged=True, covariance=SMALL, overlap=0.8, fixed_steps=False
):
    """A candidate that is fine unless told otherwise; correlation None = brightness was not compared."""
    data = Evaluation(3.0, np.zeros(6), np.eye(6), np.eye(6), support)
    brightness = None if correlation is None else BrightnessFit(T, covariance, correlation, share)
    solution = Solution(State(T), None, 17, converged, 60.0, data, fixed_steps=fixed_steps)
    return Candidate(solution, T, covariance, overlap, brightness)
