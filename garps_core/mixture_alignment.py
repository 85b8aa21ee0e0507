# SPDX-License-Identifier: Apache-2.0
"""Two mixtures and start poses -> the pose estimate: maximise the objective, refine by brightness, judge."""

from __future__ import annotations

import os
import threading
import time
from concurrent.futures import ThreadPoolExecutor
from contextlib import ContextDecorator

import numpy as np
import torch

from garps_core.config import Alignment, Config
from garps_core.depth_errors import DEPTH_MODES, error_sigmas
from garps_core.errors import InputError
from garps_core.geometry import Array, ros_from_twist, twist_from_ros
from garps_core.objective.brightness import fit_brightness
from garps_core.objective.pairs import overlap, to_device
from garps_core.objective.state import WeightedStart
from garps_core.solver.ladder import MIN_ROWS, Solution
from garps_core.solver.methods import METHODS
from garps_core.solver.problem import Problem
from garps_core.start.identity_start import identity
from garps_core.types import Mixture, PoseEstimate, Prior, Status
from garps_core.verdict.candidate import Candidate, best_candidate
from garps_core.verdict.covariance import inflated, pose_covariance, share_of_start
from garps_core.verdict.status import quality, relative_uncertainty, verdict

SEARCHED_SIGMAS = 3.0
"""A search may stop in a neighbouring optimum, so its sigmas are multiplied by this."""


def best_alignment(source: Mixture, target: Mixture, starts: tuple[Prior, ...], config: Config) -> PoseEstimate:
    """Return the best estimate from several start poses. Where features led nowhere, identity is searched around, too.

    Args:
        source, target: mixtures, as `reconstruct` makes them.
        starts: at least one start pose, as `initialise` gives them.
        config: settings, as for `align_mixtures`.
    """
    best = max((align_mixtures(source, target, start, config) for start in starts), key=_preference)
    may_search = config.start.method == "auto" and config.start.identity_fallback
    if not best.ok and may_search and starts[0].origin == "features":
        reason = f"from features: {best.status.value}, {best.reason}"
        other = align_mixtures(source, target, identity(config, reason), config)
        if not other.agreement < best.agreement:  # content with its own optimum is not enough
            best = max(best, other, key=_preference)
    return best


def _preference(estimate: PoseEstimate) -> tuple[bool, bool, float]:
    """Order estimates: first those with a pose to use, then those with any pose, then by quality."""
    return estimate.ok, estimate.T_target_source is not None, estimate.quality


def align_mixtures(source: Mixture, target: Mixture, initial: Prior, config: Config | None = None) -> PoseEstimate:
    """Align two mixtures from a start pose, which counts as a measurement with its covariance.

    Args:
        source, target: mixtures, each in its own camera's frame. A frustum, when present, is used to leave out what
            the other camera cannot see.
        initial: the start pose, T_target_source and its covariance.
        config: `config.alignment`, `device` and `dtype` are used; the default preset when None.
    Returns:
        PoseEstimate; `objective` is the mean of the two-way "log" objective, or the paper's log f.
    Raises:
        InputError: a mixture has fewer than 50 components.
        ConfigError: the device is not there.
    """
    config, begin = config or Config(), time.perf_counter()
    for name, mixture in (("source", source), ("target", target)):
        if len(mixture) < MIN_ROWS:
            raise InputError(
                f"{name} has {len(mixture)} components: expected at least {MIN_ROWS}. Use a smaller stride"
            )
    estimate = _aligned(source, target, initial, config)
    estimate.seconds["align"] = time.perf_counter() - begin
    return estimate


