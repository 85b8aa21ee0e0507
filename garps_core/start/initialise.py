# SPDX-License-Identifier: Apache-2.0
"""Start poses, always with a covariance: a given prior and a found start are two measurements of one pose."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from garps_core.config import Config
from garps_core.errors import InitialisationError, InputError
from garps_core.geometry import ros_from_twist, se3_exp, se3_inverse, se3_log, twist_from_ros
from garps_core.models.in_use import Networks
from garps_core.point_maps import PairMaps
from garps_core.start.identity_start import identity
from garps_core.start.methods import Ask, find_start
from garps_core.types import Prior, View

ALONE = ("features", "identity")
"""Values of `start.method` that ask for this start and nothing else: a given prior is ignored."""


def initialise(
    source: View,
    target: View,
    config: Config | None = None,
    prior: Prior | None = None,
    networks: Networks | None = None,
    maps: PairMaps | None = None,
) -> tuple[Prior, ...]:
    """Return the poses to align from, each with its `origin` and `reason`.

    "auto" takes a given prior and features together. Without a prior it takes features; where features find no pose,
    or `start.features` is off, the prior alone; and with neither the identity, if `start.identity_fallback`.
    "features" and "identity" ignore a prior. The pose of every other method is combined with a given prior as that of
    features is. A prior and a start that contradict each other are two start poses; the alignment decides between them.

    Args:
        source, target: the pair.
        config: settings; the default preset when None.
        prior: a pose that the caller gives.
        networks: keeps what it loads for the next call; None = load what is needed for this call alone.
        maps: the two-view network's answer about this pair; None = it is asked here where the method needs it.
    Raises:
        InitialisationError: the method finds no pose, and nothing else is allowed.
        WeightsError: the weights of its network are missing, or not what they should be.
        ConfigError: the method cannot be loaded, or settings do not go together.
    """
    config = config or Config()

    def ask() -> PairMaps:
        return maps or (networks or Networks()).pair_maps(source.rgb, target.rgb, config)

    if config.start.method == "auto":
        return _automatic(source, target, config, prior, ask)
    found = find_start(config.start.method, source, target, config, ask)
    if prior is None or config.start.method in ALONE:
        return (found,)
    return combined(prior, found, config.start.max_contradiction)


def _automatic(source: View, target: View, config: Config, prior: Prior | None, ask: Ask) -> tuple[Prior, ...]:
    if prior is not None and not config.start.features:
        return (prior,)
    try:
        found = find_start("features", source, target, config, ask)
    except InitialisationError as failure:
        if prior is not None:
            return (prior,)
        if not config.start.identity_fallback:
            raise
        return (identity(config, f"features failed: {failure}"),)
    return (found,) if prior is None else combined(prior, found, config.start.max_contradiction)


def combined(given: Prior, features: Prior, max_contradiction: float) -> tuple[Prior, ...]:
    """The pose that two measurements agree on, or both of them, features first, when they contradict each other.

    What is said of features here goes for a two-view network, too.

    They contradict when their difference, log(T_given T_features^-1), is more than `max_contradiction` sigmas long
    under the sum of their covariances. Otherwise the difference is shared out by the two covariances (the update of
    a Kalman filter, linearised at the features' pose, which is the closer one when the prior is vague).
    """
    T = features.T_target_source
    of_given = twist_from_ros(given.covariance, given.T_target_source)
    of_features = twist_from_ros(features.covariance, T)
    difference = se3_log(given.T_target_source @ se3_inverse(T))
    sigmas = float(np.sqrt(difference @ np.linalg.solve(of_given + of_features, difference)))
    if sigmas > max_contradiction:
        reason = f"contradicts the {{}}: {sigmas:.1f} sigmas apart ({max_contradiction:g} allowed)"
        return (
            Prior(T, features.covariance, features.origin, f"{features.reason}; {reason.format('given prior')}"),
            Prior(given.T_target_source, given.covariance, given.origin, reason.format(features.origin)),
        )
    gain = of_features @ np.linalg.inv(of_given + of_features)
    T = np.asarray(se3_exp(np.asarray(gain @ difference, np.float64)) @ T, np.float64)
    left = of_features - gain @ of_features
    covariance = ros_from_twist(0.5 * (left + left.T), T)
    reason = f"{features.reason}, {sigmas:.1f} sigmas from the given prior"
    try:
        return (Prior(T, covariance, f"{given.origin} and {features.origin}", reason),)
    except InputError:  # covariances too many orders of magnitude apart for float64
        return (replace(given, reason=f"too precise for the {features.origin} to add to it ({features.reason})"),)
