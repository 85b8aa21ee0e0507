# SPDX-License-Identifier: Apache-2.0
"""Initial poses, always with a covariance: a given prior and features, or a two-view network, as two measurements of
one pose; or identity."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from garps_core.config import Config
from garps_core.config.combinations import check_start
from garps_core.config.start import TWO_VIEW
from garps_core.errors import InitialisationError, InputError, ModelError, WeightsError
from garps_core.geometry import ros_from_twist, se3_exp, se3_inverse, se3_log, twist_from_ros
from garps_core.models.in_use import Networks
from garps_core.point_maps import PairMaps
from garps_core.start.descriptors import match_descriptors
from garps_core.start.features import match_features
from garps_core.start.match_pose import pose_from_matches
from garps_core.start.point_map_pose import pose_from_maps
from garps_core.types import Prior, View


def initialise(
    source: View,
    target: View,
    config: Config | None = None,
    prior: Prior | None = None,
    networks: Networks | None = None,
    maps: PairMaps | None = None,
) -> tuple[Prior, ...]:
    """Initial poses worth aligning from, each saying why (`Prior.origin`, `Prior.reason`).

    "auto" takes what a given prior and features say together; features alone; a prior alone (also where
    `start.features` is off); or identity if `start.identity_fallback`. Prior and features that contradict each other
    are two initial poses: the alignment has to tell which is right. "features" and "identity" do as they say and ignore
    a prior. A two-view network's pose is put together with a given prior as that of features is under "auto".
    `networks` keeps what it loads for the next call; None = load what is needed for this call alone. `maps` is the
    answer of the two-view network about this pair, where it has been asked before; None = it is asked here.

    Raises:
        InitialisationError: features fail and identity is not allowed; or the two-view network fails, has too little
            memory, or computes what is not finite.
        WeightsError: the two-view network's weights are missing, or not what they should be.
        ConfigError: no such adapter, or metres from a network that has none.
    """
    config = config or Config()
    method = config.start.method
    if method in TWO_VIEW:
        check_start(config.start)
        found = _by_network(source, target, config, networks or Networks(), maps)
        return (found,) if prior is None else combined(prior, found, config.start.max_contradiction)
    if method == "identity":
        return (identity(config, "asked for by start.method"),)
    if method == "auto" and prior is not None and not config.start.features:
        return (prior,)
    try:
        found = pose_from_matches(match_features(source, target, config.start), source, target, config)
    except InitialisationError as failure:
        if method == "auto" and prior is not None:
            return (prior,)
        if method == "features" or not config.start.identity_fallback:
            raise
        return (identity(config, f"features failed: {failure}"),)
    return (found,) if prior is None or method == "features" else combined(prior, found, config.start.max_contradiction)


def _by_network(source: View, target: View, config: Config, networks: Networks, maps: PairMaps | None) -> Prior:
    try:
        maps = maps or networks.pair_maps(source.rgb, target.rgb, config)
    except WeightsError:
        raise
    except ModelError as failure:
        raise InitialisationError(f"{config.start.method}: {failure}") from None
    if config.start.pose_from == "maps":
        return pose_from_maps(maps, source, target, config)
    matches = match_descriptors(maps, source, target, config)
    coarsest = max(1.0, *(1 / side for framing in maps.framings for side in framing.scale))  # its pixel, in the image's
    config = config.replace({"start.ransac_px": min(config.start.ransac_px * coarsest, 50.0)})
    if maps.gives_metres(config.start.scale):
        # PnP takes both views' scales for independent of each other: of one error it sees half the variance.
        errors = {"scale_sigma": np.sqrt(2) * config.start.network_scale_sigma}
        errors["warp_sigma"] = config.start.network_warp_sigma
        wider = {f"lifting.{name}": max(float(e), getattr(config.lifting, name)) for name, e in errors.items()}
        config = config.replace(wider | {"lifting.patch_sigma": 0.0})  # these points were seen with both views
    return pose_from_matches(matches, source, target, config, maps.origin)


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


def identity(config: Config, reason: str) -> Prior:
    """No motion, with the sigmas of `start.identity_sigma_*`: what a guess without any measurement is worth."""
    sigmas = [config.start.identity_sigma_m] * 3 + [config.start.identity_sigma_rad] * 3
    return Prior(np.eye(4), np.diag(np.square(sigmas)), "identity", reason)
