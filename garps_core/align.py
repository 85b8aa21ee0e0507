# SPDX-License-Identifier: Apache-2.0
"""The whole story: two views -> two mixtures -> initial pose -> alignment -> pose with covariance, or why not."""

from __future__ import annotations

import threading
import time
from concurrent.futures import ThreadPoolExecutor
from contextlib import ContextDecorator
from dataclasses import replace

import numpy as np
import torch

from garps_core.config import Alignment, Config
from garps_core.depth_errors import DEPTH_MODES, error_sigmas
from garps_core.devices import checked_device
from garps_core.errors import InitialisationError, InputError, ModelError, ReconstructionError, WeightsError
from garps_core.geometry import Array, ros_from_twist, twist_from_ros
from garps_core.mixtures.reconstruct import depth_origin, mixtures_of, with_depth
from garps_core.objective.brightness import fit_brightness
from garps_core.objective.pairs import DeviceMixture, overlap, to_device
from garps_core.objective.state import WeightedStart
from garps_core.solver.ladder import MIN_ROWS, Solution
from garps_core.solver.methods import METHODS
from garps_core.solver.problem import Problem
from garps_core.start.initialise import identity, initialise
from garps_core.types import Mixture, PoseEstimate, Prior, Status, View
from garps_core.verdict.candidate import Candidate, best_candidate
from garps_core.verdict.covariance import inflated, pose_covariance, share_of_start
from garps_core.verdict.status import quality, relative_uncertainty, verdict

SEARCHED_SIGMAS = 3.0
"""What a search found may be a neighbour of the right optimum: its sigmas count so many times as much."""

CENTRING = 0.01
"""Sigma of a principal point that is taken to lie in the image's middle, over the image's longer side."""


def estimate_relative_pose(
    source: View, target: View, config: Config | None = None, prior: Prior | None = None
) -> PoseEstimate:
    """Estimate the pose of the source camera in the target camera's frame, in metres, with its covariance.

    Args:
        source, target: two views of the same static scene; depth, where `config.reconstruction` wants a sensor's.
        config: settings; the default preset when None.
        prior: what is known of the pose beforehand, if anything; it enters the estimate with its covariance.
    Returns:
        PoseEstimate; when no pose could be had its status and reason say why and T_target_source is None.
    Raises:
        ReconstructionError: a view holds too little depth, by itself; of a two-view network's depth the status says so.
        ConfigError: the device is not there, or settings do not go together.
        WeightsError: a network's weights are missing or not what they should be.
    """
    return estimate_with_mixtures(source, target, config, prior)[0]


def estimate_with_mixtures(
    source: View, target: View, config: Config | None = None, prior: Prior | None = None
) -> tuple[PoseEstimate, tuple[Mixture, Mixture] | None]:
    """`estimate_relative_pose`, and the two mixtures it aligned, to be drawn or stored; None where there are none."""
    estimate, mixtures = _estimated(source, target, config or Config(), prior)
    focal = tuple(float(view.K[0, 0]) if view.K_estimated else None for view in (source, target))
    origin = depth_origin((source, target), config or Config())
    return replace(estimate, estimated_fx_px=(focal[0], focal[1]), depth_from=origin), mixtures


def _doubting(config: Config, *views: View) -> Config:
    """With more doubt about both views' shape and direction where intrinsics are estimates; the shape is solved for."""
    middles = [CENTRING * max(view.rgb.shape[:2]) / view.K[0, 0] for view in views if view.K_estimated]
    if not middles:
        return config
    focal = config.start.focal_sigma
    more = {"scale_sigma": focal, "warp_sigma": focal, "pointing_sigma_rad": max(middles)}
    wider = {f"lifting.{name}": float(np.hypot(getattr(config.lifting, name), sigma)) for name, sigma in more.items()}
    return config.replace(wider | {"alignment.depth_errors": True})


def _estimated(
    source: View, target: View, config: Config, prior: Prior | None
) -> tuple[PoseEstimate, tuple[Mixture, Mixture] | None]:
    checked_device(config.device)
    spent, begin = {}, time.perf_counter()
    try:
        views = with_depth((source, target), config)
        if views != [source, target]:  # only a network takes time
            spent["depth"], begin = time.perf_counter() - begin, time.perf_counter()
        config = _doubting(config, *views)
        x, y = mixtures_of(views, config)
    except (ModelError, ReconstructionError) as failure:
        of_pair = config.reconstruction.method == "two_view"
        if isinstance(failure, WeightsError) or (isinstance(failure, ReconstructionError) and not of_pair):
            raise  # a mistake of whoever set this up, not of these images
        return PoseEstimate(Status.NO_MIXTURE, str(failure)), None
    spent["reconstruct"], begin = time.perf_counter() - begin, time.perf_counter()
    try:
        starts = initialise(views[0], views[1], config, prior)
    except InitialisationError as failure:
        spent["initialise"] = time.perf_counter() - begin
        return PoseEstimate(Status.NO_INITIAL_POSE, str(failure), seconds=spent), (x, y)
    spent["initialise"], begin = time.perf_counter() - begin, time.perf_counter()
    estimate = best_of(x, y, starts, config)
    estimate.seconds.update(spent, align=time.perf_counter() - begin)
    return estimate, (x, y)


