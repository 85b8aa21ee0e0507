# SPDX-License-Identifier: Apache-2.0
"""From two views to a pose: the public interface as a whole, on rendered rooms and on a recorded camera."""

import inspect

import numpy as np
import pytest
import torch
from places import DATA
from surfaces import FREE, TRUTH, disturbed, grey_at, look, off, room, two_mixtures

import garps_core
from garps_core import Config, Mixture, PoseEstimate, Prior, Status, View, align_mixtures, estimate_relative_pose
from garps_core.metrics import nees, rotation_error_deg, translation_error_m
from garps_core.mixtures.reconstruct import reconstruct
from garps_core.start.initialise import initialise

PUBLIC = {
    "Config": ["reconstruction", "lifting", "start", "alignment", "paper", "method", "device", "dtype", "seed"],
    "ConfigError": None,
    "Estimator": ["config", "networks"],
    "GarpsError": None,
    "InputError": None,
    "Mixture": ["means", "covariances", "weights", "colours", "labels", "frustum"],
    "PoseEstimate": [
        "status", "reason", "T_target_source", "covariance", "initial", "overlap", "iterations", "objective", "quality",
        "agreement", "seconds", "estimated_fx_px", "depth_from",
    ],
    "Prior": ["T_target_source", "covariance", "origin", "reason"],
    "ReconstructionError": None,
    "Status": None,
    "View": ["rgb", "K", "depth", "stamp_ns", "frame_id", "K_estimated"],
    "align_mixtures": ["source", "target", "initial", "config"],
    "estimate_relative_pose": ["source", "target", "config", "prior"],
    "reconstruct": ["view", "config", "networks"],
}  # fmt: skip
MEANT_SENSOR = {"lifting.noise_floor_m": 1e-3, "lifting.noise_linear": 0.0, "lifting.noise_quadratic_per_m": 2e-3}


@pytest.fixture(scope="module")
def sensor_pair():
    return room(1, 2, "sensor")


@pytest.fixture(scope="module")
def estimate(sensor_pair):
    return estimate_relative_pose(*sensor_pair[:2], Config().replace(MEANT_SENSOR))


def test_the_public_interface_is_exactly_this():
    assert garps_core.__all__ == sorted(PUBLIC)
    for name, parameters in PUBLIC.items():
        thing = getattr(garps_core, name)
        assert thing.__doc__ and not thing.__doc__.startswith(f"{name}("), name
        if parameters is not None:
            assert list(inspect.signature(thing).parameters) == parameters, name


def test_every_status_says_what_it_means():
    assert {status.value for status in Status} == {
        "converged", "max_iterations", "degenerate", "inconsistent", "low_overlap", "no_mixture", "no_initial_pose",
        "poor_fit",
    }  # fmt: skip
    for status in Status:
        assert PoseEstimate(status, "").ok == (status is Status.CONVERGED)


def test_an_estimate_without_a_pose_is_no_identity_in_disguise():
    nothing = PoseEstimate(Status.LOW_OVERLAP, "nothing shared")
    assert nothing.T_target_source is None and nothing.covariance is None and nothing.initial is None
    assert np.isnan(nothing.objective) and nothing.overlap == nothing.quality == 0 and nothing.seconds == {}


def test_pose_from_sensor_depth(sensor_pair, estimate):
    truth = sensor_pair[2]
    assert estimate.status is Status.CONVERGED and estimate.ok
    assert translation_error_m(estimate.T_target_source, truth) < 0.012
    assert rotation_error_deg(estimate.T_target_source, truth) < 0.3
    assert nees(estimate.T_target_source, estimate.covariance, truth) < 25
    assert estimate.initial.origin == "features"


