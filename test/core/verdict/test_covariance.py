# SPDX-License-Identifier: Apache-2.0
"""Covariances are right: in the ROS convention, for the inverse pose, and against repeated noise."""

from dataclasses import replace

import numpy as np
import pytest
import surfaces
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation
from surfaces import FREE, TRUTH, disturbed, look, off, random_pose, two_views

from garps_core import Config, Mixture, Prior, align_mixtures
from garps_core.depth_errors import FIELD_SLOPE, depth_sigma, error_fields, error_sigmas
from garps_core.geometry import inverted, ros_from_twist, se3_exp, se3_inverse, twist_from_ros
from garps_core.metrics import pose_error
from garps_core.mixtures.reconstruct import reconstruct
from garps_core.verdict.covariance import inflated

SMALL = {"camera": np.diag([0.5, 0.5, 1]) @ surfaces.K, "size": (60, 80)}
FAR_POSE = np.eye(4)
FAR_POSE[:3, :3] = Rotation.from_rotvec((0.4, -0.7, 1.1)).as_matrix()
FAR_POSE[:3, 3] = (1, -2, 5)
DRAWS = 40_000
SEEDS = st.integers(0, 10**6)


def random_covariance(seed, sigma=0.01):
    A = np.random.default_rng(seed).normal(size=(6, 6))
    return (A @ A.T + np.eye(6)) * sigma**2 / 6


def drawn(covariance, T, seed=0):
    """Shifts and rotations about fixed axes (n, 6) of random poses exp(twist) T; the twists have the covariance."""
    twists = np.random.default_rng(seed).multivariate_normal(np.zeros(6), covariance, size=DRAWS)
    turns = Rotation.from_rotvec(twists[:, 3:])
    cross = np.cross(twists[:, 3:], np.cross(twists[:, 3:], T[:3, 3]))  # the exponential, to second order
    shift = twists[:, :3] + 0.5 * np.cross(twists[:, 3:], twists[:, :3])
    positions = T[:3, 3] + np.cross(twists[:, 3:], T[:3, 3]) + 0.5 * cross + shift
    return np.concatenate([positions - T[:3, 3], turns.as_rotvec()], axis=1)


def apart(a, b):
    """Largest difference of two covariances relative to the sigmas of b."""
    scale = np.sqrt(np.diag(b))
    return np.abs((a - b) / np.outer(scale, scale)).max()


def test_the_sampling_follows_the_exponential():
    """The Monte Carlo below then tests the package and not itself."""
    twists = np.random.default_rng(0).multivariate_normal(np.zeros(6), random_covariance(5), size=DRAWS)
    errors = drawn(random_covariance(5), FAR_POSE)
    for twist, error in zip(twists[:20], errors, strict=False):
        np.testing.assert_allclose(pose_error(FAR_POSE, se3_exp(twist) @ FAR_POSE), error, atol=5e-5)


def test_ros_covariance_is_that_of_position_and_fixed_axes():
    twist = random_covariance(5)
    empirical = np.cov(drawn(twist, FAR_POSE).T)
    assert apart(ros_from_twist(twist, FAR_POSE), empirical) < 0.03
    assert apart(twist, empirical) > 0.3, "without the conversion it would be far off"


def test_conversion_changes_nothing_at_the_origin_and_only_the_position_elsewhere():
    twist = random_covariance(6)
    np.testing.assert_array_equal(ros_from_twist(twist, np.eye(4)), twist)
    np.testing.assert_array_equal(ros_from_twist(twist, FAR_POSE)[3:, 3:], twist[3:, 3:])


@given(SEEDS)
def test_conversion_can_be_undone(seed):
    covariance, T = random_covariance(seed), random_pose(seed, 2.0)
    np.testing.assert_allclose(twist_from_ros(ros_from_twist(covariance, T), T), covariance, atol=1e-14)
    assert np.linalg.eigvalsh(ros_from_twist(covariance, T))[0] > 0