def best_of(x: Mixture, y: Mixture, starts: tuple[Prior, ...], config: Config) -> PoseEstimate:
    """The best estimate of several initial poses; where features led nowhere, also a search from identity is tried.

    Args:
        x, y: source and target, as `reconstruct` makes them.
        starts: at least one, as `initialise` gives them.
        config: as for `align_mixtures`.
    """
    estimates = [align_mixtures(x, y, start, config) for start in starts]
    best = max(estimates, key=_merit)
    may_search = config.start.method == "auto" and config.start.identity_fallback
    if not best.ok and may_search and starts[0].origin == "features":
        reason = f"from features: {best.status.value}, {best.reason}"
        other = align_mixtures(x, y, identity(config, reason), config)
        if not other.agreement < best.agreement:  # content with its own optimum is not enough
            best = max(best, other, key=_merit)
    return best


def _merit(estimate: PoseEstimate) -> tuple[bool, bool, float]:
    """Order of preference: a pose to use, then any pose, then quality."""
    return estimate.ok, estimate.T_target_source is not None, estimate.quality


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
    x, y = to_device(source, config), to_device(target, config)
    settings = config.alignment
    known = _known(initial, config)
    guess = relative_uncertainty(source, known.T, initial.covariance) > settings.guess_uncertainty
    with ThreadPoolExecutor(1) as pool:
        solutions = METHODS[config.method](Problem(x, y, known, config, pool, guess))
        best = best_candidate((_candidate(end, x, y, known, guess, config) for end in solutions), settings)
    if best is None:
        shared = overlap(x, y, known.T, settings)
        return _too_little(shared, initial, settings)
    if best.overlap < settings.min_overlap:
        return _too_little(best.overlap, initial, settings)
    uncertainty = relative_uncertainty(source, best.T, best.covariance)
    status, reason = verdict(best, initial, guess, uncertainty, settings)
    return PoseEstimate(
        status,
        reason,
        best.T,
        best.covariance,
        initial,
        best.overlap,
        best.solution.iterations,
        best.solution.data.value,
        quality(best, guess),
        float("nan") if best.brightness is None else best.merit,
    )


def _too_little(shared: float, initial: Prior, settings: Alignment) -> PoseEstimate:
    reason = f"the views share {shared:.0%} of their components, expected at least {settings.min_overlap:.0%}"
    if shared >= settings.min_overlap:  # then the solver gave up
        reason = f"fewer than {MIN_ROWS} components were left that both views see, of {shared:.0%} they share"
    return PoseEstimate(Status.LOW_OVERLAP, reason, initial=initial, overlap=shared)


def _known(initial: Prior, config: Config) -> WeightedStart:
    """The initial pose as a measurement, and where they are solved for, what depth maps usually get wrong."""
    precision = np.linalg.inv(twist_from_ros(initial.covariance, initial.T_target_source))
    of_errors = np.zeros(0)
    if config.solves_depth_errors:
        of_errors = np.tile(1 / np.maximum(error_sigmas(config.lifting)[:DEPTH_MODES], 1e-6) ** 2, 2)
    return WeightedStart(initial.T_target_source, np.asarray(precision, np.float64), of_errors)


def _of_one_scale(covariance: Array, T: Array, sigma: float) -> Array:
    """With an error of scale that both depth maps and the start share, so that nothing in the pair can show it."""
    along = np.concatenate([T[:3, 3], np.zeros(3)])
    return np.asarray(covariance + sigma**2 * np.outer(along, along))


def _candidate(
    solution: Solution, x: DeviceMixture, y: DeviceMixture, known: WeightedStart, guess: bool, config: Config
) -> Candidate:
    """A solution with its covariance, refined by brightness where the mixtures come with any."""
    settings, T = config.alignment, solution.T
    covariance, kept, seen = pose_covariance(solution, known, config.lifting), np.eye(6), None
    if x.frustum is not None and y.frustum is not None:
        prior = twist_from_ros(covariance, T) * (SEARCHED_SIGMAS**2 if guess else 1.0)
        seen = fit_brightness(
            x.frustum, y.frustum, T, prior, settings.brightness_measurements, error_sigmas(config.lifting)
        )
    if seen is not None and settings.brightness_measurements > 0:
        T, covariance, kept = seen.T, ros_from_twist(seen.covariance, seen.T), seen.kept
    if config.lifting.sigma_inflation > 1:
        of_known = ros_from_twist(kept @ share_of_start(solution, known) @ kept.T, T)
        covariance = inflated(covariance, of_known, config.lifting.sigma_inflation)
    common = config.lifting.common_scale_sigma
    if config.reconstruction.method == "two_view":
        common = config.start.network_scale_sigma
    if common > 0:
        covariance = _of_one_scale(covariance, T, common)
    return Candidate(solution, T, covariance, overlap(x, y, T, settings), seen)