def test_an_estimate_is_complete(estimate):
    T = estimate.T_target_source
    assert T.shape == (4, 4) and T.dtype == np.float64 and estimate.covariance.shape == (6, 6)
    np.testing.assert_allclose(T[:3, :3].T @ T[:3, :3], np.eye(3), atol=1e-9)
    np.testing.assert_array_equal(T[3], [0, 0, 0, 1])
    assert set(estimate.seconds) == {"reconstruct", "initialise", "align"}
    assert all(seconds > 0 for seconds in estimate.seconds.values())
    assert 0 < estimate.overlap <= 1 and estimate.iterations > 0 and np.isfinite(estimate.objective)
    assert "converged in" in estimate.reason and "\n" not in estimate.reason


def test_covariance_comes_in_metres_then_radians(estimate):
    """A camera in a room: centimetres come before milliradians, and the off-diagonal block ties them together."""
    sigmas = np.sqrt(np.diag(estimate.covariance))
    assert (sigmas[:3] > sigmas[3:].max()).all() and sigmas.max() < 0.05
    assert np.linalg.eigvalsh(estimate.covariance)[0] > 0


def test_alignment_improves_on_the_start_where_depth_is_good():
    better = []
    for seed, level in ((1, 1), (1, 2), (2, 1), (2, 2)):
        source, target, truth = room(seed, level)
        estimate = estimate_relative_pose(source, target)
        assert estimate.ok, estimate.reason
        error = translation_error_m(estimate.T_target_source, truth)
        assert error < 0.012 and rotation_error_deg(estimate.T_target_source, truth) < 0.25
        better.append(error / translation_error_m(estimate.initial.T_target_source, truth))
    assert np.median(better) < 0.9 and max(better) < 1.3


def test_pose_from_monocular_depth():
    source, target, truth = room(1, 1, "monocular")
    estimate = estimate_relative_pose(source, target, Config.preset("monocular"))
    assert estimate.ok and estimate.initial.origin == "features"
    assert translation_error_m(estimate.T_target_source, truth) < 0.015
    assert rotation_error_deg(estimate.T_target_source, truth) < 0.25
    assert nees(estimate.T_target_source, estimate.covariance, truth) < 25
    without = estimate_relative_pose(
        source, target, Config.preset("monocular").replace({"alignment.brightness_measurements": 0.0})
    )
    assert np.trace(estimate.covariance[:3, :3]) < 0.9 * np.trace(without.covariance[:3, :3]), (
        "brightness narrows the covariance"
    )


def test_depth_that_is_worse_than_the_settings_say_gives_no_wrong_pose():
    """A network's depth taken for a sensor's: from features the fit is poor, and no other start does better.

    Brightness agrees to 0.99 where features led, and to 0.81 where the search from identity leads, 0.26 m off.
    """
    source, target, truth = room(1, 1, "monocular")
    estimate = estimate_relative_pose(source, target)
    assert translation_error_m(estimate.T_target_source, truth) < 0.03 or not estimate.ok


def test_a_given_prior_and_features_are_one_start(sensor_pair):
    source, target, truth = sensor_pair
    prior = disturbed(truth, twist=[0.03, -0.02, 0.02, 0.005, 0.004, -0.006])
    estimate = estimate_relative_pose(source, target, prior=prior)
    assert estimate.ok and estimate.initial.origin == "given and features"
    assert translation_error_m(estimate.initial.T_target_source, truth) < 0.012
    assert translation_error_m(estimate.T_target_source, truth) < 0.012
    as_given = estimate_relative_pose(source, target, Config().replace({"start.features": False}), prior)
    assert as_given.ok and as_given.initial is prior
    assert translation_error_m(as_given.T_target_source, truth) < 0.02


@pytest.mark.parametrize("sigma_m", [0.003, 0.1])
def test_features_overrule_a_given_prior_that_is_wrong(sensor_pair, sigma_m):
    """Half a metre off: both are tried, and the views say which is right."""
    source, target, truth = sensor_pair
    prior = disturbed(truth, twist=[0.5, 0, 0, 0, 0.1, 0], covariance=FREE * (sigma_m / 0.1) ** 2)
    estimate = estimate_relative_pose(source, target, prior=prior)
    assert estimate.ok and estimate.initial.origin == "features" and "contradicts" in estimate.initial.reason
    assert translation_error_m(estimate.T_target_source, truth) < 0.012


