# SPDX-License-Identifier: Apache-2.0
"""Methods of alignment by the name that the setting `method` gives them."""

from __future__ import annotations

from collections.abc import Callable, Iterable

from garps_core.solver.ladder import Solution, anneal
from garps_core.solver.paper import maximise
from garps_core.solver.problem import Problem
from garps_core.solver.search import search


def garps(problem: Problem) -> Iterable[Solution]:
    """Maximum a posteriori solutions: a search around a guess, otherwise one annealed ascent from the start."""
    return search(problem) if problem.guess else anneal(problem)


METHODS: dict[str, Callable[[Problem], Iterable[Solution]]] = {"garps": garps, "paper": maximise}
"""Every method, from a problem to its solutions, the most promising first and computed on demand."""
