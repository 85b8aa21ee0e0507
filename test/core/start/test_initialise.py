# SPDX-License-Identifier: Apache-2.0
"""The start pose: features and metric PnP where there is texture, and an honest fallback where there is none."""

from dataclasses import replace

import cv2
import numpy as np
import pytest
from made_matches import BLANK, exact_matches, one_place, pose_from
from surfaces import FREE, TRUTH, disturbed, room

from garps_core import Config, Prior, Status, View, estimate_relative_pose
from garps_core.config.start import Start
from garps_core.errors import InitialisationError
from garps_core.geometry import inverted, project, se3_exp, se3_inverse, se3_log, transform, twist_from_ros
from garps_core.metrics import nees, rotation_error_deg, translation_error_m
from garps_core.start import feature_start
from garps_core.start.features import Matches, match_features
from garps_core.start.initialise import combined, initialise
from garps_core.start.reprojection import READINGS_AVERAGE

FEATURES = Config().replace({"start.method": "features"})
STRICT = Config().replace({"start.identity_fallback": False})
APART = (
    se3_exp(np.array([0, 0, 3.5, 0, 0, 0]))
    @ se3_exp(np.array([0, 0, 0, 0.1, 0.7, 0]))
    @ se3_exp(np.array([0, 0, -3.5, 0, 0, 0]))
)  # turned about a point in the scene, so that position and rotation go together


@pytest.mark.parametrize(("seed", "level"), [(1, 1), (1, 2), (2, 1), (2, 2)])
def test_features_start_close_in_a_textured_room(seed, level):
    source, target, truth = room(seed, level)
    (start,) = initialise(source, target)
    assert start.origin == "features" and "inliers" in start.reason
    assert translation_error_m(start.T_target_source, truth) < 0.02
    assert rotation_error_deg(start.T_target_source, truth) < 0.5
    assert nees(start.T_target_source, start.covariance, truth) < 25
    sigmas = np.sqrt(np.diag(start.covariance))
    assert (sigmas < [0.1] * 3 + [0.03] * 3).all() and (sigmas > 1e-4).all()


def test_swapped_views_start_at_the_inverse():
    source, target, _ = room(1, 1)
    (there,), (back,) = initialise(source, target), initialise(target, source)
    sigmas = np.sqrt(np.diag(there.covariance))
    again = se3_inverse(back.T_target_source)
    assert translation_error_m(again, there.T_target_source) < 2 * sigmas[:3].max()
    assert np.radians(rotation_error_deg(again, there.T_target_source)) < 2 * sigmas[3:].max()
    ratio = np.diag(inverted(back.covariance, back.T_target_source)) / np.diag(there.covariance)
    assert ((ratio > 1 / 4) & (ratio < 4)).all()


@pytest.mark.parametrize("without", ["source", "target"])
def test_depth_of_one_view_is_enough(without):
    """Then one direction alone makes the pose: the other view's pixels against this one's points."""
    source, target, truth = room(1, 1)
    views = {"source": source, "target": target}
    views[without] = replace(views[without], depth=None)
    (start,) = initialise(views["source"], views["target"], FEATURES)
    assert translation_error_m(start.T_target_source, truth) < 0.03
    assert rotation_error_deg(start.T_target_source, truth) < 0.7


def test_both_directions_are_more_certain_than_one():
    matches = exact_matches(pixel_noise=0.5)
    nothing = np.full_like(matches.source_points, np.nan)
    both = pose_from(matches)
    one = pose_from(replace(matches, target_points=nothing))
    other = pose_from(replace(matches, source_points=nothing))
    for single in (one, other):
        assert translation_error_m(single.T_target_source, TRUTH) < 0.05
        assert not np.allclose(single.T_target_source, both.T_target_source, atol=1e-6)
    assert np.trace(both.covariance[:3, :3]) < np.trace(one.covariance[:3, :3]) * 1.05


def test_exact_matches_give_the_exact_pose():
    start = pose_from(exact_matches())
    np.testing.assert_allclose(start.T_target_source, TRUTH, atol=1e-6)
    assert start.reason == "80 feature matches, 80 inliers"


