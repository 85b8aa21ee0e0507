# SPDX-License-Identifier: Apache-2.0
"""Dense descriptors: matches that are each other's nearest, and the pose from them."""

from dataclasses import replace

import numpy as np
import pytest
from point_map_cases import point_maps, true_views

from bench.rooms import make_pair
from garps_core import Config
from garps_core.errors import InitialisationError
from garps_core.geometry import se3_inverse, se3_log, transform
from garps_core.start.descriptors import BORDER_PX, match_descriptors, reciprocal
from garps_core.start.match_pose import pose_from_matches

CONFIG = Config.preset("monocular")


def described(points):
    """Unit vectors hxwx24 that are near where points (hxwx3, m) are: waves of many directions and lengths."""
    rng = np.random.default_rng(0)
    waves = np.sin(points @ rng.normal(size=(3, 24)) * 3 + rng.uniform(0, 6, 24)).astype(np.float32)
    return waves / np.linalg.norm(waves, axis=-1, keepdims=True)


@pytest.fixture(scope="module")
def pair():
    """Source, target, truth, and maps whose descriptors say where in the room a pixel's point is."""
    made = make_pair(3, 2, 1.0, 320, 240)
    maps = point_maps(true_views(made), made.T_1_0)
    first, second = maps.source_first
    orders = [replace(one, descriptors=described(one.points)) for one in (first, second)]
    return *true_views(made), made.T_1_0, replace(maps, source_first=tuple(orders))


def test_matches_see_the_same_point(pair):
    source, target, T, maps = pair
    found = match_descriptors(maps, source, target, CONFIG)
    assert len(found) > 150
    apart = np.linalg.norm(transform(T, found.source_points) - found.target_points, axis=1)
    assert np.median(apart) < 0.02, "half a pixel of the map is 6 mm at 2.7 m"


@pytest.mark.parametrize("scale", ["network", "depth"])
def test_the_pose_from_matches(pair, scale):
    source, target, T, maps = pair
    config = CONFIG.replace({"start.scale": scale})
    prior = pose_from_matches(match_descriptors(maps, source, target, config), source, target, config, maps.origin)
    error = se3_log(prior.T_target_source @ se3_inverse(T))
    assert np.linalg.norm(error[:3]) < 0.03 and np.linalg.norm(error[3:]) < 0.01
    assert prior.origin == "made"


def test_whose_depth_the_points_have(pair):
    source, target, _, maps = pair
    farther = replace(source, depth=source.depth * 1.5), replace(target, depth=target.depth * 1.5)
    own = match_descriptors(maps, *farther, CONFIG.replace({"start.scale": "network"}))
    depth = match_descriptors(maps, *farther, CONFIG.replace({"start.scale": "depth"}))
    both = np.isfinite(depth.source_points[:, 2])
    ratio = np.median(depth.source_points[both, 2] / own.source_points[both, 2])
    assert ratio == pytest.approx(1.5, rel=0.01)


def test_neighbours_are_mutual_and_away_from_the_border(pair):
    *_, maps = pair
    a, b = (one.descriptors for one in maps.source_first)
    px_a, px_b = reciprocal(a, b)
    assert len(np.unique(px_a, axis=0)) == len(px_a) and len(np.unique(px_b, axis=0)) == len(px_b)
    for px, one in ((px_a, a), (px_b, b)):
        assert px.min() >= BORDER_PX and (px < np.array(one.shape[1::-1]) - BORDER_PX).all()
    inner = slice(BORDER_PX, -BORDER_PX)
    flat = b[inner, inner].reshape(-1, 24)
    for (x, y), (u, v) in list(zip(px_a.astype(int), px_b.astype(int), strict=True))[::20]:
        assert (flat @ a[y, x]).max() == pytest.approx(float(b[v, u] @ a[y, x]), abs=1e-6)


def test_pictures_that_share_nothing_have_no_pose(pair):
    source, target, _, maps = pair
    noise = np.random.default_rng(1).normal(size=maps.source_first[1].descriptors.shape).astype(np.float32)
    noise /= np.linalg.norm(noise, axis=-1, keepdims=True)
    strange = replace(maps, source_first=(maps.source_first[0], replace(maps.source_first[1], descriptors=noise)))
    with pytest.raises(InitialisationError):
        pose_from_matches(match_descriptors(strange, source, target, CONFIG), source, target, CONFIG)


def test_a_network_without_descriptors_is_named(pair):
    source, target, T, _ = pair
    with pytest.raises(InitialisationError, match=r"made has no descriptors .* set start\.pose_from to maps"):
        match_descriptors(point_maps((source, target), T), source, target, CONFIG)


def test_matches_the_network_is_not_sure_of_are_left_out(pair):
    source, target, _, maps = pair
    left = maps.source_first[0].confidence.copy()
    left[:, :128] = 1.0
    doubtful = [replace(maps.source_first[0], confidence=left), maps.source_first[1]]
    same = [maps.target_first[0], replace(maps.target_first[1], confidence=left)]
    found = match_descriptors(
        replace(maps, source_first=tuple(doubtful), target_first=tuple(same)), source, target, CONFIG
    )
    assert len(found) > 50 and found.source_px[:, 0].min() > 128 / maps.framings[0].scale[0] - 1
    with pytest.raises(InitialisationError, match="none is surer than 50 on both sides"):
        match_descriptors(maps, source, target, CONFIG.replace({"start.min_confidence": 50.0}))
