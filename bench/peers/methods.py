# SPDX-License-Identifier: Apache-2.0
"""Other people's ways to the same pose, each behind one signature.

`method(source, target, T_start) -> Result`: two RGB-D views and a 4x4 start pose (or None) to a 4x4 pose or the reason
why there is none. A method never raises on data. Every call starts from the images, so its wall time is honest. Those
that work on clouds share one kind of clouds, those that work on matches the same matches; COLMAP makes its own. Each
peer got the settings that served it best on the recorded RGB-D pairs, but `colmap` and `cpd`, which have the
usual ones.
"""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import NamedTuple

import cv2
import numpy as np

from bench.peers import registration
from bench.peers.colmap import colmap, colmap_relaxed
from bench.peers.cpd import cpd
from bench.peers.features_pnp import Failure, features_pnp, features_pnp_oneway
from bench.peers.five_point import five_point
from bench.peers.odometry import rgbd_hybrid, rgbd_intensity
from bench.peers.two_view_networks import dust3r, mast3r
from garps_core import GarpsError
from garps_core.checks import Float64Array
from garps_core.types import View


class Result(NamedTuple):
    """A 4x4 T_target_source, or None and the reason."""

    T: Float64Array | None
    reason: str = ""


Method = Callable[[View, View, Float64Array | None], Result]
NO_ANSWER = (Failure, GarpsError, RuntimeError, ValueError, np.linalg.LinAlgError, cv2.error, ModuleNotFoundError)
"""Exceptions of methods on pairs that they can do nothing with, or where their library is not installed."""
FROM_A_START: dict[str, Callable[[View, View, Float64Array], Float64Array]] = {
    "open3d-gicp": registration.open3d_gicp,
    "open3d-colored": registration.open3d_colored,
    "open3d-colored-fast": registration.open3d_colored_fast,
    "open3d-plane": registration.open3d_plane,
    "icp": registration.icp,
    "small-gicp": registration.small_gicp,
    "cpd": cpd,
    "rgbd-hybrid": rgbd_hybrid,
    "rgbd-intensity": rgbd_intensity,
}
FROM_NOTHING: dict[str, Callable[[View, View], Float64Array]] = {
    "sift-pnp": features_pnp,
    "sift-pnp-oneway": features_pnp_oneway,
    "sift-pnp+small-gicp": registration.sift_pnp_small_gicp,
    "five-point": five_point,
    "colmap": colmap,
    "colmap-relaxed": colmap_relaxed,
    "kiss-matcher+gicp": registration.kiss_matcher_gicp,
    "mast3r": mast3r,
    "dust3r": dust3r,
}
"""These ignore the start."""


def _method(run: Callable[..., Float64Array], needs_start: bool) -> Method:
    """`run` as a method: whatever it raises of `NO_ANSWER` becomes the reason."""

    @functools.wraps(run)
    def method(source: View, target: View, T_start: Float64Array | None = None) -> Result:
        if needs_start and T_start is None:
            return Result(None, "no start pose")
        try:
            T = run(source, target, T_start) if needs_start else run(source, target)
        except NO_ANSWER as error:
            return Result(None, str(error).strip().splitlines()[-1] if str(error) else type(error).__name__)
        return Result(T) if np.isfinite(T).all() else Result(None, "pose is not finite")

    return method


NEED_NO_START = tuple(FROM_NOTHING)
METHODS: dict[str, Method] = {
    name: _method(run, name in FROM_A_START) for name, run in (FROM_A_START | FROM_NOTHING).items()
}
NONDETERMINISTIC: frozenset[str] = frozenset()
"""Methods whose poses of two calls may differ in a bit: none. Libraries that start threads have to do with one."""