def test_whole_pipeline_is_its_parts(sensor_pair, estimate):
    source, target, _ = sensor_pair
    config = Config().replace(MEANT_SENSOR)
    (start,) = initialise(source, target, config)
    parts = align_mixtures(reconstruct(source, config), reconstruct(target, config), start, config)
    np.testing.assert_array_equal(parts.T_target_source, estimate.T_target_source)
    np.testing.assert_array_equal(parts.covariance, estimate.covariance)


def test_swapped_views_give_the_inverse_pose_within_their_uncertainty(sensor_pair, estimate):
    """The starts differ, since feature matching is not symmetric; the estimates agree as well as they claim."""
    source, target, _ = sensor_pair
    back = estimate_relative_pose(target, source, Config().replace(MEANT_SENSOR))
    metres, radians = off(np.linalg.inv(back.T_target_source), estimate.T_target_source)
    sigmas = np.sqrt(np.diag(estimate.covariance))
    assert metres < 2 * np.linalg.norm(sigmas[:3]) and radians < 2 * np.linalg.norm(sigmas[3:])


def test_views_without_texture_align_by_their_shape():
    """No feature anywhere: the identity start is all there is, and the surface's relief is enough."""
    truth = np.eye(4)
    truth[:3, 3] = (0.05, -0.02, 0.03)
    estimate = estimate_relative_pose(look(truth, colours=grey_at), look(colours=grey_at))
    assert estimate.initial.origin == "identity" and "features failed" in estimate.initial.reason
    assert off(estimate.T_target_source, truth)[0] < 2e-3 and estimate.ok


def test_views_that_look_away_from_each_other_have_no_pose(sensor_pair):
    source, target, truth = sensor_pair
    away = truth.copy()
    away[:3, :3] = np.diag([-1.0, 1, -1]) @ truth[:3, :3]
    alone = Config().replace({"start.features": False})
    estimate = estimate_relative_pose(source, target, alone, Prior(away, FREE))
    assert estimate.status is Status.LOW_OVERLAP
    assert estimate.T_target_source is None and estimate.covariance is None and estimate.initial is not None
    assert {"reconstruct", "initialise"} <= set(estimate.seconds)


def test_mixtures_from_elsewhere_need_no_camera():
    """float64, no frustum, with labels, made by hand: what another reconstruction would hand over."""
    source, target = (
        Mixture(
            m.means.astype(float), m.covariances.astype(float), m.weights, m.colours, np.zeros(len(m), np.int64)
        )
        for m in two_mixtures()
    )  # fmt: skip
    estimate = align_mixtures(source, target, disturbed())
    assert estimate.ok and estimate.overlap == 1 and set(estimate.seconds) == {"align"}
    assert off(estimate.T_target_source, TRUTH)[0] < 4e-3


def test_the_inputs_stay_as_they_were():
    mixtures = two_mixtures()
    prior = disturbed()
    before = [m.means.copy() for m in mixtures], [m.covariances.copy() for m in mixtures], prior.T_target_source.copy()
    align_mixtures(*mixtures, prior)
    for old, new in zip(
        before[0] + before[1], [m.means for m in mixtures] + [m.covariances for m in mixtures], strict=True
    ):
        np.testing.assert_array_equal(old, new)
    np.testing.assert_array_equal(before[2], prior.T_target_source)


@pytest.mark.parametrize(("preset", "within_m"), [("default", 0.01), ("monocular", 0.06)])
def test_images_of_different_size_and_intrinsics_are_fine(preset, within_m):
    other = np.array([[90.0, 0, 45], [0, 100, 40], [0, 0, 1]])
    source, target = look(TRUTH, camera=other, size=(80, 100)), look()
    estimate = estimate_relative_pose(source, target, Config.preset(preset), disturbed())
    assert estimate.ok and off(estimate.T_target_source, TRUTH)[0] < within_m
    assert off(disturbed().T_target_source, TRUTH)[0] > 0.09