@pytest.mark.parametrize("outliers", [20, 45])
def test_wrong_matches_are_left_out(outliers):
    start = pose_from(exact_matches(outliers=outliers))
    assert translation_error_m(start.T_target_source, TRUTH) < 5e-3
    assert rotation_error_deg(start.T_target_source, TRUTH) < 0.1
    assert start.reason.startswith("80 feature matches")


@pytest.mark.parametrize("truth", [TRUTH, APART], ids=["beside", "two metres apart"])
def test_covariance_of_the_start_covers_its_errors(truth):
    """Forty draws of pixel and depth noise, none of it shared; the points' noise is that of a patch's mean."""
    own = {"lifting.noise_floor_m": 0.0, "lifting.noise_linear": 0.01 * READINGS_AVERAGE}
    config = Config().replace({**own, "lifting.scale_sigma": 0.0, "lifting.warp_sigma": 0.0})
    values = []
    for seed in range(40):
        start = pose_from(exact_matches(seed, pixel_noise=0.7, relative_depth_noise=0.01, truth=truth), config)
        values.append(nees(start.T_target_source, start.covariance, truth))
    mean = np.mean(values) * config.start.covariance_inflation**2 * 2
    assert 3.6 < mean < 10, "6: the inflation is for real images, and matches count both ways"


def test_noisier_depth_makes_the_start_less_certain():
    """What is said of the depth counts, whether it is true or not."""
    matches, plain = exact_matches(pixel_noise=0.5), {"start.covariance_inflation": 1.0}
    sensor = pose_from(matches, Config().replace(plain))
    network = pose_from(matches, Config.preset("monocular").replace(plain))
    assert np.trace(network.covariance[:3, :3]) > 2 * np.trace(sensor.covariance[:3, :3])
    doubled = pose_from(matches, Config().replace({"start.covariance_inflation": 15.0, "lifting.scale_sigma": 0.0}))
    assert np.trace(doubled.covariance) > 10 * np.trace(sensor.covariance)


FAILURES = {
    "no matches": (exact_matches(count=0), "0 feature matches, 0 with depth: no pose fits them"),
    "too few": (exact_matches(count=7), "7 feature matches, 7 with depth: no pose fits them"),
    "nothing but outliers": (
        exact_matches(count=40, outliers=40),
        r"40 feature matches, \d+ fit one pose: expected at",
    ),
    "no depth": (
        replace(exact_matches(), source_points=np.full((80, 3), np.nan), target_points=np.full((80, 3), np.nan)),
        "80 feature matches, 0 with depth: no pose fits them",
    ),
}


@pytest.mark.parametrize("name", FAILURES)
def test_matches_that_fit_no_pose_are_no_pose(name):
    matches, text = FAILURES[name]
    with pytest.raises(InitialisationError, match=text):
        pose_from(matches)


@pytest.mark.parametrize("patch_sigma", [0.03, 0.3])
def test_copies_of_one_match_are_no_pose(patch_sigma):
    """Most of these normal equations are singular, or leave a covariance that is none."""
    loose = Config().replace({"lifting.patch_sigma": patch_sigma, "start.ransac_px": 20.0})
    refused = []
    for seed in range(30):
        try:
            pose_from(one_place(seed, pixel_noise=0.5, relative_depth_noise=0.1), loose)
        except InitialisationError as failure:
            refused.append(str(failure))
    assert sum("8 inliers, but they fix no pose" in text and "give a prior" in text for text in refused) > 10


LOOSE = Config().replace({"lifting.patch_sigma": 0.03, "start.ransac_px": 20.0})
"""Settings under which copies of one match pass as inliers of a pose."""


