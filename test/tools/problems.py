# SPDX-License-Identifier: Apache-2.0
"""Alignment problems without threads, for tests of the solver's parts."""

from concurrent.futures import Executor, Future

import numpy as np

from garps_core import Config
from garps_core.objective.pairs import to_device
from garps_core.objective.state import WeightedStart
from garps_core.solver.problem import Problem


class Inline(Executor):
    """Run every task at once, on the calling thread."""

    def submit(self, fn, /, *args, **kwargs):
        """The finished future."""
        future = Future()
        future.set_result(fn(*args, **kwargs))
        return future


INLINE = Inline()


def problem_of(mixtures, start=None, config=None, guess=False):
    """The problem of two mixtures; the start is the identity, one sigma wide, unless given."""
    config = config or Config()
    x, y = (to_device(mixture, config) for mixture in mixtures)
    return Problem(x, y, start or WeightedStart(np.eye(4), np.eye(6)), config, INLINE, guess)
