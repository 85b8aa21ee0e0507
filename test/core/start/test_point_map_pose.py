# SPDX-License-Identifier: Apache-2.0
"""Point maps of generated rooms give the true pose, in metres, with an honest covariance, or say why not."""

from dataclasses import replace

import numpy as np
import pytest
from point_map_cases import Errors, exact_points, framing_of, point_maps, true_views

from bench.rooms import make_pair
from garps_core import Config, ConfigError, View
from garps_core.errors import InitialisationError
from garps_core.geometry import se3_exp, se3_inverse, se3_log, transform, twist_from_ros
from garps_core.point_maps import Framing, own_depth
from garps_core.start.point_map_pose import pose_from_maps

CONFIG = Config.preset("monocular")
LANDSCAPE, PORTRAIT = (320, 240), (240, 320)
BY_DEPTH = CONFIG.replace({"start.scale": "depth"})


def room(size=LANDSCAPE, seed=3):
    pair = make_pair(seed, 2, 1.0, *size)
    return true_views(pair), pair.T_1_0


@pytest.fixture(scope="module")
def landscape():
    return room()


def cropped(view, left, top, width, height):
    K = view.K - [[0, 0, left], [0, 0, top], [0, 0, 0]]
    part = slice(top, top + height), slice(left, left + width)
    return View(np.ascontiguousarray(view.rgb[part]), K, view.depth[part])


def difference(prior, T):
    """Twist (6,) from the truth to the prior."""
    return se3_log(prior.T_target_source @ se3_inverse(T))


def with_maps(maps, change):
    """Maps with every point map changed."""
    orders = [tuple(change(one) for one in order) for order in (maps.source_first, maps.target_first)]
    return replace(maps, source_first=orders[0], target_first=orders[1])


def scaled(maps, factor):
    return replace(with_maps(maps, lambda one: replace(one, points=one.points * np.float32(factor))), metric=False)


@pytest.mark.parametrize("sizes", [(LANDSCAPE, None), (PORTRAIT, None), (LANDSCAPE, (30, 20, 200, 180))])
def test_exact_maps_give_the_true_pose(sizes):
    """Whatever the framing cuts off, for pictures of one size and of two."""
    size, crop = sizes
    (source, target), T = room(size)
    if crop:
        target = cropped(target, *crop)
    prior = pose_from_maps(point_maps((source, target), T), source, target, CONFIG)
    assert np.abs(difference(prior, T)).max() < 1e-5
    assert prior.origin == "made" and "metres as the network says" in prior.reason


@pytest.mark.parametrize("surer", [0, 1])
def test_the_surer_order_is_kept(landscape, surer):
    """The other one is wrong by 10 cm here, and the covariance grows with the contradiction."""
    views, T = landscape
    noisy = Errors(noise=0.003)
    good, off = (
        point_maps(views, T, noisy, confidence=20.0),
        point_maps(views, se3_exp([0.1, 0, 0, 0, 0, 0]) @ T, noisy),
    )
    mixed = (good.source_first, off.target_first) if surer == 0 else (off.source_first, good.target_first)
    maps = replace(good, source_first=mixed[0], target_first=mixed[1])
    prior = pose_from_maps(maps, *views, CONFIG)
    assert np.linalg.norm(difference(prior, T)[:3]) < 0.02
    assert prior.reason.startswith(("source first", "target first")[surer]) and "the other order" in prior.reason
    alone = pose_from_maps(good, *views, CONFIG)
    assert prior.covariance[0, 0] > 1.5 * alone.covariance[0, 0]


def test_one_order_that_fails_is_told_and_the_other_used(landscape):
    views, T = landscape
    maps = point_maps(views, T)
    points = np.random.default_rng(0).uniform(1, 3, maps.source_first[1].points.shape).astype(np.float32)
    broken = replace(maps, source_first=(maps.source_first[0], replace(maps.source_first[1], points=points)))
    prior = pose_from_maps(broken, *views, CONFIG)
    assert np.abs(difference(prior, T)).max() < 1e-5
    assert prior.reason.startswith("target first") and "source first: " in prior.reason


def test_half_a_pixel_is_half_a_pixel(landscape):
    """A framing that took pixel centres for corners would turn the camera by half a pixel of the map."""
    (source, target), T = landscape
    maps = point_maps((source, target), T)
    shifted = replace(maps, framings=tuple(replace(f, offset=(f.offset[0] + 0.5, f.offset[1])) for f in maps.framings))
    turned = difference(pose_from_maps(shifted, source, target, CONFIG), T)
    focal = maps.framings[1].intrinsics(target.K)[0, 0]
    assert abs(turned[4]) == pytest.approx(0.5 / focal, rel=0.4)  # the rest goes into translation
    assert np.abs(difference(pose_from_maps(maps, source, target, CONFIG), T)).max() < 1e-5


