# SPDX-License-Identifier: Apache-2.0
"""Preparation before the first pair, live and offline: the source of depth, networks loaded, loops compiled."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import replace

import cv2
import numpy as np

from garps_core.align import Estimator
from garps_core.config import Config, Reconstruction, depth_networks
from garps_core.config.combinations import check_settings, check_start
from garps_core.config.lifting import Lifting
from garps_core.config.start import TWO_VIEW, Start, installed_starts
from garps_core.errors import ConfigError
from garps_core.mixtures.reconstruct import with_depth
from garps_core.models.depth_networks import with_weights
from garps_core.models.in_use import Networks
from garps_core.objective import compiled
from garps_core.start.methods import start_method
from garps_core.types import Prior, View
from garps_ros.estimates.keyframes import MIN_DEPTH_SHARE

LONG_S = 2.0
"""Time of compiling beyond which a line is logged, s; reading compiled loops from the cache takes less."""


def methods_without_sensor() -> tuple[str, ...]:
    """Return the methods that ask a network for depth; the others need the sensor's."""
    return *depth_networks(), "flash3d", "two_view"


def needs_depth(config: Config) -> bool:
    """Whether every image needs the sensor's depth; where a network gives it, the sensor's is left alone."""
    return config.reconstruction.method not in methods_without_sensor()


def check_method(config: Config) -> None:
    """Raise ConfigError if `reconstruction.method` takes no images, or settings do not go together."""
    if config.reconstruction.method == "ply":
        raise ConfigError(
            "reconstruction.method is ply, mixtures from files: expected auto, rgbd or a network "
            f"({', '.join(methods_without_sensor())}) for images on topics; `garps align a.ply b.ply` takes files"
        )
    check_start(config.start)
    if not needs_depth(config):
        check_settings(config)


def completed(view: View, config: Config, networks: Networks) -> View:
    """Return a view with the depth that its mixture needs. A two-view network gives none before it sees a pair."""
    return view if config.reconstruction.method == "two_view" else with_depth([view], config, networks)[0]


def depth_share(config: Config) -> float:
    """Share of a view's pixels that must have depth before it sees a pair, for it to begin a trajectory."""
    return 0.0 if config.reconstruction.method == "two_view" else MIN_DEPTH_SHARE


def settings_of_completed(config: Config) -> Config:
    """The settings for views that are `completed` already: a network's depth then counts as given."""
    of_network = config.reconstruction.method in depth_networks()
    return config.replace({"reconstruction.method": "rgbd"} if of_network else {})


def scale_from(config: Config) -> str:
    """Return the source of metres, for people. Raises WeightsError where the settings' weights are not installed."""
    if needs_depth(config):
        return "the depth topics, m"
    from garps_core.weights.store import default  # networks cost nothing where none is used

    settings = config.reconstruction
    if settings.method == "two_view":
        return f"{two_view_name(config)} of every pair, m"
    found = f"{with_weights(settings)}, m"
    if settings.method == "flash3d":
        found = f"flash3d (weights {settings.flash3d_weights or default('flash3d').name}) on {found}"
    return found


def two_view_name(config: Config) -> str:
    """Describe the two-view network of the settings and its weights."""
    from garps_core.weights.store import default

    start = config.start
    if start.method == "adapter":
        return f"adapter {start.adapter}"
    return f"{start.method} (weights {start.weights or default(start.method).name})"


def load_networks(config: Config, say: Callable[[str], None], networks: Networks) -> None:
    """Load the networks that the settings name, if any, into `networks`, and log the time that it took.

    Raises:
        WeightsError: weights that are not installed, or not what they should be.
        ModelError: a network that does not fit the memory.
        ConfigError: the device is not there, or an installed way to start cannot be imported.
    """
    if config.start.method in installed_starts():
        start_method(config.start.method)  # a mistake ends the node now, not with the first pair
    settings, begin, names = config.reconstruction, time.perf_counter(), []
    two_view = config.start.method in TWO_VIEW
    if needs_depth(config) and settings.semantics == "none" and not two_view:
        return
    if two_view:
        names.append(two_view_name(config))
        networks.two_view(config)
    if not needs_depth(config) and settings.method != "two_view":
        names.append(scale_from(config).removesuffix(", m"))
        networks.depth_network(config)
    if settings.method == "flash3d":
        networks.flash3d(config)
    if settings.semantics != "none":
        names.append(f"labels ({settings.semantics})")
        networks.segmenter(config)
    say(f"loaded {' and '.join(names)} in {time.perf_counter() - begin:.1f} s")


def warm_up(config: Config, say: Callable[[str], None]) -> None:
    """Align a tiny pair, so that loops are compiled or read from the cache before the first job.

    With numba the first time on a machine takes 10 to 20 s, the next 0.5 s.
    """
    if not compiled.AVAILABLE:
        return
    begin, view = time.perf_counter(), _corner()
    # Own settings but for what could leave nothing of so small a picture.
    tiny = replace(config, reconstruction=Reconstruction(method="rgbd"), lifting=Lifting(), start=Start())
    Estimator(tiny).estimate(view, view, Prior(np.eye(4), np.eye(6) * 1e-4))
    if (spent := time.perf_counter() - begin) > LONG_S:
        say(f"compiled the innermost loops in {spent:.1f} s; where they can be kept, the next start is quick")


def _corner() -> View:
    """160x120 pixels of two walls and a floor, 2 to 3.3 m away, with a pattern of blots."""
    noise = np.random.default_rng(0).integers(0, 256, (12, 16, 3), dtype=np.uint8)
    rgb = cv2.resize(noise, (160, 120), interpolation=cv2.INTER_CUBIC)
    v, u = np.mgrid[:120, :160]
    depth = (2 + 0.01 * abs(u - 80) + 0.004 * v).astype(np.float32)
    K = np.array([[150.0, 0.0, 79.5], [0.0, 150.0, 59.5], [0.0, 0.0, 1.0]])
    return View(np.asarray(rgb, np.uint8), K, depth)
