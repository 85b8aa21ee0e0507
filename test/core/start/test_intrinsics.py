# SPDX-License-Identifier: Apache-2.0
"""Cameras nobody has calibrated: focal lengths from point maps."""

import numpy as np
import pytest
from point_map_cases import Errors, point_maps, true_views

from bench.rooms import make_pair
from garps_core import View
from garps_core.errors import InitialisationError
from garps_core.start.intrinsics import focal_length, intrinsics_of


def centred(view):
    """With the principal point in the middle and square pixels, which is what is assumed of an unknown camera."""
    height, width = view.rgb.shape[:2]
    fx = view.K[0, 0]
    return View(view.rgb, np.array([[fx, 0, (width - 1) / 2], [0, fx, (height - 1) / 2], [0, 0, 1]]), view.depth)


@pytest.mark.parametrize("size", [(320, 240), (240, 320)])
@pytest.mark.parametrize(("noise", "within"), [(0.0, 1e-5), (0.02, 0.02)])
def test_the_focal_length_is_found(size, noise, within):
    pair = make_pair(3, 2, 1.0, *size)
    views = tuple(centred(view) for view in true_views(pair))
    maps = point_maps(views, pair.T_1_0, Errors(noise=noise))
    for view, K in zip(views, intrinsics_of(maps, (size[::-1], size[::-1])), strict=True):
        assert pytest.approx(view.K[0, 0], rel=within) == K[0, 0] == K[1, 1]
        assert pytest.approx(view.K[:2, 2]) == K[:2, 2]


def test_a_tenth_of_wild_points_hardly_moves_it():
    rng = np.random.default_rng(0)
    slopes = rng.uniform(-0.6, 0.6, (5000, 2))
    px = 500 * slopes + rng.normal(0, 0.5, slopes.shape)
    px[:500] = rng.uniform(-300, 300, (500, 2))
    assert focal_length(px, slopes) == pytest.approx(500, rel=2e-3)
    squares = (px * slopes).sum() / (slopes**2).sum()
    assert abs(squares - 500) > 10, "least squares would not do"


def test_points_behind_the_camera_tell_nothing():
    pair = make_pair(3, 2, 1.0, 320, 240)
    views = true_views(pair)
    maps = point_maps(views, pair.T_1_0)
    maps.source_first[0].points[..., 2] *= -1
    with pytest.raises(InitialisationError, match="0 trusted points lie in front of their camera"):
        intrinsics_of(maps, ((240, 320), (240, 320)))


def test_pixels_the_network_does_not_trust_are_left_out():
    pair = make_pair(3, 2, 1.0, 320, 240)
    views = tuple(centred(view) for view in true_views(pair))
    maps = point_maps(views, pair.T_1_0)
    rng, own = np.random.default_rng(0), maps.source_first[0]
    wild = rng.random(own.confidence.shape) < 0.1
    own.points[wild] = rng.uniform(-3, 3, (int(wild.sum()), 3))
    own.confidence[wild] = maps.target_first[1].confidence[wild] = 1.0
    K, _ = intrinsics_of(maps, ((240, 320), (240, 320)), 3.0)
    assert K[0, 0] == pytest.approx(views[0].K[0, 0], rel=1e-5)
