# SPDX-License-Identifier: Apache-2.0
"""Settings that do not go together, each with what to change."""

from __future__ import annotations

from garps_core.config.config import Config
from garps_core.config.start import TWO_VIEW, Start
from garps_core.errors import (
    ConfigError,
    MissingDepthError,
)


def check_settings(config: Config) -> None:
    """Raises ConfigError where depth from a network meets settings for a sensor's; for auto it is a view's fault."""
    check_start(config.start)
    if config.reconstruction.method == "two_view" and config.start.method not in TWO_VIEW:
        raise ConfigError(
            f"reconstruction.method is two_view and start.method is {config.start.method}: expected a two-view network "
            f"to start with, one of {', '.join(TWO_VIEW)}"
        )
    if config.reconstruction.method == "two_view" and config.start.method == "dust3r":
        raise ConfigError("reconstruction.method is two_view and the points of dust3r have no metres: expected mast3r")
    if config.alignment.depth_errors or config.method == "paper":
        return
    if config.reconstruction.method == "auto":
        raise MissingDepthError(
            "the view has no depth: expected HxW float32 metres; give View(..., depth=...), or take the preset "
            "monocular, which asks a network"
        )
    raise ConfigError(
        f"reconstruction.method is {config.reconstruction.method}, whose depth is off by per cents as a whole, and "
        "alignment.depth_errors is false, as for a sensor, so the covariance would promise too much: expected the "
        "preset monocular"
    )


def check_start(start: Start) -> None:
    """Raises ConfigError for a two-view network that cannot do what the other settings of the start ask for."""
    if start.method == "dust3r" and start.scale == "network":
        raise ConfigError("start.scale is network, and dust3r has no metres: expected auto or depth")
    if start.method == "dust3r" and start.pose_from == "matches":
        raise ConfigError("start.pose_from is matches, and dust3r has no descriptors: expected maps")
    if start.method == "adapter" and not start.adapter:
        raise ConfigError(
            "start.method is adapter and start.adapter is empty: expected the name of an installed adapter"
        )