def test_features_that_leave_the_pose_open_do_not_keep_a_prior_from_its_turn(monkeypatch):
    for seed in range(2):
        matches = one_place(seed, pixel_noise=0.5, relative_depth_noise=0.1)
        monkeypatch.setattr(feature_start, "match_features", lambda *_, found=matches: found)
        assert initialise(BLANK, BLANK, LOOSE, disturbed())[0].origin == "given"
        assert initialise(BLANK, BLANK, LOOSE)[0].origin == "identity"
        for prior, origin in ((disturbed(), "given"), (None, "identity")):
            assert estimate_relative_pose(BLANK, BLANK, LOOSE, prior).initial.origin == origin
    with pytest.raises(InitialisationError):
        initialise(BLANK, BLANK, LOOSE.replace({"start.method": "features"}), disturbed())


def test_a_prior_stays_alone_where_features_are_too_uncertain_to_add_to_it():
    """Covariances twenty orders of magnitude apart: their sum in float64 is one of them."""
    given = a_prior(covariance=1e-6 * FREE)
    rng = np.random.default_rng(0)
    axes, _ = np.linalg.qr(rng.normal(size=(6, 6)))
    vague = axes @ np.diag(10.0 ** np.arange(0, 18, 3)) @ axes.T
    (start,) = combined(given, a_prior(covariance=0.5 * (vague + vague.T), origin="features"), 1e6)
    assert start.origin == "given" and "too precise for the features" in start.reason
    np.testing.assert_array_equal(start.covariance, given.covariance)


def test_blank_images_start_at_identity_and_say_why():
    (start,) = initialise(BLANK, BLANK)
    assert start.origin == "identity" and start.reason.startswith("features failed: 0 feature matches")
    np.testing.assert_array_equal(start.T_target_source, np.eye(4))
    np.testing.assert_allclose(np.sqrt(np.diag(start.covariance)), [0.3] * 3 + [0.2] * 3)


@pytest.mark.parametrize("config", [FEATURES, STRICT], ids=["method features", "no fallback"])
def test_blank_images_without_a_fallback_have_no_initial_pose(config):
    with pytest.raises(InitialisationError, match="0 feature matches, 0 with depth: no pose fits them"):
        initialise(BLANK, BLANK, config)
    estimate = estimate_relative_pose(BLANK, BLANK, config)
    assert estimate.status is Status.NO_INITIAL_POSE and not estimate.ok
    assert estimate.T_target_source is None and estimate.covariance is None and estimate.initial is None
    assert estimate.reason.startswith("0 feature matches") and set(estimate.seconds) == {"reconstruct", "initialise"}


def test_one_blank_view_is_no_match():
    source, _, _ = room(1, 1)
    assert len(match_features(source, BLANK, Start())) == len(match_features(BLANK, source, Start())) == 0
    assert [start.origin for start in initialise(source, BLANK)] == ["identity"]


def test_a_given_prior_is_used_as_it_is_where_features_have_no_say():
    prior = disturbed()
    for config in (Config(), STRICT):
        assert initialise(BLANK, BLANK, config, prior) == (prior,)
    source, target, _ = room(1, 1)
    assert initialise(source, target, Config().replace({"start.features": False}), prior) == (prior,)


def test_methods_that_are_asked_for_ignore_a_prior():
    wide = Config().replace({"start.method": "identity", "start.identity_sigma_m": 2.0})
    (start,) = initialise(BLANK, BLANK, wide, disturbed())
    assert start.origin == "identity" and "asked for" in start.reason
    np.testing.assert_array_equal(start.T_target_source, np.eye(4))
    assert start.covariance[0, 0] == pytest.approx(4)
    with pytest.raises(InitialisationError):
        initialise(BLANK, BLANK, FEATURES, disturbed())
    source, target, truth = room(1, 1)
    wrong = Prior(np.eye(4), 1e-6 * FREE)
    (start,) = initialise(source, target, FEATURES, wrong)
    assert start.origin == "features" and translation_error_m(start.T_target_source, truth) < 0.02


