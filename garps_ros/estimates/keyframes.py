# SPDX-License-Identifier: Apache-2.0
"""Keyframe tracking of one camera: the rule for new keyframes, and the chaining of poses and covariances."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np

from garps_core.checks import Float64Array
from garps_core.errors import ReconstructionError
from garps_core.geometry import skew, so3_log
from garps_core.types import PoseEstimate, View
from garps_ros.parameters.settings import NodeSettings

Estimate = Callable[[View, View], PoseEstimate]
"""A function (source, target) -> pose of the source camera in the target camera."""
MIN_DEPTH_SHARE = 0.02
"""Smallest share of pixels with depth for a view to begin a segment; a covered lens has less than a sparse sensor."""


@dataclass(frozen=True)
class KeyframeRule:
    """Limits beyond which a new keyframe is taken.

    Args:
        min_overlap: new keyframe when the overlap (0..1) falls below.
        max_motion_m: new keyframe beyond this distance, m.
        max_rotation_rad: new keyframe beyond this rotation, rad.
        lost_after: usable views in a row without a pose after which a new segment begins.
        min_depth_share: a view with depth at a smaller share of its pixels begins no segment.
    """

    min_overlap: float = NodeSettings.keyframe_overlap
    max_motion_m: float = NodeSettings.keyframe_motion
    max_rotation_rad: float = math.radians(NodeSettings.keyframe_rotation)
    lost_after: int = NodeSettings.keyframe_lost_after
    min_depth_share: float = MIN_DEPTH_SHARE


@dataclass(frozen=True, eq=False)
class Attempt:
    """One estimate of a view against `target`.

    `T_start_source` (4x4) and `covariance` (6x6, ROS meaning) place the camera in the frame of its segment's first
    keyframe; both are None when the estimate is not `ok`.
    """

    target: View
    estimate: PoseEstimate
    T_start_source: Float64Array | None = None
    covariance: Float64Array | None = None


@dataclass(frozen=True, eq=False)
class _Located:
    """A view with its camera's pose in the first keyframe of the segment; covariance None = it is that keyframe."""

    view: View
    T: Float64Array
    covariance: Float64Array | None


class KeyframeTracker:
    """Follows one camera; a view that fails against the keyframe is tried against the last good view.

    Args:
        estimate: (source, target) -> PoseEstimate of the source camera in the target camera's frame.
        rule: when to take a new keyframe.
        segment: the last one of an earlier tracker, to count on from.
    """

    def __init__(self, estimate: Estimate, rule: KeyframeRule, segment: int = 0) -> None:
        self._estimate, self.rule = estimate, rule
        self._keyframe: _Located | None = None
        self._last: _Located | None = None
        self._failures = 0
        self._was_blank = False
        """The last view had too little depth to begin a segment."""
        self.segment = segment
        """Number of the segment, from 1; poses of different segments are not related to each other."""
        self.keyframes = 0

    @property
    def keyframe_stamp_ns(self) -> int:
        """Stamp of the present keyframe, ns; 0 before the first."""
        return 0 if self._keyframe is None else self._keyframe.view.stamp_ns

    def begins(self, view: View) -> bool:
        """Make the view the origin of a new segment if one is due: at the start, or when lost for too long.

        A view without enough depth begins none; while there is a keyframe, `follow` tries it all the same.

        Raises:
            ReconstructionError: the first segment is due, and the view has too little depth for its keyframe.
        """
        share = _depth_share(view)
        if self._keyframe is None and share < self.rule.min_depth_share:
            raise ReconstructionError(
                f"the view has depth at {share:.1%} of its pixels: expected at least {self.rule.min_depth_share:.0%} "
                "to begin a trajectory. Uncover the camera, or check the depth topic"
            )
        # A covered lens may be uncovered by now: after a blank view the keyframe gets one more try.
        patience = self.rule.lost_after + self._was_blank
        if self._keyframe is not None and (self._failures < patience or share < self.rule.min_depth_share):
            return False
        self.segment += 1
        self._failures = 0
        self._last = _Located(view, np.eye(4), None)
        self._take(self._last)
        return True

    def follow(self, view: View) -> Iterator[Attempt]:
        """Estimate the view against the keyframe and, where that fails, against the last good view.

        Raises what the estimator raises; the view then counts as one without a pose. A view without enough depth to
        begin a segment does not count.
        """
        self._was_blank = _depth_share(view) < self.rule.min_depth_share
        self._failures += not self._was_blank
        for reference in self._references():
            estimate = self._estimate(view, reference.view)
            if not estimate.ok or estimate.T_target_source is None or estimate.covariance is None:
                yield Attempt(reference.view, estimate)
                continue
            self._failures = 0
            relative = estimate.T_target_source
            covariance = composed_covariance(reference.T, reference.covariance, relative, estimate.covariance)
            self._last = _Located(view, reference.T @ relative, covariance)
            if self._is_far(relative, estimate.overlap):
                self._take(self._last)
            elif reference is not self._keyframe:
                self._take(reference)
            yield Attempt(reference.view, estimate, self._last.T, covariance)
            return

    def _take(self, located: _Located) -> None:
        self._keyframe = located
        self.keyframes += 1

    def _references(self) -> list[_Located]:
        candidates = [self._keyframe] if self._keyframe is self._last else [self._keyframe, self._last]
        return [located for located in candidates if located is not None]

    def _is_far(self, T: Float64Array, overlap: float) -> bool:
        return (
            overlap < self.rule.min_overlap
            or float(np.linalg.norm(T[:3, 3])) > self.rule.max_motion_m
            or float(np.linalg.norm(so3_log(T[:3, :3]))) > self.rule.max_rotation_rad
        )


def _depth_share(view: View) -> float:
    return 0.0 if view.depth is None else float(np.isfinite(view.depth).mean())


def composed_covariance(
    T_ab: Float64Array, covariance_ab: Float64Array | None, T_bc: Float64Array, covariance_bc: Float64Array
) -> Float64Array:
    """Return the 6x6 covariance of T_ab @ T_bc (ROS meaning) for independent errors; covariance_ab None = T_ab exact.

    With p_ac = R_ab p_bc + p_ab, a small rotation w of T_ab moves p_ac by w x (R_ab p_bc).
    """
    R = np.kron(np.eye(2), T_ab[:3, :3])
    total = R @ covariance_bc @ R.T
    if covariance_ab is not None:
        J = np.eye(6)
        J[:3, 3:] = -skew(T_ab[:3, :3] @ T_bc[:3, 3])
        total = total + J @ covariance_ab @ J.T
    return np.asarray(0.5 * (total + total.T))
