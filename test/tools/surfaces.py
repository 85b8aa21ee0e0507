# SPDX-License-Identifier: Apache-2.0
"""A wavy, coloured surface that two pinhole cameras look at: exact depth, exact relative pose, no files."""

from __future__ import annotations

from dataclasses import replace
from functools import lru_cache

import numpy as np
import pytest
import torch

from garps_core import Config, Mixture, Prior, View
from garps_core.geometry import pixel_rays, ros_from_twist, se3_exp, se3_inverse, transform
from garps_core.mixtures.reconstruct import reconstruct

torch.set_num_threads(1)  # threads that wait for each other on a shared machine cost more than they bring

SIZE = (120, 160)
K = np.array([[140.0, 0, 79.5], [0, 140.0, 59.5], [0, 0, 1]])
HALF = {"camera": np.diag([0.5, 0.5, 1]) @ K, "size": (60, 80)}
TRUTH = se3_exp(np.array([0.15, -0.05, 0.08, 0.03, 0.08, -0.02]))
DISTURBANCE = np.array([0.06, -0.05, 0.06, 0.010, -0.012, 0.008])  # 0.1 m and 1 degree
FREE = np.diag([0.1**2] * 3 + [np.radians(1.5) ** 2] * 3)


def height(x, y):
    """Distance (m) of the surface from the world's plane z = 0."""
    return 2.5 + 0.15 * np.sin(2.1 * x + 0.3) * np.cos(1.7 * y) + 0.1 * np.sin(3.3 * y + 1.1 * x) + 0.05 * np.cos(6 * x)


def flat(x, y):
    """A wall 2.5 m away."""
    return 2.5 + 0 * x


def colours_at(x, y):
    """Smooth colours 0..1 of the surface."""
    waves = [np.sin(5 * x + 2 * y), np.sin(7 * y - 3 * x + 1), np.sin(4 * x + 6 * y)]
    return 0.5 + 0.45 * np.stack(waves, axis=-1)


def grey_at(x, y):
    """No texture at all."""
    return np.full((*x.shape, 3), 0.5)


def look(T_world_camera=None, surface=height, colours=colours_at, camera=K, size=SIZE):
    """View of the surface; Newton's method along every ray."""
    T = np.eye(4) if T_world_camera is None else T_world_camera
    v, u = np.mgrid[: size[0], : size[1]].astype(float)
    rays = pixel_rays(camera, u, v)
    z = np.full(size, 2.5)
    for _ in range(30):
        p, q = transform(T, rays * z[..., None]), transform(T, rays * (z + 1e-6)[..., None])
        gap, there = p[..., 2] - surface(p[..., 0], p[..., 1]), q[..., 2] - surface(q[..., 0], q[..., 1])
        z = z - gap * 1e-6 / (there - gap)
    p = transform(T, rays * z[..., None])
    rgb = np.rint(255 * colours(p[..., 0], p[..., 1])).astype(np.uint8)
    return View(rgb, camera, z.astype(np.float32))


def two_views(truth=TRUTH, **scene):
    """Source and target view; the target's camera is the world's, the source's stands at `truth`."""
    return look(truth, **scene), look(**scene)


def two_mixtures(truth=TRUTH, frustum=True, config=None, dtype=np.float32, **scene):
    """Lifted source and target."""
    pair = [reconstruct(view, config or Config()) for view in two_views(truth, **scene)]
    parts = ("means", "covariances", "weights", "colours")
    pair = [replace(m, **{name: getattr(m, name).astype(dtype) for name in parts}) for m in pair]
    return tuple(m if frustum else replace(m, frustum=None) for m in pair)


def disturbed(truth=TRUTH, twist=DISTURBANCE, covariance=FREE):
    """Prior that is off by `twist`; `covariance` is that of the twist."""
    T = se3_exp(np.asarray(twist)) @ truth
    return Prior(T, ros_from_twist(np.asarray(covariance), T))


def moved(mixture: Mixture, T) -> Mixture:
    """The mixture in another frame, without a camera."""
    R = T[:3, :3]
    covariances = R @ mixture.covariances.astype(float) @ R.T
    return replace(mixture, means=transform(T, mixture.means.astype(float)), covariances=covariances, frustum=None)


def permuted(mixture: Mixture, seed: int) -> Mixture:
    """The same components in another order."""
    return mixture.subset(np.random.default_rng(seed).permutation(len(mixture)))


def random_mixture(seed: int, count: int, labels: bool = True) -> Mixture:
    """Components scattered 2 to 4 m in front of the camera, covariances of every shape."""
    rng = np.random.default_rng(seed)
    A = rng.normal(size=(count, 3, 3)) * 0.15
    return Mixture(
        rng.uniform((-1, -1, 2), (1, 1, 4), (count, 3)),
        A @ A.transpose(0, 2, 1) + 0.01 * np.eye(3),
        rng.uniform(0.2, 1.0, count),
        rng.uniform(0, 1, (count, 3)),
        rng.integers(0, 3, count) if labels else None,
    )


def random_pose(seed: int, size: float = 0.3):
    """A rigid motion with a twist of about `size` m and rad."""
    return se3_exp(np.random.default_rng([seed, 1]).normal(size=6) * size)


def off(a, b):
    """Distance (m) and angle (rad) between two poses."""
    D = a @ se3_inverse(b)
    angle = np.arcsin(min(1.0, np.linalg.norm(D[:3, :3] - D[:3, :3].T) / np.sqrt(8)))
    return float(np.linalg.norm(a[:3, 3] - b[:3, 3])), float(angle)


@lru_cache(maxsize=8)
def room(seed, level, depth_noise="none"):
    """Source view, target view and true pose in a rendered room; the test is skipped where nothing can render."""
    pytest.importorskip("embreex")
    made = pytest.importorskip("bench.rooms").make_pair(seed, level, width=320, height=240, depth_noise=depth_noise)
    return View(made.rgb0, made.K0, made.depth0), View(made.rgb1, made.K1, made.depth1), made.T_1_0