def test_matches_carry_the_depth_of_their_pixels():
    source, target, truth = room(1, 1)
    matches = match_features(source, target, Start())
    assert len(matches) > 50
    trusted = np.isfinite(matches.source_points[:, 0])
    assert 0.3 < trusted.mean() <= 1
    points, px = matches.source_points[trusted], matches.source_px[trusted]
    np.testing.assert_allclose(project(source.K, points), px, atol=1e-6)
    row, column = np.rint(px).astype(int).T[::-1]
    assert np.median(np.abs(points[:, 2] / source.depth[row, column] - 1)) < 0.005
    error = np.linalg.norm(project(target.K, transform(truth, points)) - matches.target_px[trusted], axis=1)
    assert np.median(error) < 1.5
    assert matches.places(np.arange(len(matches))) > 0.8 * len(matches), "mutual, but for several orientations"


def test_a_place_counts_once_however_many_orientations_it_has():
    """A disc looks alike from all sides, and SIFT describes it once per direction: eight matches may be two places."""
    wall = np.full((240, 320, 3), 128, np.uint8)
    for x, radius in ((90, 5), (220, 8)):
        cv2.circle(wall, (x, 120), radius, (20, 20, 20), -1, cv2.LINE_AA)
    view = View(wall, BLANK.K, BLANK.depth)
    matches = match_features(view, view, Start(match_ratio=1.0))
    assert len(matches) >= Start().min_inliers and matches.places(np.arange(len(matches))) == 2


def test_five_places_are_no_pose_however_often_each_is_matched():
    exact = exact_matches(count=5)
    twice = Matches(*(np.repeat(part, 2, axis=0) for part in vars(exact).values()))
    with pytest.raises(InitialisationError, match="10 at 5 places fit one pose: expected at least 8"):
        pose_from(twice)
    assert "10 inliers" in pose_from(twice, Config().replace({"start.min_inliers": 5})).reason


def test_places_are_counted_in_the_view_that_has_fewer():
    exact = exact_matches(count=20)
    assert exact.places(np.arange(20)) == 20 and exact.places(np.arange(7)) == 7
    fanned = replace(exact, source_px=np.repeat(exact.source_px[:5], 4, axis=0))
    assert fanned.places(np.arange(20)) == 5


def test_depth_on_a_silhouette_is_not_trusted():
    """A step in depth through the middle of the texture: matches beside it have a point, those on it have none."""
    view = room(1, 1)[0]
    step = np.where(np.arange(320) < 160, 2.0, 3.0).astype(np.float32) * np.ones((240, 1), np.float32)
    stepped = View(view.rgb, view.K, step)
    matches = match_features(stepped, stepped, Start())
    away = np.abs(matches.source_px[:, 0] - 159.5)
    trusted = np.isfinite(matches.source_points[:, 0])
    assert trusted[away > 4].all() and not trusted[away < 1.5].any() and (away < 1.5).any()


def test_the_same_seed_gives_the_same_start():
    source, target, _ = room(1, 2)
    (a,), (b,) = initialise(source, target), initialise(source, target)
    assert a.T_target_source.tobytes() == b.T_target_source.tobytes()
    assert a.covariance.tobytes() == b.covariance.tobytes()


def a_prior(twist=(0, 0, 0, 0, 0, 0), covariance=FREE, origin="given"):
    """Off the truth by a twist, with the covariance of a twist."""
    return replace(disturbed(twist=twist, covariance=covariance), origin=origin)


def of_twist(prior):
    return twist_from_ros(prior.covariance, prior.T_target_source)


def random_covariance(seed):
    A = np.random.default_rng(seed).normal(size=(6, 6)) * ([0.05] * 3 + [0.02] * 3)
    return A.T @ A + np.diag([1e-4] * 3 + [1e-5] * 3)


@pytest.mark.parametrize("seed", range(3))
def test_information_of_two_measurements_adds_up(seed):
    given, found = (a_prior(covariance=random_covariance(10 * seed + i), origin="x") for i in (1, 2))
    (both,) = combined(given, found, 5.0)
    information = sum(np.linalg.inv(of_twist(prior)) for prior in (given, found))
    np.testing.assert_allclose(np.linalg.inv(of_twist(both)), information, rtol=1e-6, atol=1e-6 * information.max())
    for single in (given, found):
        assert np.linalg.eigvalsh(single.covariance - both.covariance)[0] > 0, "more certain in every direction"
    np.testing.assert_allclose(both.T_target_source, TRUTH, atol=1e-12)


