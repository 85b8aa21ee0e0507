# SPDX-License-Identifier: Apache-2.0
"""Brightness sharpens a pose, whatever the exposure and nearly whatever the depth, and says how sure it is."""

from dataclasses import replace

import cv2
import numpy as np
import pytest
from surfaces import TRUTH, K, flat, grey_at, look, off, room

from garps_core import Config
from garps_core.depth_errors import error_sigmas
from garps_core.geometry import adjoint, se3_exp, se3_inverse, se3_log
from garps_core.mixture import Frustum
from garps_core.mixtures.frustum import brightness_of
from garps_core.mixtures.reconstruct import reconstruct
from garps_core.objective import brightness
from garps_core.objective.brightness import fit_brightness

SCENE = {"camera": np.diag([2, 2, 1]) @ K, "size": (240, 320)}
NEAR = np.diag([0.03**2] * 3 + [np.radians(0.6) ** 2] * 3)
STARTS = [sign * np.array([0.02, -0.015, 0.016, 0.005, -0.005, 0.005]) for sign in (1, -1)]
NOTHING_SHARED = np.zeros(8)


def printed(x, y):
    """Grey texture of all sizes, down to a few centimetres."""
    rng, total = np.random.default_rng(0), np.zeros_like(x)
    for _ in range(40):
        f = rng.normal(size=2) * rng.uniform(2, 22)
        total += np.sin(f[0] * x + f[1] * y + rng.uniform(0, 6)) / np.sqrt(np.hypot(*f))
    return np.clip(0.5 + 0.15 * total / total.std(), 0, 1)[..., None] * np.ones(3)


