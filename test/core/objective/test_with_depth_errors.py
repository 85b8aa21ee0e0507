# SPDX-License-Identifier: Apache-2.0
"""Pose and depth errors together: right derivatives over all eighteen unknowns, and the errors are found."""

from dataclasses import replace
from functools import lru_cache

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from problems import INLINE, problem_of
from surfaces import DISTURBANCE, FREE, TRUTH, K, disturbed, off, random_mixture, random_pose, two_views

from garps_core import Config, Prior, Status, align_mixtures
from garps_core.config import Alignment, Rung
from garps_core.depth_errors import depth_modes, error_fields
from garps_core.geometry import inverted, se3_exp, se3_inverse, se3_log
from garps_core.mixture_alignment import weighted_start
from garps_core.mixtures.reconstruct import reconstruct
from garps_core.objective.pairs import pair_up, to_device
from garps_core.objective.shape import evaluate, row_information
from garps_core.objective.state import State
from garps_core.objective.with_depth_errors import MODES, backward_jacobian, corrected, evaluate_at, evaluate_jointly
from garps_core.solver import ladder
from garps_core.solver.ladder import two_way

DOUBLE = Config(dtype="float64")
MONOCULAR = Config.preset("monocular")
BY_SHAPE = MONOCULAR.replace({"alignment.brightness_measurements": 0.0})
SETTINGS = Alignment(outlier_floor=0.05, max_distance_m=2.0)
LOOSE = disturbed(covariance=100 * FREE)
POSE = random_pose(3, 0.1)
NONE = np.zeros(MODES)
SEEDS = st.integers(0, 10**6)


def pairs_of(rows_seed=1, partners_seed=2, T=POSE):
    rows, partners = (to_device(random_mixture(seed, 60), DOUBLE) for seed in (rows_seed, partners_seed))
    return pair_up(rows, partners, T, Rung(covariance_scale=2.0, components=1000, neighbours=9, steps=1), SETTINGS)


FORWARD, BACKWARD = pairs_of(), pairs_of(2, 1, se3_inverse(POSE))


def numeric_gradient(function, at):
    """Central differences of function(State) over a state's step."""
    steps = 1e-5 * np.eye(6 + len(at.errors))
    return np.array([(function(at.moved(step)) - function(at.moved(-step))) / 2e-5 for step in steps])


def drawn(seed, size):
    return size * np.random.default_rng([seed, 5]).normal(size=2 * MODES)


@settings(max_examples=10)
@given(SEEDS)
def test_gradient_over_eighteen_unknowns_is_that_of_central_differences(seed):
    """No errors beyond those that the pairs are corrected by already: then nothing is approximated."""
    at = State(se3_exp(drawn(seed, 0.02)[:6]) @ POSE, np.zeros(2 * MODES))
    got = evaluate_at(FORWARD, at)
    assert got.gradient.shape == (18,) and got.information.shape == got.observed.shape == (18, 18)
    numeric = numeric_gradient(lambda there: evaluate_at(FORWARD, there).value, at)
    np.testing.assert_allclose(got.gradient, numeric, atol=1e-6 * np.abs(numeric).max())


@settings(max_examples=5)
@given(SEEDS)
def test_gradient_of_both_directions_follows_a_partner_s_field_at_its_row_s_place(seed):
    """With errors of 3 per cent in both maps it is off by about their own size: the slope of the fields is left out."""
    sizes = []
    for size in (0.0, 0.03):
        at = State(POSE, drawn(seed, size))
        numeric = numeric_gradient(lambda there: two_way(FORWARD, BACKWARD, there, INLINE).value, at)
        got = two_way(FORWARD, BACKWARD, at, INLINE)
        scale = np.sqrt(np.diag(got.information))
        sizes.append(np.linalg.norm((got.gradient - numeric) / scale) / np.linalg.norm(numeric / scale))
    assert sizes[0] < 1e-6 < sizes[1] < 0.15


def test_without_errors_it_is_the_objective_of_the_pose():
    plain = evaluate(FORWARD, POSE, "log")
    alone = evaluate_at(FORWARD, State(POSE))
    together = evaluate_jointly(FORWARD, POSE, NONE, NONE)
    np.testing.assert_array_equal(alone.gradient, plain.gradient)
    for name in ("value", "support"):
        assert getattr(together, name) == pytest.approx(getattr(plain, name), rel=1e-12)
    np.testing.assert_allclose(together.gradient[:6], plain.gradient, atol=1e-12 * np.abs(plain.gradient).max())
    for name in ("information", "observed"):
        whole, block = getattr(together, name), getattr(plain, name)
        np.testing.assert_allclose(whole[:6, :6], block, atol=1e-12 * np.abs(block).max())
        np.testing.assert_allclose(whole, whole.T, atol=1e-9 * np.abs(whole).max())