def test_covariance_of_the_inverse_is_that_of_inverted_draws():
    covariance = ros_from_twist(random_covariance(7), FAR_POSE)
    shifts, turns = np.split(drawn(random_covariance(7), FAR_POSE), 2, axis=1)
    back = Rotation.from_matrix(FAR_POSE[:3, :3]).inv()
    positions = -back.apply(Rotation.from_rotvec(-turns).apply(FAR_POSE[:3, 3] + shifts))
    errors = np.concatenate([positions, -back.apply(turns)], axis=1)  # R'^T R = R^T exp(-w) R
    empirical = np.cov(errors.T)
    assert apart(inverted(covariance, FAR_POSE), empirical) < 0.03
    assert apart(covariance, empirical) > 0.3, "the covariance of the pose itself would be far off"


@given(SEEDS)
def test_inverting_twice_gives_the_same_covariance(seed):
    T, covariance = random_pose(seed, 2.0), random_covariance(seed)
    np.testing.assert_allclose(inverted(inverted(covariance, T), se3_inverse(T)), covariance, atol=1e-13)


def estimated(config=None, prior=None, **scene):
    """Estimate on the wavy surface, small images."""
    config = config or Config()
    mixtures = [reconstruct(view, config) for view in two_views(**SMALL, **scene)]
    return align_mixtures(*mixtures, prior or disturbed(), config)


def sigmas(estimate):
    return np.sqrt(np.diag(estimate.covariance))


@pytest.fixture(scope="module")
def plain():
    return estimated()


def test_covariance_is_symmetric_and_positive_definite(plain):
    C = plain.covariance
    assert C.shape == (6, 6) and C.dtype == np.float64
    np.testing.assert_allclose(C, C.T, atol=1e-18)
    assert np.linalg.eigvalsh(C)[0] > 0


def test_more_information_means_less_uncertainty(plain):
    """Without the errors that a whole depth map shares: those do not shrink with the number of measurements."""
    own = {"lifting.scale_sigma": 0.0, "lifting.warp_sigma": 0.0, "lifting.pointing_sigma_rad": 0.0}
    exact, more = (estimated(Config().replace({**own, "alignment.effective_measurements": i})) for i in (30.0, 3000.0))
    assert (sigmas(more) < 0.2 * sigmas(exact)).all() and (sigmas(more) > 0.05 * sigmas(exact)).all()
    assert (sigmas(exact) < sigmas(plain) * (1 + 1e-6)).all()
    much = estimated(Config().replace({"alignment.effective_measurements": 3000.0}))
    assert (sigmas(much) > sigmas(more)).all(), "the shared errors stay"


@pytest.mark.parametrize("name", ["lifting.scale_sigma", "lifting.warp_sigma"])
def test_a_shared_depth_error_makes_the_pose_uncertain(plain, name):
    worse = estimated(Config().replace({name: 0.05}))
    assert np.trace(worse.covariance[:3, :3]) > 1.5 * np.trace(plain.covariance[:3, :3])
    difference = np.linalg.eigvalsh(worse.covariance - plain.covariance)
    assert difference[0] > -0.02 * difference[-1]


def test_a_scale_error_moves_the_camera_along_its_view():
    """Both views look along z at a surface 2.5 m away: 5 per cent of that, in either view, is a shift in z."""
    own = {"alignment.effective_measurements": 1e5, "lifting.warp_sigma": 0.0}
    small, large = (estimated(Config().replace({**own, "lifting.scale_sigma": s})) for s in (1e-4, 0.05))
    gained = large.covariance - small.covariance
    assert np.sqrt(gained[2, 2]) == pytest.approx(np.sqrt(2) * 0.05 * 2.5, rel=0.2)
    assert gained[2, 2] > 5 * max(gained[0, 0], gained[1, 1])


def test_a_tight_prior_is_kept_and_makes_the_pose_certain(plain):
    precise = np.diag([1e-3**2] * 3 + [5e-4**2] * 3)
    own = {"lifting.scale_sigma": 0.0, "lifting.warp_sigma": 0.0, "lifting.pointing_sigma_rad": 0.0}
    prior = disturbed(twist=np.zeros(6), covariance=precise)
    tight = estimated(Config().replace(own), prior)
    assert (sigmas(tight) <= np.sqrt(np.diag(prior.covariance)) * 1.0001).all()
    assert (sigmas(tight) < 0.4 * sigmas(plain)).all()


