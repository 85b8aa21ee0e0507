# SPDX-License-Identifier: Apache-2.0
"""Mixtures of random components."""

from __future__ import annotations

import numpy as np

from garps_core.types import Mixture


def random_mixture(n: int, seed: int = 0) -> Mixture:
    rng = np.random.default_rng(seed)
    factors = rng.normal(size=(n, 3, 3)) * rng.uniform(1e-3, 0.1, (n, 1, 3))
    return Mixture(
        means=rng.uniform(-3, 3, (n, 3)),
        covariances=factors @ factors.transpose(0, 2, 1) + 1e-6 * np.eye(3),
        weights=rng.uniform(0.1, 1, n),
        colours=rng.uniform(0, 1, (n, 3)),
    )
