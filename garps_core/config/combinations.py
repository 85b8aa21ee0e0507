# SPDX-License-Identifier: Apache-2.0
"""Settings that do not go together, each with the change that helps."""

from __future__ import annotations

from garps_core.config.config import Config
from garps_core.config.start import TWO_VIEW, Start
from garps_core.errors import ConfigError, MissingDepthError


def check_settings(config: Config) -> None:
    """Check settings for views whose depth a network gives.

    Raises:
        ConfigError: settings that do not go together, or that are for the depth of a sensor.
        MissingDepthError: `reconstruction.method` is auto and the settings are for a sensor: the view lacks depth.
    """
    check_start(config.start)
    _check_two_view(config)
    if config.alignment.depth_errors or config.method == "paper":
        return
    if config.reconstruction.method == "auto":
        raise MissingDepthError(
            "the view has no depth: expected HxW float32 metres. Give View(..., depth=...), or take the preset "
            "monocular, whose depth comes from a network"
        )
    raise ConfigError(
        f"reconstruction.method is {config.reconstruction.method}, whose depth is off by per cents as a whole, and "
        "alignment.depth_errors is false: expected the preset monocular. With settings for a sensor the covariance "
        "would be too small"
    )


def _check_two_view(config: Config) -> None:
    """Raise ConfigError where both views' depth shall come from a two-view network that cannot give it."""
    if config.reconstruction.method != "two_view":
        return
    if config.start.method not in TWO_VIEW:
        raise ConfigError(
            f"reconstruction.method is two_view and start.method is {config.start.method}: expected a two-view network "
            f"to start with, one of {', '.join(TWO_VIEW)}"
        )
    if config.start.method == "dust3r":
        raise ConfigError("reconstruction.method is two_view and the points of dust3r have no metres: expected mast3r")


def check_start(start: Start) -> None:
    """Raise ConfigError for a two-view network that cannot do what other settings of the start ask for."""
    if start.method == "dust3r" and start.scale == "network":
        raise ConfigError("start.scale is network, and dust3r has no metres: expected auto or depth")
    if start.method == "dust3r" and start.pose_from == "matches":
        raise ConfigError("start.pose_from is matches, and dust3r has no descriptors: expected maps")
    if start.method == "adapter" and not start.adapter:
        raise ConfigError(
            "start.method is adapter and start.adapter is empty: expected the name of an installed adapter"
        )