@pytest.mark.parametrize("factor", [1.5, 4.0])
def test_noisier_data_spread_a_linear_estimate_as_the_inflated_covariance_says(factor):
    """The estimate C (D y + K x0) with y of covariance f^2 D^-1 and x0 of K^-1, drawn."""
    D, K = (np.linalg.inv(random_covariance(seed)) for seed in (1, 2))
    C = np.linalg.inv(D + K)
    rng = np.random.default_rng(0)
    y = rng.multivariate_normal(np.zeros(6), factor**2 * np.linalg.inv(D), size=DRAWS)
    x0 = rng.multivariate_normal(np.zeros(6), np.linalg.inv(K), size=DRAWS)
    found = (y @ D + x0 @ K) @ C
    assert apart(inflated(C, C @ K @ C, factor), np.cov(found.T)) < 0.03


def test_inflation_leaves_the_part_of_the_start():
    C = random_covariance(3)
    np.testing.assert_array_equal(inflated(C, 0.3 * C, 1.0), C)
    np.testing.assert_allclose(inflated(C, np.zeros((6, 6)), 3.0), 9 * C, rtol=1e-12)
    np.testing.assert_allclose(inflated(C, C, 3.0), C, rtol=1e-12)


@pytest.mark.parametrize("depth_errors", [False, True])
def test_shared_errors_are_inflated_with_the_data_they_come_from(depth_errors):
    """A scale error of 5 % is most of the covariance, beside a vague start."""
    config = Config().replace({"alignment.depth_errors": depth_errors, "lifting.scale_sigma": 0.05})
    vague = disturbed(covariance=100 * FREE)
    one, three = (estimated(config.replace({"lifting.sigma_inflation": f}), vague) for f in (1.0, 3.0))
    ratio = sigmas(three) / sigmas(one)
    assert (ratio > 2.9).all() and (ratio < 3.0001).all(), ratio


def test_an_inflated_estimate_is_the_same_pose_with_larger_sigmas(plain):
    vague = estimated(Config().replace({"lifting.sigma_inflation": 3.0}))
    np.testing.assert_array_equal(vague.T_target_source, plain.T_target_source)
    assert (sigmas(vague) > 2.5 * sigmas(plain)).all() and (sigmas(vague) <= 3.0001 * sigmas(plain)).all()
    start = disturbed(twist=np.zeros(6), covariance=np.diag([5e-5**2] * 3 + [2e-5**2] * 3))
    own = {"lifting.scale_sigma": 0.0, "lifting.warp_sigma": 0.0, "lifting.pointing_sigma_rad": 0.0}
    tight = estimated(Config().replace(own | {"lifting.sigma_inflation": 3.0}), start)
    assert (sigmas(tight) <= np.sqrt(np.diag(start.covariance)) * 1.1).all(), "the start stays"


def test_the_direction_along_a_corridor_is_the_most_uncertain():
    """The groove runs along y and has no texture: only its ends tell where along it the camera is."""

    def groove(x, y):
        return 2.5 + 0.3 * np.sin(4 * x) + 0 * y

    ladder = Config().alignment.ladder
    wide = Config().replace({"alignment.ladder": (*ladder[:-1], replace(ladder[-1], neighbours=50))})
    estimate = estimated(wide, disturbed(twist=np.zeros(6)), surface=groove, colours=surfaces.grey_at)
    assert sigmas(estimate)[1] > 1.5 * sigmas(estimate)[0]


def noisy(view, config, rng):
    """The view with depth errors as `Lifting` models them: white noise and the smooth modes."""
    lifting = config.lifting
    v, u = np.mgrid[: view.depth.shape[0], : view.depth.shape[1]].astype(float)
    slopes = np.stack([(u - view.K[0, 2]) / view.K[0, 0], (v - view.K[1, 2]) / view.K[1, 1], np.ones_like(u)], axis=-1)
    drawn_modes = rng.normal(size=8) * error_sigmas(lifting)
    shared = error_fields(slopes.reshape(-1, 3))[:, 2] @ drawn_modes  # along z: the pointing is left out
    white = rng.normal(size=view.depth.shape) * depth_sigma(view.depth, lifting)
    return replace(view, depth=(view.depth * (1 + shared.reshape(view.depth.shape)) + white).astype(np.float32))


