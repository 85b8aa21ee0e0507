# SPDX-License-Identifier: Apache-2.0
"""Depth that is off from place to place: what features still know then, and how sure they may be of it."""

from dataclasses import replace

import numpy as np
import pytest
from made_matches import BLANK, CAMERA, exact_matches, pose_from
from surfaces import TRUTH

from garps_core import Config
from garps_core.errors import InitialisationError
from garps_core.geometry import pixel_rays, project, se3_exp, se3_inverse, se3_log, transform
from garps_core.metrics import nees, rotation_error_deg, translation_error_m
from garps_core.start import match_pose
from garps_core.start.match_pose import pose_from_matches
from garps_core.start.ransac import MIN_LENGTHS, pose_from_bearings, triangulated
from garps_core.start.reprojection import (
    READINGS_AVERAGE,
    OneWay,
    Reprojected,
    across,
    inliers_of,
    reprojected,
    whitened,
)

ASIDE = se3_exp(np.array([0.5, -0.1, 0.1, 0.03, 0.2, -0.02]))
"""Half a metre apart: 20 % of the depth is 10 px and more."""
AHEAD = se3_exp(np.array([0.05, 0.02, -0.5, 0.01, 0.02, 0.0]))
OFF = 0.2
TURNED = se3_exp(np.array([0, 0, 0, 0.05, 0.2, 0.03]))


def settings(patch_sigma: float, **others: float) -> Config:
    """Of a depth that is right but for errors from place to place, which it tells."""
    nothing_else = {"noise_floor_m": 0.0, "noise_linear": 0.0, "scale_sigma": 0.0, "warp_sigma": 0.0}
    lifting = {f"lifting.{name}": value for name, value in (nothing_else | {"patch_sigma": patch_sigma}).items()}
    return Config().replace(lifting | {"lifting.pointing_sigma_rad": 0.0, "start.covariance_inflation": 1.0, **others})


def bearings(matches, config=None):
    return pose_from_bearings(matches, CAMERA, CAMERA, config or settings(OFF))


def seen_with(along, residual):
    """Points of which only these two are asked for."""
    n = len(along)
    return Reprojected(np.zeros((n, 3)), np.zeros((n, 3)), np.zeros((n, 2, 3)), along, residual)


def as_measured(way, T):
    return reprojected(way, T, 1.0, np.zeros(len(way.points)))


def rotation_errors(patch_sigma: float, noise: float, seeds=range(20)) -> float:
    errors = []
    for seed in seeds:
        matches = exact_matches(seed, pixel_noise=0.5, relative_depth_noise=noise, truth=ASIDE)
        try:
            errors.append(rotation_error_deg(pose_from(matches, settings(patch_sigma)).T_target_source, ASIDE))
        except InitialisationError:
            errors.append(np.inf)
    return float(np.median(errors))


@pytest.mark.parametrize("truth", [TRUTH, ASIDE, se3_inverse(ASIDE)], ids=["near", "aside", "back"])
def test_exact_matches_give_the_exact_pose_with_its_length(truth):
    np.testing.assert_allclose(bearings(exact_matches(truth=truth)), truth, atol=1e-6)


@pytest.mark.parametrize("known", ["both", "source", "target"])
def test_depth_gives_the_length_and_nothing_else(known):
    matches = exact_matches(truth=ASIDE)
    larger = {"source_points": 1.2 * matches.source_points, "target_points": 1.2 * matches.target_points}
    for side in ("source", "target"):
        if known not in ("both", side):
            larger[f"{side}_points"] = np.full_like(matches.source_points, np.nan)
    expected = ASIDE.copy()
    expected[:3, 3] *= 1.2
    np.testing.assert_allclose(bearings(replace(matches, **larger)), expected, atol=1e-6)


def test_a_few_wild_depths_do_not_change_the_length():
    matches = exact_matches(truth=ASIDE)
    wild = matches.source_points.copy()
    wild[:20] *= np.linspace(0.1, 9, 20)[:, None]
    np.testing.assert_allclose(bearings(replace(matches, source_points=wild)), ASIDE, atol=1e-6)


def test_what_cannot_be_told_is_none():
    matches = exact_matches(truth=ASIDE)
    few = settings(OFF, **{"start.min_inliers": 90})
    unknown, three = np.full_like(matches.source_points, np.nan), matches.source_points.copy()
    three[MIN_LENGTHS - 1 :] = np.nan
    assert bearings(exact_matches(count=0)) is None and bearings(exact_matches(count=4)) is None
    assert bearings(matches, few) is None
    assert bearings(replace(matches, source_points=unknown, target_points=unknown)) is None
    assert bearings(replace(matches, source_points=three, target_points=unknown)) is None
    assert bearings(exact_matches(count=40, outliers=40), settings(OFF, **{"start.min_inliers": 15})) is None


