# SPDX-License-Identifier: Apache-2.0
"""The whole story: two views -> two mixtures -> start poses -> alignment -> pose with covariance, or why not."""

from __future__ import annotations

import time
from dataclasses import dataclass, field, replace

import numpy as np

from garps_core.config import Config
from garps_core.config.combinations import check_settings
from garps_core.devices import checked_device
from garps_core.errors import InitialisationError, MissingDepthError, ModelError, ReconstructionError, WeightsError
from garps_core.mixture_alignment import align_mixtures, best_alignment
from garps_core.mixtures.reconstruct import mixture_of, mixtures_of, with_depth
from garps_core.models.depth_networks import depth_from
from garps_core.models.in_use import Networks
from garps_core.point_maps import PairMaps
from garps_core.start.initialise import initialise
from garps_core.types import Mixture, PoseEstimate, Prior, Status, View

__all__ = ["Estimator", "align_mixtures", "estimate_relative_pose"]

CENTRING = 0.01
"""Sigma of a principal point that is assumed in the middle of the image, as a share of the image's longer side."""

Mixtures = tuple[Mixture, Mixture]

NETWORKS = Networks()
"""Networks that all calls of `estimate_relative_pose` share. An `Estimator` has its own."""


class Estimator:
    """Estimates relative poses with one configuration, and owns the networks that it has loaded.

    Any number of threads may share one. It may be used in a child process after a fork. A pickled copy is its
    configuration; the copy loads its networks anew.

    Args:
        config: settings; the default preset when None.
        networks: networks to share with other estimators; None = its own, loaded when they are first needed.
    """

    def __init__(self, config: Config | None = None, networks: Networks | None = None) -> None:
        self.config = config or Config()
        self.networks = networks or Networks()

    def estimate(self, source: View, target: View, prior: Prior | None = None) -> PoseEstimate:
        """Estimate the pose of the source camera in the target camera's frame, in metres, with its covariance.

        Args:
            source, target: two views of one static scene, with depth unless `config.reconstruction` names a network.
            prior: knowledge of the pose from elsewhere; it enters the estimate with its covariance.
        Returns:
            PoseEstimate. Where no pose could be had, its status and reason say why and T_target_source is None.
        Raises:
            MissingDepthError: a view has no depth, and the settings want a sensor's.
            ConfigError: the device is not there, or settings do not go together.
            WeightsError: the weights of a network are missing, or not the expected ones.
        """
        return self.estimate_with_mixtures(source, target, prior)[0]

    def estimate_with_mixtures(
        self, source: View, target: View, prior: Prior | None = None, maps: PairMaps | None = None
    ) -> tuple[PoseEstimate, Mixtures | None]:
        """Return what `estimate` does, and the two mixtures that were aligned; None where there are none.

        `maps` is the answer of the two-view network about this pair where it has been asked before, e.g. for the
        intrinsics; None = it is asked where the settings need it. Raises what `estimate` does.
        """
        views, origin = (source, target), depth_from((source, target), self.config)
        estimate, mixtures = self._estimate(views, prior, maps)
        fx_source, fx_target = (float(view.K[0, 0]) if view.K_estimated else None for view in views)
        return replace(estimate, estimated_fx_px=(fx_source, fx_target), depth_from=origin), mixtures

    def reconstruct(self, view: View) -> Mixture:
        """Return the mixture of one view in its own camera frame. Raises as `garps_core.reconstruct`."""
        return mixture_of(with_depth([view], self.config, self.networks)[0], self.config, self.networks)

    def _estimate(
        self, views: tuple[View, View], prior: Prior | None, maps: PairMaps | None
    ) -> tuple[PoseEstimate, Mixtures | None]:
        config, networks, stages = self.config, self.networks, _Stages()
        checked_device(config.device)
        try:
            maps = maps or self._maps_for_depth(views)
            with_depths = with_depth(views, config, networks, maps)
            if with_depths != list(views):  # a network has been asked, which takes time
                stages.end("depth")
            config = with_wider_errors(config, *views)
            source, target = mixtures_of(with_depths, config, networks)
            stages.end("reconstruct")
            starts = initialise(with_depths[0], with_depths[1], config, prior, networks, maps)
            stages.end("initialise")
        except InitialisationError as failure:
            stages.end("initialise")
            return PoseEstimate(Status.NO_INITIAL_POSE, str(failure), seconds=stages.seconds), (source, target)
        except (ModelError, ReconstructionError) as failure:
            if isinstance(failure, (WeightsError, MissingDepthError)):
                raise  # a mistake in the settings, not a property of these images
            return PoseEstimate(Status.NO_MIXTURE, str(failure), seconds=stages.seconds), None
        estimate = best_alignment(source, target, starts, config)
        stages.end("align")
        estimate.seconds.update(stages.seconds)
        return estimate, (source, target)

    def _maps_for_depth(self, views: tuple[View, View]) -> PairMaps | None:
        if self.config.reconstruction.method != "two_view":
            return None
        check_settings(self.config)
        return self.networks.pair_maps(views[0].rgb, views[1].rgb, self.config)


@dataclass
class _Stages:
    """Wall time in s of each stage, from the end of the one before."""

    seconds: dict[str, float] = field(default_factory=dict)
    _begin: float = field(default_factory=time.perf_counter)

    def end(self, name: str) -> None:
        """Note that a stage has ended now."""
        now = time.perf_counter()
        self.seconds[name], self._begin = now - self._begin, now


def with_wider_errors(config: Config, *views: View) -> Config:
    """Settings with wider errors of shape and direction where a view's intrinsics are a network's estimate.

    The shape of both depth maps is then solved for.
    """
    off_centre = [CENTRING * max(view.rgb.shape[:2]) / view.K[0, 0] for view in views if view.K_estimated]
    if not off_centre:
        return config
    focal = config.start.focal_sigma
    more = {"scale_sigma": focal, "warp_sigma": focal, "pointing_sigma_rad": max(off_centre)}
    wider = {f"lifting.{name}": float(np.hypot(getattr(config.lifting, name), sigma)) for name, sigma in more.items()}
    return config.replace(wider | {"alignment.depth_errors": True})


def estimate_relative_pose(
    source: View, target: View, config: Config | None = None, prior: Prior | None = None
) -> PoseEstimate:
    """Estimate the pose of the source camera in the target camera's frame, in metres, with its covariance.

    Arguments, answer and errors are those of `Estimator.estimate`; the default preset when `config` is None.
    """
    return Estimator(config, NETWORKS).estimate(source, target, prior)
