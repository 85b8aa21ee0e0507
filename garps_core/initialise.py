# SPDX-License-Identifier: Apache-2.0
"""Initial pose, always with a covariance: the given prior, features + metric PnP in both directions, or identity."""

from __future__ import annotations

import numpy as np

from garps_core.config import Config
from garps_core.errors import InitialisationError
from garps_core.features import match_features
from garps_core.pnp import pose_from_matches
from garps_core.types import Prior, View


def initialise(source: View, target: View, config: Config | None = None, prior: Prior | None = None) -> Prior:
    """Choose the initial pose and say why (`Prior.origin`, `Prior.reason`).

    "auto" takes the given prior, else features, else identity if `start.identity_fallback`; "features" and
    "identity" do as they say and ignore a prior.

    Raises:
        InitialisationError: features fail and identity is not allowed.
    """
    config = config or Config()
    method = config.start.method
    if method == "auto" and prior is not None:
        return prior
    if method == "identity":
        return _identity(config, "asked for by start.method")
    try:
        return pose_from_matches(match_features(source, target, config.start), source, target, config)
    except InitialisationError as failure:
        if method == "features" or not config.start.identity_fallback:
            raise
        return _identity(config, f"features failed: {failure}")


def _identity(config: Config, reason: str) -> Prior:
    sigmas = [config.start.identity_sigma_m] * 3 + [config.start.identity_sigma_rad] * 3
    return Prior(np.eye(4), np.diag(np.square(sigmas)), "identity", reason)
