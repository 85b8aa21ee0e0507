# SPDX-License-Identifier: Apache-2.0
"""Whatever well-formed mixtures come in, what comes out is a status, and a finite pose with a definite covariance."""

import numpy as np
import pytest

from garps_core import Config, Mixture, Prior, align_mixtures
from garps_core.geometry import se3_exp

PAPER = {
    "paper.component_stride": 1,
    "paper.opacity_threshold": 0.0,
    "paper.steps": 5,
}
CONFIGS = {
    "sensor": Config(),
    "monocular": Config.preset("monocular"),
    "paper": Config.preset("paper").replace(PAPER),
}


def any_mixture(rng, scale):
    """50 to 400 components of wildly different shapes, some behind the camera."""
    n = int(rng.integers(50, 400))
    A = rng.normal(size=(n, 3, 3)) * scale * 10 ** rng.uniform(-4, 0)
    covariances = A @ A.transpose(0, 2, 1) + (1e-8 * scale**2 + 1e-12) * np.eye(3)
    means = rng.normal(size=(n, 3)) * scale + [0, 0, rng.uniform(-2, 5) * scale]
    labels = rng.integers(0, 5, n) if rng.random() < 0.5 else None
    return Mixture(means, covariances, rng.uniform(1e-9, 1, n), rng.uniform(size=(n, 3)), labels)


@pytest.mark.parametrize("preset", CONFIGS)
@pytest.mark.parametrize("seed", range(15))
def test_any_two_mixtures_get_an_answer(preset, seed):
    rng = np.random.default_rng([seed, list(CONFIGS).index(preset)])
    scale = 10 ** rng.uniform(-3, 3)
    prior = Prior(se3_exp(rng.normal(size=6) * 0.3), np.diag(rng.uniform(0.1, 1, 6)) * 10 ** rng.uniform(-6, 2))
    estimate = align_mixtures(any_mixture(rng, scale), any_mixture(rng, scale), prior, CONFIGS[preset])
    assert estimate.reason
    if estimate.T_target_source is None:
        assert not estimate.ok and estimate.covariance is None
        return
    assert np.isfinite(estimate.T_target_source).all()
    assert np.linalg.eigvalsh(estimate.covariance)[0] > 0
