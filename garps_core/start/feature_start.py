# SPDX-License-Identifier: Apache-2.0
"""The start from matched features of both images."""

from __future__ import annotations

from garps_core.config import Config
from garps_core.start.features import match_features
from garps_core.start.match_pose import pose_from_matches
from garps_core.start.methods import Ask
from garps_core.types import Prior, View


def find(source: View, target: View, config: Config, ask: Ask) -> Prior:
    """Return the pose of matched features. Raises InitialisationError where too few of them fit one pose."""
    return pose_from_matches(match_features(source, target, config.start), source, target, config)