class _OneThread(ContextDecorator):
    """Keeps torch to the calling thread, for as long as any caller is inside.

    Helper threads of torch gain nothing on planes that fit the cache. On a busy machine their busy-waiting makes every
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

    @classmethod
    def forget_threads(cls) -> None:
        """Begin anew in a forked child: callers inside the parent, one of which may hold the lock, are not in it."""
        cls._lock, inside, cls._inside = threading.Lock(), cls._inside, 0
        if inside:
            torch.set_num_threads(cls._before)


os.register_at_fork(after_in_child=_OneThread.forget_threads)


@_OneThread()
def _aligned(source: Mixture, target: Mixture, start: Prior, config: Config) -> PoseEstimate:
    settings, weighted = config.alignment, weighted_start(start, config)
    guess = relative_uncertainty(source, weighted.T, start.covariance) > settings.guess_uncertainty
    with ThreadPoolExecutor(1) as pool:
        problem = Problem(to_device(source, config), to_device(target, config), weighted, config, pool, guess)
        candidates = (_candidate(solution, problem) for solution in METHODS[config.method](problem))
        best = best_candidate(candidates, settings)
    if best is None:
        return _low_overlap(overlap(problem.source, problem.target, weighted.T, settings), start, settings)
    if best.overlap < settings.min_overlap:
        return _low_overlap(best.overlap, start, settings)
    uncertainty = relative_uncertainty(source, best.T, best.covariance)
    status, reason = verdict(best, start, guess, uncertainty, settings)
    return PoseEstimate(
        status,
        reason,
        best.T,
        best.covariance,
        start,
        best.overlap,
        best.solution.iterations,
        best.solution.data.value,
        quality(best, guess),
        float("nan") if best.brightness is None else best.merit,
    )


def _low_overlap(shared: float, start: Prior, settings: Alignment) -> PoseEstimate:
    reason = f"the views share {shared:.0%} of their components, expected at least {settings.min_overlap:.0%}"
    if shared >= settings.min_overlap:  # then the solver gave up
        reason = f"fewer than {MIN_ROWS} components were left that both views see, of {shared:.0%} they share"
    return PoseEstimate(Status.LOW_OVERLAP, reason, initial=start, overlap=shared)


def weighted_start(start: Prior, config: Config) -> WeightedStart:
    """Return the start pose as a measurement and, where they are solved for, the usual size of depth errors."""
    precision = np.linalg.inv(twist_from_ros(start.covariance, start.T_target_source))
    of_errors = np.zeros(0)
    if config.solves_depth_errors:
        of_errors = np.tile(1 / np.maximum(error_sigmas(config.lifting)[:DEPTH_MODES], 1e-6) ** 2, 2)
    return WeightedStart(start.T_target_source, np.asarray(precision, np.float64), of_errors)


def _candidate(solution: Solution, problem: Problem) -> Candidate:
    """Give a solution its covariance, and refine it by brightness where the mixtures come with any."""
    config, settings, T = problem.config, problem.config.alignment, solution.T
    covariance, kept, fit = pose_covariance(solution, problem.start, config.lifting), np.eye(6), None
    x, y = problem.source, problem.target
    if x.frustum is not None and y.frustum is not None:
        prior = twist_from_ros(covariance, T) * (SEARCHED_SIGMAS**2 if problem.guess else 1.0)
        measurements, sigmas = settings.brightness_measurements, error_sigmas(config.lifting)
        fit = fit_brightness(x.frustum, y.frustum, T, prior, measurements, sigmas)
    if fit is not None and settings.brightness_measurements > 0:
        T, covariance, kept = fit.T, ros_from_twist(fit.covariance, fit.T), fit.kept
    if config.lifting.sigma_inflation > 1:
        of_start = ros_from_twist(kept @ share_of_start(solution, problem.start) @ kept.T, T)
        covariance = inflated(covariance, of_start, config.lifting.sigma_inflation)
    return Candidate(solution, T, _with_common_scale(covariance, T, config), overlap(x, y, T, settings), fit)


def _with_common_scale(covariance: Array, T: Array, config: Config) -> Array:
    """Add an error of scale that both depth maps and the start share, so that nothing in the pair can show it."""
    sigma = config.lifting.common_scale_sigma
    if config.reconstruction.method == "two_view":
        sigma = float(np.hypot(sigma, config.start.network_scale_sigma))
    if sigma == 0:
        return covariance
    along = np.concatenate([T[:3, 3], np.zeros(3)])
    return np.asarray(covariance + sigma**2 * np.outer(along, along))