def test_triangulation_gives_the_depths_of_both_views():
    matches = exact_matches(truth=ASIDE)
    rays = [pixel_rays(CAMERA, *px.T) for px in (matches.source_px, matches.target_px)]
    depths = triangulated(ASIDE, *rays)
    np.testing.assert_allclose(depths, np.stack([matches.source_points[:, 2], matches.target_points[:, 2]], axis=1))


def test_along_is_what_a_longer_ray_does_to_the_pixel():
    matches, gain = exact_matches(truth=ASIDE), 1e-6
    way = OneWay(matches.source_points, matches.target_px, CAMERA)
    shifts = project(CAMERA, transform(ASIDE, way.points * (1 + gain))) - way.px
    np.testing.assert_allclose(as_measured(way, ASIDE).along, shifts / gain, rtol=1e-3, atol=1e-3)


@pytest.mark.parametrize("truth", [ASIDE, AHEAD], ids=["aside", "ahead"])
def test_the_likely_depth_is_where_both_costs_are_smallest(truth):
    """Against a fine grid of depths, match by match; never further from the measured one than three sigmas."""
    matches = exact_matches(5, count=20, pixel_noise=2.0, relative_depth_noise=OFF, truth=truth)
    points = matches.source_points * np.where(np.arange(20) == 7, 20.0, 1.0)[:, None]
    way, s = OneWay(points, matches.target_px, CAMERA), 1.5
    seen = reprojected(way, truth, s, np.full(20, OFF))
    found = np.log(seen.points[:, 2] / way.points[:, 2])
    tried = np.linspace(-3 * OFF, 3 * OFF, 4001)
    pixels = np.stack([project(CAMERA, transform(truth, way.points * np.exp(d))) for d in tried])
    cost = np.square(pixels - way.px).sum(-1) / s**2 + np.square(tried / OFF)[:, None]
    np.testing.assert_allclose(found, tried[cost.argmin(0)], atol=0.02)
    np.testing.assert_array_equal(as_measured(way, truth).points, way.points)


@pytest.mark.parametrize(("pixel_sigma", "patch_sigma"), [(1.0, 0.2), (0.5, 0.05), (2.0, 0.0)])
def test_whitened_noise_is_that_of_pixels(pixel_sigma, patch_sigma):
    """M (s^2 1 + p^2 a a') M' = s^2 1, for the matrix M that whitens."""
    for along in np.array([[30.0, 0.0], [-7.0, 11.0], [0.0, 0.0]]):
        units = [seen_with(along[None], e[None]) for e in np.eye(2)]
        whitening = np.stack([whitened(unit, pixel_sigma, patch_sigma)[0] for unit in units], axis=1)
        noise = pixel_sigma**2 * np.eye(2) + patch_sigma**2 * np.outer(along, along)
        np.testing.assert_allclose(whitening @ noise @ whitening.T, pixel_sigma**2 * np.eye(2), atol=1e-12)


def test_what_depth_explains_is_allowed_and_nothing_else():
    """10 px off along the epipolar line, then 10 px off across it."""
    matches = exact_matches(truth=ASIDE)
    along = as_measured(OneWay(matches.source_points, matches.target_px, CAMERA), ASIDE).along
    unit = along / np.linalg.norm(along, axis=1, keepdims=True)
    sides = unit, unit[:, ::-1] * [1, -1]
    moved = [OneWay(matches.source_points, matches.target_px + 10 * side, CAMERA) for side in sides]
    assert inliers_of(moved[0], ASIDE, 3.0, OFF).mean() > 0.95 and not inliers_of(moved[1], ASIDE, 3.0, OFF).any()
    assert not inliers_of(moved[0], ASIDE, 3.0).any()


def test_rotation_is_kept_where_depth_is_off_from_place_to_place():
    told, untold = rotation_errors(OFF, OFF), rotation_errors(0.0, OFF)
    assert told < 0.5 and told < untold / 2


@pytest.mark.parametrize("seed", range(6))
def test_bearings_begin_where_more_matches_fit_than_from_pnp(monkeypatch, seed):
    """50 right matches of 80, with depth off by a half."""
    matches = exact_matches(seed, count=80, outliers=30, pixel_noise=0.3, relative_depth_noise=0.5, truth=ASIDE)
    config = settings(0.4)
    found = pose_from(matches, config)
    monkeypatch.setattr(match_pose, "pose_from_bearings", lambda *given: None)
    inliers = [int(start.reason.split()[3]) for start in (found, pose_from(matches, config))]
    assert inliers[0] >= 45 > inliers[1]
    assert rotation_error_deg(found.T_target_source, ASIDE) < 0.3


