# SPDX-License-Identifier: Apache-2.0
"""Coherent Point Drift, rigid and without scale, of cpd-pytorch: the maintained package that can leave the scale out.

pycpd 2.0.0 has no such option, it swallows `scale=False`. cpd-pytorch 1.0.0 has, but goes on computing the variance by
the formula that holds for the best scale only, as probreg does; here it is the formula of the article.
"""

from __future__ import annotations

import numpy as np

from bench.registration import cloud, open3d
from garps_core.checks import Float64Array
from garps_core.geometry import transform
from garps_core.types import View

OUTLIERS = 0.1
"""The usual share w of the uniform part. With 0.6, more than half of which is what two views do not share, the error on
rooms with true depth is a fifth."""
POINTS = 1000
ITERATIONS = 200
"""Nearly all pairs are at rest after 120."""
VOXEL_M = 0.02


def cpd(source: View, target: View, T_start: Float64Array) -> Float64Array:
    """Rigid Coherent Point Drift of cpd-pytorch, on at most `POINTS` points of each cloud."""
    import torch
    from cpd_pytorch import RigidRegistration

    class Rigid(RigidRegistration):  # type: ignore[misc]
        """Of scale 1, with the variance that belongs to it."""

        def update_variance(self) -> None:
            """The mean squared distance, per axis, and the change of the objective."""
            squares = self._xPx - 2 * self._trAR + self._YPY
            before = self.q
            self.q = squares / (2 * self._sigma2) + self.D * self.Np / 2 * torch.log(self._sigma2)
            self.diff = (self.q - before).abs()
            self._set_sigma2(squares / (self.Np * self.D))

    x, y = (_thinned(cloud(view)[0]) for view in (target, source))
    _, (_, R, t) = Rigid(x, transform(T_start, y), scale=False, w=OUTLIERS, max_iterations=ITERATIONS).register()
    step = np.eye(4)
    step[:3, :3], step[:3, 3] = R.T, t  # it multiplies rows
    return step @ T_start


def _thinned(points: Float64Array) -> Float64Array:
    """At most `POINTS` points, spread evenly: means of ever larger voxels."""
    part, voxel = open3d().geometry.PointCloud(), VOXEL_M
    part.points = open3d().utility.Vector3dVector(points)
    while len(part.points) > POINTS:
        part, voxel = part.voxel_down_sample(voxel), 1.1 * voxel
    return np.asarray(part.points)