def test_information_is_the_sum_over_rows_of_what_each_measures():
    """J' Q J written out, J = [I, -[mu']x, (R p) phi, -mu' psi]."""
    Q, mu = row_information(FORWARD, POSE)
    own = FORWARD.means.numpy()
    rows = POSE[:3, :3] @ error_fields(own)[:, :, :MODES]
    turn = np.stack([np.cross(axis, mu) for axis in np.eye(3)], axis=2)
    J = np.concatenate([np.broadcast_to(np.eye(3), Q.shape), turn, rows, -error_fields(mu)[:, :, :MODES]], axis=2)
    expected = (J.transpose(0, 2, 1) @ Q @ J).sum(0)
    got = evaluate_jointly(FORWARD, POSE, NONE, NONE).information
    np.testing.assert_allclose(got, expected, atol=1e-10 * np.abs(expected).max())


@settings(max_examples=10)
@given(SEEDS)
def test_swapping_the_views_swaps_the_unknowns(seed):
    """Value and derivatives of the swapped problem, seen through `backward_jacobian`, are those of the problem."""
    at = State(random_pose(seed, 0.02) @ POSE, drawn(seed, 0.02))
    back = State(se3_inverse(at.T), np.roll(at.errors, MODES))
    e, swapped = two_way(FORWARD, BACKWARD, at, INLINE), two_way(BACKWARD, FORWARD, back, INLINE)
    B = backward_jacobian(at.T, 2 * MODES)
    assert swapped.value == pytest.approx(e.value, rel=1e-12)
    np.testing.assert_allclose(B.T @ swapped.gradient, e.gradient, atol=1e-11 * np.abs(e.gradient).max())
    for name in ("information", "observed"):
        got, expected = B.T @ getattr(swapped, name) @ B, getattr(e, name)
        np.testing.assert_allclose(got, expected, atol=1e-11 * np.abs(expected).max())