def test_nothing_is_lost_where_depth_is_right():
    """A twentieth of the depth's error costs nothing that counts: epipolar lines carry most of the pose."""
    assert rotation_errors(0.03, 0.01) < 1.3 * rotation_errors(0.0, 0.01)


def test_across_is_what_no_depth_explains():
    """A pixel along the line is no residual across it; without parallax something still is."""
    along = np.array([[30.0, 0.0], [3.0, 4.0], [0.0, 0.0]])
    residual = np.array([[5.0, 2.0], [6.0, 8.0], [1.0, 7.0]])
    found = across(seen_with(along, residual))
    np.testing.assert_allclose(found, [2.0, 0.0, 7.0], atol=1e-12)


@pytest.fixture(scope="module", params=[(ASIDE, 1), (TRUTH, 1), (ASIDE, 2)], ids=["aside", "near", "better than told"])
def drawn(request):
    """The truth, and what forty draws of pixel noise and depth errors give; depth may be better than is said of it."""
    truth, better = request.param
    noise = {"pixel_noise": 0.7, "relative_depth_noise": OFF / better, "truth": truth}
    return truth, [pose_from(exact_matches(seed, **noise), settings(OFF)) for seed in range(40)]


def test_the_covariance_covers_the_errors(drawn):
    truth, starts = drawn
    mean = np.mean([nees(start.T_target_source, start.covariance, truth) for start in starts])
    assert 1.5 < mean < 5, "3: the two ways of a match are counted as one, and here they are nearly independent"


def test_the_pose_is_not_drawn_to_one_side(drawn):
    """Derivatives at depths that are off by a fifth would be: to a shorter translation and a rotation in its place."""
    truth, starts = drawn
    errors = np.array([se3_log(start.T_target_source @ se3_inverse(truth)) for start in starts])
    of_mean = errors.std(axis=0) / np.sqrt(len(errors))
    assert (np.abs(errors.mean(axis=0)) < 3.5 * of_mean).all()


def test_wrong_matches_are_left_out():
    matches = exact_matches(3, count=120, pixel_noise=0.5, outliers=50, relative_depth_noise=OFF, truth=ASIDE)
    start = pose_from(matches, settings(OFF, **{"start.min_inliers": 15}))
    assert rotation_error_deg(start.T_target_source, ASIDE) < 1
    assert translation_error_m(start.T_target_source, ASIDE) < 0.1


def test_cameras_that_only_turn_are_seen_not_to_move():
    """Then depth does not matter at all, and the direction of t that bearings give means nothing."""
    start = pose_from(exact_matches(pixel_noise=0.3, relative_depth_noise=OFF, truth=TURNED), settings(OFF))
    assert translation_error_m(start.T_target_source, TURNED) < 0.02
    assert rotation_error_deg(start.T_target_source, TURNED) < 0.3
    assert np.sqrt(np.diag(start.covariance)[:3]).max() < 0.02


def test_swapped_views_give_the_inverse():
    there = exact_matches(2, pixel_noise=0.5, relative_depth_noise=OFF, truth=ASIDE)
    back = replace(
        there,
        source_px=there.target_px, target_px=there.source_px,
        source_points=there.target_points, target_points=there.source_points,
    )  # fmt: skip
    one, other = (pose_from(matches, settings(OFF)).T_target_source for matches in (there, back))
    assert translation_error_m(se3_inverse(other), one) < 0.01 and rotation_error_deg(se3_inverse(other), one) < 0.1


@pytest.mark.parametrize("preset", ["monocular", "demo_net"])
def test_presets_of_one_image_allow_for_it_and_ask_for_more_matches(preset):
    config, sensor = Config.preset(preset), Config()
    assert config.lifting.patch_sigma >= 0.03 and sensor.lifting.patch_sigma == 0
    assert config.start.min_inliers > sensor.start.min_inliers
    matches = exact_matches(count=config.start.min_inliers - 1)
    with pytest.raises(InitialisationError, match=r"\d+ feature matches"):
        pose_from_matches(matches, BLANK, BLANK, config)


def test_noise_of_single_readings_is_averaged_over_their_patch_and_errors_of_places_are_not():
    matches = exact_matches(truth=ASIDE, pixel_noise=0.5)
    noisy = settings(0.0).replace({"lifting.noise_linear": OFF * READINGS_AVERAGE})
    a, b = pose_from(matches, noisy), pose_from(matches, settings(OFF))
    np.testing.assert_allclose(np.sqrt(np.diag(b.covariance)), np.sqrt(np.diag(a.covariance)), rtol=0.5)
