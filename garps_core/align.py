# SPDX-License-Identifier: Apache-2.0
"""The whole story: two views -> two mixtures -> initial pose -> alignment -> pose with covariance."""

from __future__ import annotations

import time

import numpy as np

from garps_core.config import Config
from garps_core.initialise import initialise
from garps_core.pairing import overlap, to_cloud
from garps_core.reconstruct import reconstruct
from garps_core.solve import anneal
from garps_core.types import Mixture, PoseEstimate, Prior, Status, View
from garps_core.uncertainty import ros_from_twist, twist_from_ros


def estimate_relative_pose(
    source: View, target: View, config: Config | None = None, prior: Prior | None = None
) -> PoseEstimate:
    """Estimate the metric pose of the source camera in the target camera's frame."""
    config = config or Config()
    clock = time.perf_counter
    start = clock()
    x, y = reconstruct(source, config), reconstruct(target, config)
    lifted = clock()
    initial = initialise(source, target, config, prior)
    initialised = clock()
    estimate = align_mixtures(x, y, initial, config)
    estimate.seconds.update(reconstruct=lifted - start, initialise=initialised - lifted)
    return estimate


def align_mixtures(source: Mixture, target: Mixture, initial: Prior, config: Config | None = None) -> PoseEstimate:
    """Align."""
    config = config or Config()
    settings = config.alignment
    begin = time.perf_counter()
    x, y = to_cloud(source, config), to_cloud(target, config)
    T0 = initial.T_target_source
    precision = np.linalg.inv(twist_from_ros(initial.covariance, T0))
    solution = anneal(x, y, T0, precision, settings.ladder, settings)
    if solution is None:
        return PoseEstimate(Status.LOW_OVERLAP, "few", initial=initial)
    C = ros_from_twist(np.linalg.inv(solution.posterior.information), solution.T)
    return PoseEstimate(
        Status.CONVERGED if solution.converged else Status.MAX_ITERATIONS,
        "",
        solution.T,
        C,
        initial,
        overlap(x, y, solution.T, settings),
        solution.iterations,
        solution.posterior.data.value,
        {"align": time.perf_counter() - begin},
    )