@pytest.mark.parametrize("errors", [0, 2 * MODES])
def test_backward_jacobian_is_the_derivative_of_swapping(errors):
    at = State(random_pose(8), drawn(8, 0.02)[:errors])
    back = se3_inverse(at.T)

    def swapped(step):
        there = at.moved(step)
        twist = se3_log(se3_inverse(there.T) @ se3_inverse(back))
        return np.concatenate([twist, np.roll(there.errors - at.errors, errors // 2)])

    numeric = [(swapped(1e-6 * e) - swapped(-1e-6 * e)) / 2e-6 for e in np.eye(6 + errors)]
    np.testing.assert_allclose(backward_jacobian(at.T, errors), np.transpose(numeric), atol=1e-8)


def test_corrected_points_stay_on_their_rays():
    cloud = to_device(random_mixture(4, 100), DOUBLE)
    errors = drawn(4, 0.03)[:MODES]
    there = corrected(cloud, errors)
    gain = there.means / cloud.means
    np.testing.assert_allclose(gain[:, 0], gain[:, 2], rtol=1e-12)
    np.testing.assert_allclose(gain[:, 1], gain[:, 2], rtol=1e-12)
    expected = 1 + depth_modes(cloud.means) @ torch.from_numpy(errors)
    np.testing.assert_allclose(gain[:, 2], expected, rtol=1e-12)
    assert gain.std() > 0.01
    assert there.covariances is cloud.covariances and corrected(cloud, np.zeros(0)) is cloud
    single = to_device(random_mixture(4, 100), Config())
    assert corrected(single, errors).means.dtype == torch.float32


def test_correcting_the_clouds_is_evaluating_with_the_errors():
    """Of the rows to the last digit: what the solver does between its rungs changes nothing."""
    rows, partners = (to_device(random_mixture(seed, 60), DOUBLE) for seed in (1, 2))
    errors, rung, far = (
        drawn(6, 0.03)[:MODES],
        Rung(covariance_scale=2.0, components=1000, neighbours=60, steps=1),
        replace(SETTINGS, max_distance_m=100.0),
    )
    of_corrected = pair_up(corrected(rows, errors), partners, POSE, rung, far)
    plain = pair_up(rows, partners, POSE, rung, far)
    got = evaluate_jointly(of_corrected, POSE, NONE, NONE)
    expected = evaluate_jointly(plain, POSE, errors, NONE)
    assert got.value == pytest.approx(expected.value, rel=1e-12)
    assert got.value != pytest.approx(evaluate_jointly(plain, POSE, NONE, NONE).value, rel=1e-3)


@lru_cache(maxsize=4)
def wrong_in_scale(gains=(1.03, 0.99), shapes=(0.0, 0.0)):
    """Both views with depth off by a factor each, 4 per cent between them, and bent by so much at the border."""
    views = []
    for view, gain, shape in zip(two_views(camera=np.diag([2, 2, 1]) @ K, size=(240, 320)), gains, shapes, strict=True):
        across = np.linspace(-1, 1, view.depth.shape[1], dtype=np.float32)
        views.append(replace(view, depth=view.depth * np.float32(gain) * (1 + np.float32(shape) * across**2)))
    return [reconstruct(view, MONOCULAR) for view in views]


def solved(mixtures, config, prior):
    (solution,) = ladder.anneal(problem_of(mixtures, weighted_start(prior, config), config))
    return solution


@pytest.mark.parametrize("gains", [(1.03, 0.99), (0.96, 1.0)])
def test_a_scale_error_between_the_maps_is_found(gains):
    errors = solved(wrong_in_scale(gains), MONOCULAR, LOOSE).at.errors
    apart = (1 + errors[0]) / (1 + errors[MODES])
    assert apart == pytest.approx(gains[1] / gains[0], abs=0.01)
    assert np.abs(np.delete(errors, [0, MODES])).max() < 0.015, "and no shape is made up"


def test_the_pose_is_better_where_depth_errors_are_solved_for():
    mixtures = wrong_in_scale()
    rigid = align_mixtures(*mixtures, LOOSE, BY_SHAPE.replace({"alignment.depth_errors": False}))
    free = align_mixtures(*mixtures, LOOSE, BY_SHAPE)
    errors = [off(estimate.T_target_source, TRUTH)[0] for estimate in (rigid, free)]
    assert free.status is Status.CONVERGED
    assert errors[1] < 0.02 and errors[1] < 0.25 * errors[0]


def test_maps_that_bend_are_straightened():
    mixtures = wrong_in_scale((1.0, 1.0), (0.03, -0.02))
    solution = solved(mixtures, MONOCULAR, LOOSE)
    bend = solution.at.errors[[3, MODES + 3]] @ (1, -1)
    assert bend < -0.02, "x^2, which is 0.05 apart, less in the overlap"
    rigid = solved(mixtures, MONOCULAR.replace({"alignment.depth_errors": False}), LOOSE)
    assert off(solution.T, TRUTH)[0] < 0.6 * off(rigid.T, TRUTH)[0]


def test_swapped_views_give_the_inverse_pose_and_covariance_with_depth_errors():
    config, mixtures = BY_SHAPE.replace({"dtype": "float64", "alignment.tolerance": 1e-5}), wrong_in_scale()
    prior = disturbed(twist=0.5 * DISTURBANCE)
    back = Prior(se3_inverse(prior.T_target_source), inverted(prior.covariance, prior.T_target_source))
    there, again = align_mixtures(*mixtures, prior, config), align_mixtures(*mixtures[::-1], back, config)
    assert max(off(se3_inverse(again.T_target_source), there.T_target_source)) < 1e-6
    expected = inverted(there.covariance, there.T_target_source)
    np.testing.assert_allclose(again.covariance, expected, atol=0.02 * np.abs(expected).max())


def test_exact_maps_keep_their_shape():
    """Nothing is wrong, so hardly anything is corrected and the pose is as good as without."""
    solution = solved(wrong_in_scale((1.0, 1.0)), MONOCULAR, LOOSE)
    assert np.abs(solution.at.errors).max() < 0.002 and off(solution.T, TRUTH)[0] < 5e-3


def test_depth_errors_are_not_solved_for_unless_asked():
    assert len(weighted_start(disturbed(), Config()).error_precision) == 0
    assert len(weighted_start(disturbed(), MONOCULAR).error_precision) == 2 * MODES
    paper = Config.preset("paper").replace({"alignment.depth_errors": True})
    assert len(weighted_start(disturbed(), paper).error_precision) == 0, "the paper has no such unknowns"
