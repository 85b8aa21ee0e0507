# SPDX-License-Identifier: Apache-2.0
"""Coherent Point Drift, rigid and without scale, of cpd-pytorch: the maintained package that can leave the scale out.

pycpd 2.0.0 cannot: it takes `scale=False` and estimates one. cpd-pytorch 1.0.0 can, but goes on computing the variance
by the formula that holds for the best scale only, as probreg does; here it is the mean squared distance that is meant.
"""

from __future__ import annotations

import functools
from typing import Any

import numpy as np
import torch

from bench.peers.registration import cloud, open3d
from garps_core.checks import Float64Array
from garps_core.geometry import transform
from garps_core.types import View

OUTLIERS = 0.1
"""The usual share w of the uniform part. With 0.6, nearer to what two views do not share, errors on rooms with true
depth are a fifth; on monocular depth they stay as large."""
POINTS = 1000
ITERATIONS = 200
"""Most pairs are at rest after 100."""
VOXEL_M = 0.02


def cpd(source: View, target: View, T_start: Float64Array) -> Float64Array:
    """Rigid Coherent Point Drift of cpd-pytorch, on at most `POINTS` points of each cloud."""
    x, y = (_thinned(cloud(view)[0]) for view in (target, source))
    threads = torch.get_num_threads()
    torch.set_num_threads(1)  # more wait for each other: the matrices are small
    try:
        drift = _registration()(x, transform(T_start, y), scale=False, w=OUTLIERS, max_iterations=ITERATIONS)
        _, (_, R, t) = drift.register()
    finally:
        torch.set_num_threads(threads)
    step = np.eye(4)
    step[:3, :3], step[:3, 3] = R.T, t  # the library multiplies rows
    return step @ T_start


def _thinned(points: Float64Array) -> Float64Array:
    """At most `POINTS` points, spread evenly: means of ever larger voxels."""
    o3d, voxel = open3d(), VOXEL_M
    part = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(points))
    while len(part.points) > POINTS:
        part, voxel = part.voxel_down_sample(voxel), 1.1 * voxel
    return np.asarray(part.points)


@functools.cache
def _registration() -> Any:
    """The class of the library, with the variance that belongs to a scale of 1."""
    from cpd_pytorch import RigidRegistration

    class Rigid(RigidRegistration):  # type: ignore[misc]
        def update_variance(self) -> None:
            squares = self._xPx - 2 * self._trAR + self._YPY
            before = self.q
            self.q = squares / (2 * self._sigma2) + self.D * self.Np / 2 * torch.log(self._sigma2)
            self.diff = (self.q - before).abs()
            self._set_sigma2(squares / (self.Np * self.D))

    return Rigid