def test_float32_agrees_with_float64():
    mixtures = two_mixtures()
    single, double = (align_mixtures(*mixtures, disturbed(), Config(dtype=dtype)) for dtype in ("float32", "float64"))
    assert max(off(single.T_target_source, double.T_target_source)) < 1e-4
    assert single.T_target_source.tobytes() != double.T_target_source.tobytes(), "or one was not used"


@pytest.mark.gpu
@pytest.mark.skipif(not torch.cuda.is_available(), reason="no CUDA device")
@pytest.mark.parametrize("preset", ["default", "monocular", "paper"])
def test_cuda_agrees_with_the_cpu(preset):
    """Neighbours at equal distances may be chosen differently, so not to the last bit."""
    config = Config.preset(preset)
    if preset == "paper":
        config = config.replace({"paper.steps": 20, "paper.component_stride": 4})
    mixtures = two_mixtures(config=config)
    cpu = align_mixtures(*mixtures, disturbed(), config)
    cuda = align_mixtures(*mixtures, disturbed(), config.replace({"device": "cuda"}))
    assert cuda.status is cpu.status and cuda.overlap == pytest.approx(cpu.overlap, abs=1e-3)
    assert max(off(cuda.T_target_source, cpu.T_target_source)) < 1e-4
    np.testing.assert_allclose(cuda.covariance, cpu.covariance, atol=0.02 * np.abs(cpu.covariance).max())


@pytest.mark.skipif(torch.cuda.is_available(), reason="CUDA is there")
def test_cuda_that_is_not_there_is_named():
    with pytest.raises(garps_core.ConfigError, match=r"device is 'cuda'.*: expected one of cpu\. Set"):
        align_mixtures(*two_mixtures(), disturbed(), Config(device="cuda"))


def lounge_pairs():
    """Three pairs of a recorded RGB-D camera; skipped where the recordings are not."""
    pairs_json = pytest.importorskip("bench.pairs.readers.pairs_json")
    if "hololens_lounge" not in pairs_json.available(DATA):
        pytest.skip(f"no recorded pairs in {DATA}/dev/hololens_lounge")
    return pairs_json.load_pairs("hololens_lounge", DATA, limit=3)


def test_recorded_pairs_from_features():
    """The ground truth of these recordings resolves about 1 to 3 cm."""
    for pair in lounge_pairs():
        estimate = estimate_relative_pose(pair.source, pair.target)
        assert estimate.ok, f"{pair.id}: {estimate.reason}"
        assert translation_error_m(estimate.T_target_source, pair.T_target_source) < 0.06, pair.id
        assert rotation_error_deg(estimate.T_target_source, pair.T_target_source) < 1.2, pair.id


def test_recorded_pairs_from_a_disturbed_truth():
    starts = pytest.importorskip("bench.pairs.starts")
    for pair in lounge_pairs():
        prior = starts.disturbed_prior(pair)
        start = translation_error_m(prior.T_target_source, pair.T_target_source)
        estimate = estimate_relative_pose(pair.source, pair.target, prior=prior)
        assert estimate.T_target_source is not None, f"{pair.id}: {estimate.reason}"
        assert translation_error_m(estimate.T_target_source, pair.T_target_source) < 0.5 * start, pair.id


def test_a_view_is_a_view_whoever_made_it():
    """A grey image over three channels and depth in float64 are enough."""
    view = look()
    grey = np.repeat(view.rgb.mean(axis=2, keepdims=True).astype(np.uint8), 3, axis=2)
    same = View(grey, view.K.tolist(), view.depth.astype(np.float64), 5, "camera")
    estimate = estimate_relative_pose(same, same, prior=disturbed(np.eye(4)))
    assert off(estimate.T_target_source, np.eye(4))[0] < 1e-3
