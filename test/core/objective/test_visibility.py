# SPDX-License-Identifier: Apache-2.0
"""Visibility: points are compared with the depth of the pixel they fall on; pairing and brightness conclude apart."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from surfaces import K

from garps_core.geometry import project
from garps_core.mixture import Frustum
from garps_core.objective import brightness, compiled, plain
from garps_core.objective.visibility import SAME_SURFACE_RATIO, surface_at

SIZE = (120, 160)
RATIO = 0.1


def on_pixels(pixel, depth):
    """Points (n, 3) m at the given depths on the rays of pixels (n, 2)."""
    pixel = np.asarray(pixel, float)
    rays = np.concatenate([(pixel - K[:2, 2]) / np.diag(K)[:2], np.ones((len(pixel), 1))], axis=1)
    return rays * np.asarray(depth, float)[:, None]


def test_points_are_compared_with_the_depth_of_their_nearest_pixel():
    depth = np.random.default_rng(0).uniform(1, 4, SIZE)
    points = np.random.default_rng(1).uniform((-2, -2, -1), (2, 2, 4), (500, 3))
    pixel, inside, surface = (part.numpy() for part in surface_at(*map(torch.from_numpy, (points, K, depth))))
    ahead = points[:, 2] > 1e-3
    expected = project(K, points)
    np.testing.assert_allclose(pixel[ahead], expected[ahead], rtol=1e-12)
    u, v = np.rint(expected).T
    np.testing.assert_array_equal(inside, ahead & (u >= 0) & (u < SIZE[1]) & (v >= 0) & (v < SIZE[0]))
    assert inside.any() and not inside.all()
    np.testing.assert_array_equal(surface[inside], depth[v[inside].astype(int), u[inside].astype(int)])


SHARES = (0.5, 0.8, 0.9, 1.0, 1.05, 1.13, 1.2)
"""Depth of points, in depths of the surface."""


@pytest.mark.parametrize("backend", [plain, compiled], ids=["plain", "compiled"])
def test_a_component_is_hidden_behind_a_surface_only(backend):
    depth = np.full(SIZE, 2.0)
    points = on_pixels([(80, 60)] * len(SHARES), 2 * np.array(SHARES))
    parts = [torch.from_numpy(part).float() for part in (points, np.eye(3), np.zeros(3), K, depth)]
    assert backend.visible(*parts, RATIO).tolist() == [share < 1 + RATIO for share in SHARES]
    parts[-1][:] = torch.nan
    assert backend.visible(*parts, RATIO).all(), "unknown depth hides nothing"


def test_brightness_is_compared_on_the_same_surface_only():
    view = Frustum(K, np.full(SIZE, 2.0, np.float32), np.zeros(SIZE, np.float32))
    grid = brightness.grid_of(view, 1)
    points = on_pixels([(80, 60)] * len(SHARES), 2 * np.array(SHARES))
    near = [abs(share - 1) < SAME_SURFACE_RATIO for share in SHARES]
    assert np.isfinite(brightness._pixels_of(points, grid)[:, 0]).tolist() == near
    unknown = replace(grid, depth=np.full(SIZE, np.nan, np.float32))
    assert np.isfinite(brightness._pixels_of(points, unknown)).all(), "kept where the depth is unknown"


def test_brightness_leaves_a_margin_at_the_border():
    grid = brightness.grid_of(Frustum(K, np.full(SIZE, 2.0, np.float32), np.zeros(SIZE, np.float32)), 1)
    border = [(0.9, 60), (1.1, 60), (157.9, 60), (158.1, 60), (80, 0.9), (80, 1.1), (80, 117.9), (80, 118.1)]
    got = np.isfinite(brightness._pixels_of(on_pixels(border, [2.0] * 8), grid)[:, 0])
    assert got.tolist() == [False, True, True, False] * 2
