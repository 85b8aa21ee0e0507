# SPDX-License-Identifier: Apache-2.0
"""Gauss-Newton over a pose: the one loop behind every refinement of a pose by residuals.

A cost 1/2 sum w r(T)^2 is linearised over the left twist x of T <- exp(x) T, so that it is g' x + x' H x / 2 with
g = J' W r and H = J' W J. Weights (robust losses, noise read off the residuals) are held during a step.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from garps_core.geometry import Array, se3_exp

NormalEquations = tuple[Array, Array]
"""H (6, 6), Gauss-Newton Hessian, and g (6,), gradient of the cost, both over the left twist (v m, w rad)."""

Linearise = Callable[[Array], NormalEquations | None]
"""The normal equations at a pose T (4x4); None where nothing can be compared there."""


def gauss_newton(T: Array, linearise: Linearise, steps: int) -> Array:
    """Take Gauss-Newton steps from the pose T (4x4), and return where they end.

    Args:
        T: pose to start from.
        linearise: normal equations at a pose. A prior or a damping is part of them.
        steps: number of steps; fewer are taken where `linearise` returns None.
    Raises:
        numpy.linalg.LinAlgError: H is singular.
    """
    for _ in range(steps):
        equations = linearise(T)
        if equations is None:
            break
        H, g = equations
        T = np.asarray(se3_exp(np.asarray(-np.linalg.solve(H, g), np.float64)) @ T, np.float64)
    return T
