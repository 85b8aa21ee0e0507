# SPDX-License-Identifier: Apache-2.0
"""The whole story: two views -> two mixtures -> initial pose -> alignment -> pose with covariance, or why not."""

from __future__ import annotations

import threading
import time
from concurrent.futures import ThreadPoolExecutor
from contextlib import ContextDecorator

import numpy as np
import torch

from garps_core import paper, solve
from garps_core.checks import Float64Array
from garps_core.config import Alignment, Config
from garps_core.errors import InitialisationError, InputError
from garps_core.geometry import se3_inverse, se3_log
from garps_core.initialise import initialise
from garps_core.pairing import checked_device, overlap, to_cloud
from garps_core.reconstruct import reconstruct
from garps_core.solve import MIN_ROWS, Solution, displacement
from garps_core.types import Mixture, PoseEstimate, Prior, Status, View
from garps_core.uncertainty import pose_covariance, twist_from_ros


def estimate_relative_pose(
    source: View, target: View, config: Config | None = None, prior: Prior | None = None
) -> PoseEstimate:
    """Estimate the pose of the source camera in the target camera's frame, in metres, with its covariance.

    Args:
        source, target: two views of the same static scene, with metric depth.
        config: settings; the default preset when None.
        prior: what is known of the pose beforehand, if anything; it enters the estimate with its covariance.
    Returns:
        PoseEstimate; when no pose could be had its status and reason say why and T_target_source is None.
    Raises:
        ReconstructionError: a view holds too little depth.
        ConfigError: the device is not there.
    """
    config = config or Config()
    checked_device(config.device)
    begin = time.perf_counter()
    with ThreadPoolExecutor(2) as pool:
        x, y = pool.map(reconstruct, (source, target), (config, config))
    lifted = time.perf_counter()
    try:
        initial = initialise(source, target, config, prior)
    except InitialisationError as failure:
        return PoseEstimate(Status.NO_INITIAL_POSE, str(failure), seconds={"reconstruct": lifted - begin})
    initialised = time.perf_counter()
    estimate = align_mixtures(x, y, initial, config)
    estimate.seconds.update(reconstruct=lifted - begin, initialise=initialised - lifted)
    return estimate


def align_mixtures(source: Mixture, target: Mixture, initial: Prior, config: Config | None = None) -> PoseEstimate:
    """Align two mixtures from an initial pose, which counts as a measurement with its covariance.

    Args:
        source, target: each in its own camera's frame; a frustum, when present, is used to leave out what the
            other camera cannot see.
        initial: T_target_source and covariance to start from.
        config: `config.alignment`, `device` and `dtype` are used; the default preset when None.
    Returns:
        PoseEstimate; `objective` is the mean of the two-way "log" objective, or the paper's log f.
    Raises:
        InputError: a mixture has fewer than 50 components.
        ConfigError: the device is not there.
    """
    config = config or Config()
    begin = time.perf_counter()
    for name, mixture in (("source", source), ("target", target)):
        if len(mixture) < MIN_ROWS:
            raise InputError(
                f"{name} has {len(mixture)} components: expected at least {MIN_ROWS}; use a smaller stride"
            )
    estimate = _aligned(source, target, initial, config)
    estimate.seconds["align"] = time.perf_counter() - begin
    return estimate


class _OneThread(ContextDecorator):
    """Keep torch to the calling thread, for as long as any caller is inside.

    Its helpers gain nothing on planes that fit the cache, and on a busy machine their busy-waiting makes every
    operation many times slower. The number of threads is torch's own, one for the process: the first caller in notes
    it, the last one out restores it.
    """

    _lock, _inside, _before = threading.Lock(), 0, 1

    def __enter__(self) -> None:
        with self._lock:
            if _OneThread._inside == 0:
                _OneThread._before = torch.get_num_threads()
                torch.set_num_threads(1)
            _OneThread._inside += 1

    def __exit__(self, *_: object) -> None:
        with self._lock:
            _OneThread._inside -= 1
            if _OneThread._inside == 0:
                torch.set_num_threads(_OneThread._before)


@_OneThread()
def _aligned(source: Mixture, target: Mixture, initial: Prior, config: Config) -> PoseEstimate:
    x, y = to_cloud(source, config), to_cloud(target, config)
    settings = config.alignment
    T0 = initial.T_target_source
    start_covariance = twist_from_ros(initial.covariance, T0)
    maximise = paper.maximise if settings.solver == "adam" else solve.anneal
    solution = maximise(x, y, T0, start_covariance, settings)
    shared = overlap(x, y, T0 if solution is None else solution.T, settings)
    if solution is None or shared < settings.min_overlap:
        reason = f"the views share {shared:.0%} of their components, expected at least {settings.min_overlap:.0%}"
        if shared >= settings.min_overlap:  # then the solver gave up
            reason = f"fewer than {MIN_ROWS} components were left that both views see, of {shared:.0%} they share"
        return PoseEstimate(Status.LOW_OVERLAP, reason, initial=initial, overlap=shared)
    precision = np.asarray(np.linalg.inv(start_covariance), np.float64)
    covariance = pose_covariance(solution, precision, config.lifting)
    guess = _relative_uncertainty(source, T0, initial.covariance) > settings.guess_uncertainty
    status, reason = _verdict(
        solution,
        initial,
        settings.guess_support if guess else settings.min_support,
        _relative_uncertainty(source, solution.T, covariance),
        settings,
    )
    return PoseEstimate(
        status,
        reason,
        solution.T,
        covariance,
        initial,
        shared,
        solution.iterations,
        solution.data.value,
    )


def _relative_uncertainty(source: Mixture, T: Float64Array, covariance: Float64Array) -> float:
    """Sigma of a typical scene point along its most uncertain direction, as a share of its range in the target."""
    points = source.means[:: max(1, len(source) // 200)].astype(np.float64) @ T[:3, :3].T + T[:3, 3]
    spread = np.linalg.eigvalsh(displacement(points, twist_from_ros(covariance, T)))[:, 2]
    return float(np.median(np.sqrt(spread) / np.linalg.norm(points, axis=1)))


def _verdict(
    solution: Solution, initial: Prior, wanted_support: float, uncertainty: float, settings: Alignment
) -> tuple[Status, str]:
    """Status and reason of a solution, the gravest first."""
    if settings.solver == "adam":
        return Status.CONVERGED, f"the paper's fixed number of steps, {solution.iterations}"
    T0 = initial.T_target_source
    r = se3_log(solution.T @ se3_inverse(T0))
    distance = float(np.sqrt(r @ np.linalg.solve(twist_from_ros(initial.covariance, T0), r)))
    if distance > settings.max_prior_sigmas:
        return (
            Status.INCONSISTENT,
            f"the views pull {distance:.1f} sigmas away from the initial pose ({settings.max_prior_sigmas:g} allowed)",
        )
    support = solution.data.support
    if support < wanted_support:
        return (
            Status.POOR_FIT,
            f"{support:.0%} of the components found a partner, expected {wanted_support:.0%} after this start "
            f"({initial.origin}): possibly a wrong optimum, give a better prior",
        )
    if uncertainty > settings.max_uncertainty:
        return (
            Status.DEGENERATE,
            f"a direction stays open: scene points are uncertain by {uncertainty:.1%} of their range "
            f"({settings.max_uncertainty:.1%} allowed)",
        )
    if not solution.converged:
        return Status.MAX_ITERATIONS, f"still moving after {solution.iterations} steps"
    return Status.CONVERGED, f"converged in {solution.iterations} steps, {distance:.1f} sigmas from the initial pose"