@pytest.mark.parametrize("size", [(480, 640), (640, 480), (361, 639), (17, 900)])
def test_a_framing_and_its_intrinsics_agree(size):
    """The ray of a pixel is the same in the image and in what the network sees."""
    framing = framing_of(*size) if min(size) > 100 else Framing((0.5, 0.25), (3.0, 1.0), (16, 16))
    K = np.array([[500.0, 0, 311.2], [0, 480.0, 200.9], [0, 0, 1]])
    seen = np.array([[0.0, 0.0], [10.5, 3.25], [100.0, 50.0]])
    px, own = framing.to_image(seen), framing.intrinsics(K)
    for (u, v), (x, y) in zip(px, seen, strict=True):
        assert (u - K[0, 2]) / K[0, 0] == pytest.approx((x - own[0, 2]) / own[0, 0])
        assert (v - K[1, 2]) / K[1, 1] == pytest.approx((y - own[1, 2]) / own[1, 1])
    whole = Framing((0.5, 0.5), (0.0, 0.0), (1, 1)).to_image(np.array([[0.0, 0.0]]))
    assert whole == pytest.approx(np.array([[0.5, 0.5]])), "a pixel that covers four has its centre between them"


@pytest.mark.parametrize(
    "errors",
    [Errors(noise=0.01), Errors(patches=0.01), Errors(noise=0.01, patches=0.005, scale=0.1, warp=0.02)],
    ids=["pixels", "patches", "all"],
)
def test_the_covariance_is_that_of_many_draws(landscape, errors):
    """Monte Carlo: the mean of the squared normalised errors of 40 draws, 6 for a perfect covariance."""
    views, T = landscape
    config = CONFIG.replace({"start.network_scale_sigma": errors.scale, "start.network_warp_sigma": errors.warp})
    config = config.replace({"lifting.warp_sigma": errors.warp, "lifting.pointing_sigma_rad": 1e-6})
    squares = []
    for seed in range(40):
        prior = pose_from_maps(point_maps(views, T, errors, seed, long_side=128), *views, config)
        off = difference(prior, T)
        squares.append(off @ np.linalg.solve(twist_from_ros(prior.covariance, prior.T_target_source), off))
    assert 3.0 < np.mean(squares) < 8.0
    assert np.mean(np.array(squares) < 12.59) >= 0.9


def test_the_scale_error_of_the_network_lies_along_the_translation(landscape):
    views, T = landscape
    config = CONFIG.replace({"start.network_warp_sigma": 0.0, "lifting.warp_sigma": 0.0})
    wide, narrow = (
        pose_from_maps(point_maps(views, T), *views, config.replace({"start.network_scale_sigma": sigma}))
        for sigma in (0.2, 0.1)
    )
    along = T[:3, 3] / np.linalg.norm(T[:3, 3])
    grown = (wide.covariance - narrow.covariance)[:3, :3]
    assert along @ grown @ along == pytest.approx((0.2**2 - 0.1**2) * (T[:3, 3] @ T[:3, 3]), rel=1e-3)
    assert np.trace(grown) == pytest.approx(along @ grown @ along, rel=1e-3)


@pytest.mark.parametrize("factor", [0.01, 3.7])
def test_a_network_without_metres_gets_them_from_depth(landscape, factor):
    views, T = landscape
    prior = pose_from_maps(scaled(point_maps(views, T), factor), *views, CONFIG)
    assert np.abs(difference(prior, T)).max() < 1e-3
    assert "metres by the depth of 2 of 2 views" in prior.reason and f"{1 / factor:.3g} per unit" in prior.reason


def test_a_metric_network_gets_the_metres_of_depth_when_told_to(landscape):
    (source, target), T = landscape
    longer = replace(target, depth=target.depth * 1.1), replace(source, depth=source.depth * 1.1)
    own = pose_from_maps(point_maps((source, target), T), longer[1], longer[0], CONFIG)
    depth = pose_from_maps(point_maps((source, target), T), longer[1], longer[0], BY_DEPTH)
    assert own.T_target_source[:3, 3] == pytest.approx(T[:3, 3], abs=1e-5)
    assert depth.T_target_source[:3, 3] == pytest.approx(1.1 * T[:3, 3], rel=5e-3)


