# SPDX-License-Identifier: Apache-2.0
"""Metric relative camera pose from two views, by aligning two 3D Gaussian mixtures."""

from garps_core.align import Estimator, align_mixtures, estimate_relative_pose
from garps_core.config import Config
from garps_core.errors import ConfigError, GarpsError, InputError, ReconstructionError
from garps_core.mixtures.reconstruct import reconstruct
from garps_core.types import Mixture, PoseEstimate, Prior, Status, View
from garps_core.version import __version__ as __version__

__all__ = [
    "Config",
    "ConfigError",
    "Estimator",
    "GarpsError",
    "InputError",
    "Mixture",
    "PoseEstimate",
    "Prior",
    "ReconstructionError",
    "Status",
    "View",
    "align_mixtures",
    "estimate_relative_pose",
    "reconstruct",
]