def test_shared_errors_are_depth_polynomials_of_the_slope_and_two_turns():
    points = np.array([[0, 0, 2], [FIELD_SLOPE, -FIELD_SLOPE, 1]]) * 1.5
    fields = error_fields(points)
    np.testing.assert_allclose(fields[:, 2, :6] / points[:, 2:], [[1, 0, 0, 0, 0, 0], [1, 1, -1, 1, -1, 1]])
    np.testing.assert_allclose(fields[1, :, 1], points[1])  # along the ray
    np.testing.assert_allclose(fields[:, :, 6:], [[[3, 0], [0, 3], [0, 0]], [[1.5, 0], [0, 1.5], [0, 0]]])


def test_pointing_errors_shift_the_pose():
    """With depth exact, a camera that looks elsewhere than it believes moves its points sideways by angle times z."""
    sigma, z = 0.02, 2.4
    shared = {"lifting.scale_sigma": 0.0, "lifting.warp_sigma": 0.0}
    none = estimated(Config().replace(shared | {"lifting.pointing_sigma_rad": 0.0}), disturbed())
    grown = estimated(Config().replace(shared | {"lifting.pointing_sigma_rad": sigma}), disturbed())
    shift = np.sqrt(np.diag(grown.covariance - none.covariance)[:2])
    np.testing.assert_allclose(shift, sigma * z * np.sqrt(2), rtol=0.15)  # both views


@pytest.mark.parametrize("exaggeration", [1, 4])
def test_repeated_noise_spreads_the_estimates_no_more_than_predicted(exaggeration):
    """Thirty draws from the noise model, once with four times its sigmas; the roll is better than claimed."""
    config = Config()
    lifting = config.lifting
    names = ("noise_floor_m", "noise_linear", "scale_sigma", "warp_sigma")
    config = config.replace({f"lifting.{name}": exaggeration * getattr(lifting, name) for name in names})
    views = two_views(**SMALL)
    rng = np.random.default_rng(3)
    prior = disturbed(covariance=10 * FREE)
    errors, predicted = [], []
    for _ in range(30):
        mixtures = [reconstruct(noisy(view, config, rng), config) for view in views]
        estimate = align_mixtures(*mixtures, prior, config)
        errors.append(pose_error(estimate.T_target_source, TRUTH))
        predicted.append(sigmas(estimate))
    spread, predicted = np.std(errors, axis=0, ddof=1), np.median(predicted, axis=0)
    assert (spread < 1.5 * predicted).all()
    assert (spread[:5] > 0.5 * predicted[:5]).all(), "nor are they much better"
    assert (np.abs(np.mean(errors, axis=0)) < 0.5 * predicted).all()


def test_a_prior_counts_once():
    """The data says nothing about the pose, so the estimate is the prior, not the prior twice."""
    rng = np.random.default_rng(0)
    far = rng.uniform((-1, -1, 2), (1, 1, 4), (200, 3))

    def cloud(means):
        return Mixture(means, np.tile(1e-4 * np.eye(3), (200, 1, 1)), np.ones(200), np.full((200, 3), 0.5))

    prior = Prior(TRUTH, ros_from_twist(1e-4 * FREE, TRUTH))
    estimate = align_mixtures(cloud(far), cloud(far + np.array([0, 0, 50])), prior)
    assert max(off(estimate.T_target_source, TRUTH)) < 1e-9
    np.testing.assert_allclose(estimate.covariance, prior.covariance, rtol=1e-6, atol=1e-15)


def test_the_surface_is_seen_where_it_is():
    """The Monte Carlo depends on it: a view's points lie on the surface of the world."""
    view = look(TRUTH)
    means = (
        reconstruct(view, Config().replace({"lifting.smoothing_px": 0})).means.astype(float) @ TRUTH[:3, :3].T
        + TRUTH[:3, 3]
    )
    assert np.abs(means[:, 2] - surfaces.height(means[:, 0], means[:, 1])).max() < 1e-3