def test_depths_that_disagree_about_the_scale_make_it_less_certain(landscape):
    (source, target), T = landscape
    maps = point_maps((source, target), T)
    agreeing = pose_from_maps(maps, source, target, BY_DEPTH)
    apart = pose_from_maps(maps, replace(source, depth=source.depth * 1.3), target, BY_DEPTH)
    along = T[:3, 3] / np.linalg.norm(T[:3, 3])
    assert along @ (apart.covariance - agreeing.covariance)[:3, :3] @ along > (0.1 * np.linalg.norm(T[:3, 3])) ** 2


def test_a_view_without_depth_leaves_the_scale_to_the_other(landscape):
    (source, target), T = landscape
    maps = scaled(point_maps((source, target), T), 2.0)
    prior = pose_from_maps(maps, replace(source, depth=None), target, CONFIG)
    assert "1 of 2 views" in prior.reason and np.abs(difference(prior, T)).max() < 1e-3
    with pytest.raises(InitialisationError, match="no depth to take the scale from"):
        pose_from_maps(maps, replace(source, depth=None), replace(target, depth=None), CONFIG)


def test_what_cannot_be_is_refused(landscape):
    views, T = landscape
    maps = point_maps(views, T)
    with pytest.raises(ConfigError, match=r"start\.scale is network, and made has no metres"):
        pose_from_maps(scaled(maps, 1.0), *views, CONFIG.replace({"start.scale": "network"}))
    with pytest.raises(InitialisationError, match=r"0 of 3072 pixels are surer than 50"):
        pose_from_maps(maps, *views, CONFIG.replace({"start.min_confidence": 50.0}))
    noise = np.random.default_rng(0)
    nonsense = with_maps(maps, lambda one: replace(one, points=noise.normal(size=one.points.shape).astype(np.float32)))
    with pytest.raises(InitialisationError, match="trusted pixels fit one pose: expected at least 20%"):
        pose_from_maps(nonsense, *views, CONFIG)


def test_only_trusted_pixels_are_used(landscape):
    """Half of each picture is nonsense, and the network knows."""
    views, T = landscape
    left = slice(0, 120)

    def spoilt(one):
        points, confidence = one.points.copy(), one.confidence.copy()
        points[:, left], confidence[:, left] = 7.0, 1.1
        return replace(one, points=points, confidence=confidence)

    prior = pose_from_maps(with_maps(point_maps(views, T), spoilt), *views, CONFIG)
    assert np.abs(difference(prior, T)).max() < 1e-5


def test_swapped_views_give_the_inverse_pose_and_covariance(landscape):
    (source, target), T = landscape
    maps = point_maps((source, target), T, Errors(noise=0.005))
    swapped = replace(
        maps, source_first=maps.target_first, target_first=maps.source_first, framings=maps.framings[::-1]
    )
    one, other = pose_from_maps(maps, source, target, CONFIG), pose_from_maps(swapped, target, source, CONFIG)
    assert other.T_target_source @ one.T_target_source == pytest.approx(np.eye(4), abs=0.01)
    assert np.linalg.det(other.covariance) == pytest.approx(np.linalg.det(one.covariance), rel=0.5)


def test_own_depth_is_that_of_the_image(landscape):
    (source, target), T = landscape
    for view, depth in zip(
        (source, target), own_depth(point_maps((source, target), T), source, target, 3.0), strict=True
    ):
        known = np.isfinite(depth)
        assert known[8:-8, 8:-8].mean() > 0.95
        error = np.abs(depth - view.depth)[known] / view.depth[known]
        assert np.median(error) < 2e-3
    none = own_depth(point_maps((source, target), T), source, target, 30.0)
    assert not any(np.isfinite(depth).any() for depth in none)


def test_the_made_maps_are_what_they_claim(landscape):
    """The tests' own maps: points of the source, moved, project to where the target sees them."""
    (source, target), T = landscape
    framing = framing_of(*source.rgb.shape[:2])
    points = exact_points(source.depth, source.K, framing)
    second = point_maps((source, target), T).target_first[1].points
    assert second == pytest.approx(transform(T, points), abs=1e-5)


@pytest.mark.parametrize("factor", [1e-4, 1e3])
def test_any_unit_will_do(landscape, factor):
    views, T = landscape
    noisy = point_maps(views, T, Errors(noise=0.01))
    counts = [
        pose_from_maps(maps, *views, CONFIG.replace({"start.scale": "depth"})).reason.split()[2]
        for maps in (noisy, scaled(noisy, factor))
    ]
    assert abs(int(counts[0]) - int(counts[1])) < 20