def frustum(view, step=2):
    """What the camera saw at every step-th pixel."""
    camera = view.K.copy()
    camera[:2] /= step
    camera[:2, 2] -= (step // 2) / step
    return Frustum(camera, view.depth[step // 2 :: step, step // 2 :: step].copy(), brightness_of(view.rgb, step))


@pytest.fixture(scope="module")
def views():
    """Source and target on a wavy, printed surface."""
    return tuple(frustum(look(pose, colours=printed, **SCENE)) for pose in (TRUTH, None))


@pytest.fixture(scope="module", params=["surface", "room"])
def scene(request, views):
    """Source, target and the true pose; made, and rendered with light, noise and another exposure."""
    if request.param == "surface":
        return *views, TRUTH
    source, target, truth = room(1, 2)
    return frustum(source), frustum(target), truth


def sharpened(source, target, T, covariance=NEAR, information=1.0, sigmas=NOTHING_SHARED):
    found = fit_brightness(source, target, T, covariance, information, sigmas)
    assert found is not None
    return found


def test_the_starts_are_three_centimetres_and_half_a_degree_off():
    for start in STARTS:
        metres, radians = off(se3_exp(start) @ TRUTH, TRUTH)
        assert 0.028 < metres < 0.032 and 0.45 < np.degrees(radians) < 0.55


@pytest.mark.parametrize("start", STARTS, ids="+-")
@pytest.mark.parametrize("information", [1.0, 0.05])
def test_a_pose_nearby_is_sharpened(scene, start, information):
    source, target, truth = scene
    found = sharpened(source, target, se3_exp(start) @ truth, information=information)
    metres, radians = off(found.T, truth)
    assert metres < 0.003 and np.degrees(radians) < 0.06
    assert found.correlation > 0.98 and 0.7 < found.share < 0.95


@pytest.mark.parametrize("preset", ["default", "monocular"])
@pytest.mark.parametrize("seed", [1, 2])
def test_the_frustum_of_a_lifted_view_is_enough(preset, seed):
    source, target, truth = room(seed, 1)
    config = Config.preset(preset)
    cameras = [reconstruct(view, config).frustum for view in (source, target)]
    assert all(camera.patch_sigma == config.lifting.patch_sigma for camera in cameras)
    found = sharpened(*cameras, se3_exp(STARTS[0]) @ truth, information=1.0)
    metres, radians = off(found.T, truth)
    assert metres < 0.005 and np.degrees(radians) < 0.1


@pytest.mark.parametrize("wrong", [0, 1])
def test_depth_that_is_off_by_four_per_cent_costs_the_parallax_only(scene, wrong):
    """4 per cent of 2.5 m would be 100 mm."""
    *cameras, truth = scene
    cameras[wrong] = replace(cameras[wrong], depth=cameras[wrong].depth * np.float32(1.04))
    found = sharpened(*cameras, se3_exp(STARTS[0]) @ truth)
    metres, radians = off(found.T, truth)
    parallax = np.linalg.norm(truth[:3, 3])
    assert metres < 0.04 * parallax and np.degrees(radians) < 0.06


def off_in_patches(view, seed, size=12, share=0.1):
    """The view with its depth off by so much from place to place; each place is some cells of its grid."""
    rng, (height, width) = np.random.default_rng(seed), view.depth.shape
    coarse = rng.normal(size=(height // size + 2, width // size + 2)).astype(np.float32)
    gain = np.exp(share * cv2.resize(coarse, (width, height), interpolation=cv2.INTER_CUBIC))
    return replace(view, depth=(view.depth * gain).astype(np.float32), patch_sigma=share)


def test_depth_off_from_place_to_place_makes_less_of_brightness_along_epipolar_lines_only(views):
    """Said of good depth: nothing changes but the weights. Across the lines depth has no say."""
    x, y = (brightness.grid_of(view, 1) for view in views)
    x_told = replace(x, patch_sigma=0.2)
    away = TRUTH.copy()
    away[:3, 3] = [0.4, 0.0, 0.0]  # epipolar lines along x
    plain, careful = brightness._compared(x, y, away), brightness._compared(x_told, y, away)
    ratio = np.diag(careful.information) / np.diag(plain.information)
    assert ratio[0] < 0.75 * ratio[1] and (ratio < 1).all()
    still = np.eye(4)  # without parallax depth does not matter at all
    still[:3, :3] = TRUTH[:3, :3]
    plain, careful = brightness._compared(x, y, still), brightness._compared(x_told, y, still)
    np.testing.assert_array_equal(careful.information, plain.information)


def test_poses_are_better_where_it_is_told_that_depth_is_off(views):
    errors = {True: [], False: []}
    for seed in range(6):
        wrong = [off_in_patches(view, [seed, k]) for k, view in enumerate(views)]
        for told in errors:
            cameras = wrong if told else [replace(view, patch_sigma=0.0) for view in wrong]
            found = sharpened(*cameras, se3_exp(STARTS[0]) @ TRUTH)
            errors[told].append(off(found.T, TRUTH))
    for axis in (0, 1):
        assert np.median([e[axis] for e in errors[True]]) < 0.9 * np.median([e[axis] for e in errors[False]])


def test_depth_of_both_views_in_another_unit_scales_the_translation(views):
    """Images alone know no metre: the translation follows the depth, the rotation stays."""
    larger = [replace(view, depth=view.depth * np.float32(1.04)) for view in views]
    found = sharpened(*larger, se3_exp(STARTS[0]) @ TRUTH, covariance=100 * NEAR)
    np.testing.assert_allclose(found.T[:3, 3], 1.04 * TRUTH[:3, 3], atol=0.0015)
    assert np.linalg.norm(found.T[:3, 3] - TRUTH[:3, 3]) > 0.005


@pytest.mark.parametrize("exposed", [0, 1])
def test_exposure_does_not_matter(views, exposed):
    start = se3_exp(STARTS[0]) @ TRUTH
    plain = sharpened(*views, start)
    cameras = list(views)
    cameras[exposed] = replace(views[exposed], brightness=np.float32(0.7) * views[exposed].brightness + np.float32(0.1))
    other = sharpened(*cameras, start)
    metres, radians = off(other.T, plain.T)
    assert metres < 2e-4 and radians < 1e-4
    assert other.correlation == pytest.approx(plain.correlation, abs=1e-5)


def test_there_is_nothing_to_say_without_brightness_texture_or_common_sight(views):
    source, target = views
    blank = frustum(look(surface=flat, colours=grey_at, **SCENE))
    unknown = replace(target, brightness=None)
    away = TRUTH.copy()
    away[:3, :3] = np.diag([-1.0, 1, -1]) @ TRUTH[:3, :3]
    for information in (1.0, 0.0):
        for pair in ((blank, blank), (source, blank), (blank, target), (source, unknown), (unknown, target)):
            assert fit_brightness(*pair, TRUTH, NEAR, information, NOTHING_SHARED) is None
        assert fit_brightness(source, target, away, NEAR, information, NOTHING_SHARED) is None
    holes = replace(source, depth=np.full_like(source.depth, np.nan))
    assert fit_brightness(holes, target, TRUTH, NEAR, 1.0, NOTHING_SHARED) is None


def test_without_information_it_only_compares(scene):
    source, target, truth = scene
    T = se3_exp(STARTS[0]) @ truth
    seen = sharpened(source, target, T, information=0.0)
    assert seen.T is T
    np.testing.assert_allclose(seen.covariance, NEAR, rtol=1e-9)
    at_truth = sharpened(source, target, truth, information=0.0)
    assert seen.correlation < at_truth.correlation - 0.02


@pytest.mark.parametrize("axis", [0, 1])
def test_correlation_tells_the_truth_from_a_pose_far_away(scene, axis):
    source, target, truth = scene
    away = truth.copy()
    away[axis, 3] += 0.3
    right, wrong = (sharpened(source, target, T, information=0.0) for T in (truth, away))
    assert right.correlation > 0.98 and wrong.correlation < 0.75
    assert 0 < wrong.share < right.share < 1


def test_swapped_views_give_the_inverse(scene):
    source, target, truth = scene
    T = se3_exp(STARTS[0]) @ truth
    B = -adjoint(se3_inverse(T))
    there, again = sharpened(source, target, T), sharpened(target, source, se3_inverse(T), B @ NEAR @ B.T)
    metres, radians = off(se3_inverse(again.T), there.T)
    assert metres < 2e-5 and radians < 1e-5
    B = -adjoint(se3_inverse(there.T))
    np.testing.assert_allclose(again.covariance, B @ there.covariance @ B.T, atol=0.02 * there.covariance.max())
    assert (again.correlation, again.share) == pytest.approx((there.correlation, there.share), abs=1e-3)


def test_shared_depth_errors_make_it_less_certain(views):
    exact = sharpened(*views, TRUTH)
    sigmas = error_sigmas(Config.preset("monocular").lifting)
    honest = sharpened(*views, TRUTH, sigmas=sigmas)
    gained = np.linalg.eigvalsh(honest.covariance - exact.covariance)
    assert gained[0] > -1e-3 * gained[-1] and np.trace(honest.covariance) > 4 * np.trace(exact.covariance)
    scaled = sharpened(*views, TRUTH, sigmas=np.eye(8)[0] * 0.03).covariance - exact.covariance
    assert np.sqrt(np.trace(scaled[:3, :3])) < 2 * 0.03 * np.linalg.norm(TRUTH[:3, 3]), "the parallax, no more"


@pytest.mark.parametrize("information", [1.0, 0.05])
def test_covariance_covers_the_errors_of_noisy_images(views, information):
    """Ten draws of pixel noise: the errors are at most what is claimed, and with full information not much less."""
    rng, values = np.random.default_rng(2), []
    for _ in range(10):
        noisy = [
            replace(view, brightness=view.brightness + 0.03 * rng.normal(size=view.depth.shape).astype(np.float32))
            for view in views
        ]
        found = sharpened(*noisy, se3_exp(STARTS[0]) @ TRUTH, information=information)
        np.testing.assert_allclose(found.covariance, found.covariance.T, atol=1e-18)
        assert np.linalg.eigvalsh(found.covariance)[0] > 0
        r = se3_log(TRUTH @ se3_inverse(found.T))
        values.append(r @ np.linalg.solve(found.covariance, r))
    assert 0.1 * information < np.mean(values) / 6 < 4 * max(information, 0.1)


def test_a_ramp_of_brightness_says_nothing_about_the_shift_along_it():
    """On a wall, a shift along it is another exposure, and exposure is free; texture closes what it leaves open."""
    v, u = np.mgrid[:120, :160].astype(np.float32)
    wall = Frustum(K, np.full(u.shape, 2.5, np.float32), 0.2 + 0.6 * u / 160)
    ramp = sharpened(wall, wall, np.eye(4))
    painted = sharpened(*(replace(wall, brightness=wall.brightness + 0.05 * np.sin(u) * np.sin(v)),) * 2, np.eye(4))
    assert ramp.covariance[0, 0] > 0.9 * NEAR[0, 0] > 100 * painted.covariance[0, 0]


@pytest.mark.parametrize("twist", STARTS, ids="+-")
def test_gradient_is_that_of_the_weighted_residuals(views, twist):
    """At fixed weights and fixed points, with the best exposure; slopes are smoothed, so not to the last digit."""
    x, y = (brightness.grid_of(view, 1) for view in views)
    T = se3_exp(0.5 * twist) @ TRUTH

    def pixels(pose):
        return brightness._pixels_of(x.points @ pose[:3, :3].T + pose[:3, 3], y)

    reach = [T, *(se3_exp(sign * 4e-3 * e) @ T for e in np.eye(6) for sign in (1, -1))]
    kept = np.isfinite([pixels(pose)[:, 0] for pose in reach]).all(axis=0)
    x = replace(x, points=x.points[kept], brightness=x.brightness[kept])
    exposure = np.stack([x.brightness, np.ones(kept.sum())], axis=1)
    _, weights = brightness._robust(brightness._sampled(y.image, *pixels(T).T), exposure, np.zeros(kept.sum()))

    def cost(pose):
        theirs = brightness._sampled(y.image, *pixels(pose).T)
        root = np.sqrt(weights)
        fit = np.linalg.lstsq(exposure * root[:, None], theirs * root, rcond=None)[0]
        return 0.5 * weights @ np.square(theirs - exposure @ fit)

    size = 2e-3
    numeric = [(cost(se3_exp(size * e) @ T) - cost(se3_exp(-size * e) @ T)) / (2 * size) for e in np.eye(6)]
    got = brightness._compared(x, y, T)
    scale = np.sqrt(np.diag(got.information))
    error = np.linalg.norm((-got.gradient - numeric) / scale) / np.linalg.norm(numeric / scale)
    assert error < 0.05, "and downhill is where the gradient of the normal equations points"