def test_equal_measurements_meet_in_the_middle():
    twist = np.array([0.02, -0.03, 0.01, 0.01, 0.004, -0.01])
    (both,) = combined(a_prior(twist), a_prior(origin="features"), 5.0)
    np.testing.assert_allclose(both.T_target_source, se3_exp(0.5 * twist) @ TRUTH, atol=1e-9)
    np.testing.assert_allclose(of_twist(both), FREE / 2, rtol=1e-2, atol=1e-7)


@pytest.mark.parametrize("sharper", ["given", "features"])
def test_the_more_precise_measurement_counts_more_whoever_made_it(sharper):
    """A tenth of the sigma, a hundredth of the way."""
    twist = np.array([0.03, 0, 0, 0, 0.01, 0])
    scale = {"given": 1.0, "features": 1.0} | {sharper: 0.01}
    given = a_prior(twist, scale["given"] * FREE)
    (both,) = combined(given, a_prior(covariance=scale["features"] * FREE, origin="features"), 5.0)
    moved = se3_log(both.T_target_source @ se3_inverse(TRUTH))
    share = {"given": 100 / 101, "features": 1 / 101}[sharper]
    np.testing.assert_allclose(moved, share * twist, atol=1e-6)


def test_either_measurement_may_be_called_the_given_one():
    """To first order; the difference of the two is small."""
    a, b = a_prior([0.01, 0.02, 0, 0.004, 0, 0.003], random_covariance(3)), a_prior(covariance=random_covariance(4))
    (one,), (other,) = combined(a, b, 50.0), combined(b, a, 50.0)
    assert translation_error_m(one.T_target_source, other.T_target_source) < 2e-4
    np.testing.assert_allclose(one.covariance, other.covariance, atol=0.02 * one.covariance.max())


def test_measurements_that_contradict_each_other_are_two_starts():
    """5 sigmas of the difference, which has the covariance of both: sqrt(2) times either's."""
    for sigmas, starts in ((4.9, 1), (5.1, 2)):
        given = a_prior([sigmas * 0.1 * np.sqrt(2), 0, 0, 0, 0, 0])
        assert len(combined(given, a_prior(origin="features"), 5.0)) == starts
        assert len(combined(given, a_prior(origin="features"), 5.2)) == 1
    features, kept = combined(given, replace(a_prior(), origin="features", reason="80 matches"), 5.0)
    assert (features.origin, kept.origin) == ("features", "given"), "features come first"
    assert features.reason == "80 matches; contradicts the given prior: 5.1 sigmas apart (5 allowed)"
    assert kept.reason == "contradicts the features: 5.1 sigmas apart (5 allowed)"
    np.testing.assert_allclose(kept.T_target_source, given.T_target_source, atol=1e-12)
    np.testing.assert_array_equal(kept.covariance, given.covariance)
    np.testing.assert_allclose(features.T_target_source, TRUTH, atol=1e-15)


def test_features_refine_a_given_prior_or_contradict_it():
    source, target, truth = room(1, 2)
    (features,) = initialise(source, target)
    (both,) = initialise(source, target, None, disturbed(truth))
    assert both.origin == "given and features"
    assert both.reason.startswith(features.reason) and "sigmas from the given prior" in both.reason
    assert np.linalg.eigvalsh(features.covariance - both.covariance)[0] > 0
    assert translation_error_m(both.T_target_source, features.T_target_source) < 0.005
    wrong = disturbed(truth, twist=[0.5, 0, 0, 0, 0, 0], covariance=1e-2 * FREE)
    starts = initialise(source, target, None, wrong)
    assert [start.origin for start in starts] == ["features", "given"]
    np.testing.assert_allclose(starts[1].T_target_source, wrong.T_target_source, atol=1e-12)
    assert len(initialise(source, target, Config().replace({"start.max_contradiction": 1e3}), wrong)) == 1
