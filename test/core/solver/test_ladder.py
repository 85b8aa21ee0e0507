# SPDX-License-Identifier: Apache-2.0
"""The solver finds the pose, in either direction and in any frame, and tells when there is none."""

import os
import signal
import threading
from dataclasses import replace

import numpy as np
import pytest
import surfaces
from hypothesis import given, settings
from hypothesis import strategies as st
from problems import INLINE, problem_of
from surfaces import DISTURBANCE, FREE, TRUTH, disturbed, flat, grey_at, moved, off, permuted, random_pose, two_mixtures

from garps_core import Config, Prior, Status, align_mixtures
from garps_core.config import Rung
from garps_core.geometry import adjoint, inverted, ros_from_twist, se3_exp, se3_inverse, se3_log, twist_from_ros
from garps_core.objective.pairs import overlap, to_device, visible
from garps_core.objective.state import State, WeightedStart
from garps_core.solver import ladder

DOUBLE = Config(dtype="float64")
EXACT = DOUBLE.replace({"alignment.tolerance": 1e-7})
LADDER = Config().alignment.ladder
SMALL = {"camera": np.diag([0.5, 0.5, 1]) @ surfaces.K, "size": (60, 80)}
SEEDS = st.integers(0, 10**6)


@pytest.fixture(scope="module")
def views():
    return two_mixtures()


@pytest.fixture(scope="module")
def small():
    """1200 components per view."""
    return two_mixtures(**SMALL, dtype=np.float64)


@pytest.fixture(scope="module")
def rung(views):
    """Pairs of the last rung in both directions at a disturbed start, and the start's pose."""
    start = disturbed(twist=0.2 * DISTURBANCE).T_target_source
    return *ladder.rung_pairs(problem_of(views, config=DOUBLE), start, LADDER[-1], density=1.0), start


def test_the_start_is_as_far_off_as_it_claims():
    metres, radians = off(disturbed().T_target_source, TRUTH)
    assert 0.08 < metres < 0.15 and 0.9 < np.degrees(radians) < 1.2


def test_truth_is_recovered_to_less_than_a_millimetre(views):
    estimate = align_mixtures(*views, disturbed())
    metres, radians = off(estimate.T_target_source, TRUTH)
    assert estimate.status is Status.CONVERGED and estimate.ok
    assert metres < 1e-3 and radians < 5e-4
    assert 0.7 < estimate.overlap < 0.9 and estimate.iterations > 2


def test_without_knowing_what_the_cameras_see_it_is_still_a_few_millimetres():
    estimate = align_mixtures(*two_mixtures(frustum=False), disturbed())
    metres, radians = off(estimate.T_target_source, TRUTH)
    assert estimate.ok and metres < 4e-3 and radians < 2e-3 and estimate.overlap == 1


def test_two_copies_of_one_mixture_fall_together(small):
    target = replace(small[1], frustum=None)
    estimate = align_mixtures(moved(target, se3_inverse(TRUTH)), target, disturbed(covariance=1e4 * FREE), EXACT)
    metres, radians = off(estimate.T_target_source, TRUTH)
    assert metres < 1e-5 and radians < 1e-5


def test_swapping_the_views_gives_the_inverse_pose_and_covariance(views):
    prior = disturbed()
    back = Prior(se3_inverse(prior.T_target_source), inverted(prior.covariance, prior.T_target_source))
    there, again = align_mixtures(*views, prior, DOUBLE), align_mixtures(*views[::-1], back, DOUBLE)
    assert max(off(se3_inverse(again.T_target_source), there.T_target_source)) < 1e-6
    assert again.objective == pytest.approx(there.objective, rel=1e-6)
    assert again.overlap == pytest.approx(there.overlap)
    expected = inverted(there.covariance, there.T_target_source)
    np.testing.assert_allclose(again.covariance, expected, atol=0.02 * np.abs(expected).max())


def test_moving_the_target_frame_moves_the_estimate_with_it(small):
    """Without a camera no frame is special; shared depth errors, which have one, are off."""
    source, target = (replace(mixture, frustum=None) for mixture in small)
    config = EXACT.replace({f"lifting.{name}": 0.0 for name in ("scale_sigma", "warp_sigma", "pointing_sigma_rad")})
    B = random_pose(9, 1.0)
    prior = disturbed()
    twist = twist_from_ros(prior.covariance, prior.T_target_source)

    def carried(covariance, T):
        return ros_from_twist(adjoint(B) @ covariance @ adjoint(B).T, B @ T)

    plain = align_mixtures(source, target, prior, config)
    start = Prior(B @ prior.T_target_source, carried(twist, prior.T_target_source))
    other = align_mixtures(source, moved(target, B), start, config)
    assert max(off(se3_inverse(B) @ other.T_target_source, plain.T_target_source)) < 2e-6
    expected = carried(twist_from_ros(plain.covariance, plain.T_target_source), plain.T_target_source)
    np.testing.assert_allclose(other.covariance, expected, atol=1e-4 * np.abs(expected).max())


def test_order_of_components_does_not_matter(small):
    few = [mixture.subset(np.arange(0, len(mixture), 3)) for mixture in small]
    assert max(map(len, few)) <= min(rung.components for rung in LADDER), "or thinning would depend on the order"
    plain = align_mixtures(*few, disturbed(), DOUBLE)
    mixed = align_mixtures(permuted(few[0], 1), permuted(few[1], 2), disturbed(), DOUBLE)
    assert plain.T_target_source is not None
    assert max(off(mixed.T_target_source, plain.T_target_source)) < 1e-8
    assert mixed.objective == pytest.approx(plain.objective, rel=1e-10)


def test_the_same_input_gives_the_same_bits(small):
    runs = [align_mixtures(*small, disturbed()) for _ in range(10)]
    assert len({run.T_target_source.tobytes() for run in runs}) == 1
    assert len({run.covariance.tobytes() for run in runs}) == 1
    assert len({(run.objective, run.iterations, run.overlap) for run in runs}) == 1


def test_an_alignment_leaves_no_thread_behind(small):
    before = threading.active_count()
    align_mixtures(*small, disturbed())
    assert threading.active_count() == before


@pytest.mark.skipif(not hasattr(os, "fork"), reason="no fork on this system")
@pytest.mark.filterwarnings("ignore:.*fork.*")
def test_a_forked_child_aligns_as_its_parent_did(small):
    """A child of `fork` has none of its parent's threads: a pool that outlives the call would never answer it."""
    parent = align_mixtures(*small, disturbed()).T_target_source.tobytes()
    child = os.fork()
    if not child:
        signal.alarm(60)
        os._exit(align_mixtures(*small, disturbed()).T_target_source.tobytes() != parent)
    _, status = os.waitpid(child, 0)
    assert status == 0, "the child hung, or found another pose"


def test_views_that_share_nothing_have_no_pose(views):
    estimate = align_mixtures(*views, disturbed(twist=[0, 0, 0, 0, 1.5, 0]))
    assert estimate.status is Status.LOW_OVERLAP and not estimate.ok
    assert estimate.T_target_source is None and estimate.covariance is None
    assert estimate.overlap < 0.1 and "expected at least 10%" in estimate.reason


def test_less_overlap_than_required_is_no_pose(views):
    wanted = Config().replace({"alignment.min_overlap": 0.9})
    estimate = align_mixtures(*views, disturbed(), wanted)
    assert estimate.status is Status.LOW_OVERLAP and "share 78%" in estimate.reason


def test_few_components_seen_by_both_are_named_as_the_reason(small):
    sparse = [mixture.subset(np.arange(0, len(mixture), 20)) for mixture in small]
    estimate = align_mixtures(*sparse, disturbed())
    assert estimate.status is Status.LOW_OVERLAP and estimate.T_target_source is None
    assert "fewer than 50 components" in estimate.reason and estimate.overlap > 0.5


def wide(neighbours=50, uncertainty=0.012):
    """The default with more partners in the last rung, since cut-off partner sets look like texture."""
    ladder = (*LADDER[:-1], replace(LADDER[-1], neighbours=neighbours))
    return Config().replace({"alignment.ladder": ladder, "alignment.max_uncertainty": uncertainty})


def test_a_wall_without_texture_leaves_its_plane_open(views):
    """x, y and the turn about the normal are open, but not with relief."""
    loose = disturbed(twist=np.zeros(6), covariance=100 * FREE)
    wall = align_mixtures(*two_mixtures(surface=flat, colours=grey_at), loose, wide())
    relief = align_mixtures(*views, loose, wide())
    ratio = np.sqrt(np.diag(wall.covariance) / np.diag(relief.covariance))
    assert (ratio[[0, 1, 5]] > 1.8).all() and (ratio[[2, 3, 4]] < 1.1).all()
    assert wall.status is Status.DEGENERATE and "direction stays open" in wall.reason and not wall.ok
    assert wall.T_target_source is not None and relief.status is Status.CONVERGED


def test_texture_closes_the_plane():
    loose = disturbed(twist=np.zeros(6), covariance=100 * FREE)
    plain, painted = (
        align_mixtures(*two_mixtures(surface=flat, **scene), loose, wide()) for scene in ({"colours": grey_at}, {})
    )
    ratio = np.sqrt(np.diag(plain.covariance) / np.diag(painted.covariance))
    assert (ratio[[0, 1, 5]] > 1.5).all() and (ratio[[2, 3, 4]] < 1.1).all()


def test_a_prior_twenty_sigmas_off_is_called_inconsistent(views):
    tight = np.diag([0.005**2] * 3 + [0.002**2] * 3)
    estimate = align_mixtures(*views, disturbed(twist=[0.1, 0, 0, 0, 0, 0], covariance=tight))
    assert estimate.status is Status.INCONSISTENT and not estimate.ok
    assert "sigmas away from the start (8 allowed)" in estimate.reason
    near = align_mixtures(*views, disturbed(twist=[0.01, 0, 0, 0, 0, 0], covariance=tight))
    assert near.status is Status.CONVERGED


def test_too_few_steps_are_reported(views):
    hasty = Config().replace(
        {
            "alignment.ladder": (Rung(covariance_scale=10.0, components=2000, neighbours=12, steps=1),),
            "alignment.max_uncertainty": 1e6,
        }
    )
    estimate = align_mixtures(*views, disturbed(), hasty)
    assert estimate.status is Status.MAX_ITERATIONS and "still moving after 1 step" in estimate.reason
    assert estimate.T_target_source is not None and not estimate.ok


@settings(max_examples=10)
@given(SEEDS)
def test_an_ascent_never_loses_value(rung, seed):
    """It keeps the best of all poses that it tries, which is not worse than the start."""
    forward, backward, _ = rung
    start = random_pose(seed, 0.03) @ TRUTH
    tried = []

    def function(at):
        data = ladder.two_way(forward, backward, at, INLINE)
        tried.append(ladder.posterior(data, at, WeightedStart(start, np.linalg.inv(FREE)), 60.0))
        return tried[-1]

    end = ladder.ascend(function, State(start), 8, 1e-3)
    values = [there.value for there in tried]
    assert end.posterior.value == max(values) >= values[0]
    assert len(tried) == end.iterations + 1 and (end.converged or end.iterations == 8)


def test_an_optimum_reached_with_the_last_step_is_converged():
    """On a parabola a single Newton step reaches the optimum, all but the damping."""

    def function(at):
        gradient = -np.append(np.zeros(6), at.errors)
        return ladder.Posterior(-0.5 * float(at.errors @ at.errors), gradient, np.eye(8), None)

    end = ladder.ascend(function, State(np.eye(4), np.ones(2)), 1, 0.01)
    assert end.iterations == 1 and end.converged
    assert not ladder.ascend(function, State(np.eye(4), np.ones(2)), 1, 1e-4).converged
    assert not ladder.ascend(function, State(np.eye(4), np.ones(2)), 0, 0.01).converged


def test_an_ascent_stays_where_every_step_fails():
    """The gradient points the wrong way: every step is rejected, and the steps run out."""

    def function(at):
        r = se3_log(at.T)
        return ladder.Posterior(-float(r @ r), np.ones(6), np.eye(6), None)

    end = ladder.ascend(function, State(np.eye(4)), 12, 1e-6)
    np.testing.assert_array_equal(end.at.T, np.eye(4))
    assert 2 < end.iterations <= 12


@settings(max_examples=10)
@given(SEEDS)
def test_gradient_of_the_posterior_is_that_of_central_differences(rung, seed):
    forward, backward, T = rung
    rng = np.random.default_rng(seed)
    T_prior = se3_exp(0.1 * rng.normal(size=6)) @ T
    A = rng.normal(size=(6, 6))
    precision = 100 * (A @ A.T + np.eye(6))

    def at(twist):
        there = State(se3_exp(np.asarray(twist)) @ T)
        data = ladder.two_way(forward, backward, there, INLINE)
        return ladder.posterior(data, there, WeightedStart(T_prior, precision), 60.0)

    numeric = [(at(1e-5 * e).value - at(-1e-5 * e).value) / 2e-5 for e in np.eye(6)]
    gradient = at(np.zeros(6)).gradient
    np.testing.assert_allclose(gradient, numeric, atol=1e-6 * np.abs(gradient).max())


def test_information_of_the_posterior_is_the_data_s_plus_the_prior_s(rung):
    forward, backward, T = rung
    data = ladder.two_way(forward, backward, State(T), INLINE)
    alone = ladder.posterior(data, State(T), WeightedStart(T, np.zeros((6, 6))), 60.0)
    both = ladder.posterior(data, State(T), WeightedStart(T, np.linalg.inv(FREE)), 60.0)
    np.testing.assert_allclose(alone.information, 60 * ladder.curvature(data))
    np.testing.assert_allclose(both.information - alone.information, np.linalg.inv(FREE), atol=1e-6)


@given(SEEDS)
def test_inverse_left_jacobian_is_the_derivative_of_the_logarithm(seed):
    twist = np.random.default_rng(seed).normal(size=6) * 0.4
    T = se3_exp(twist)
    numeric = [(se3_log(se3_exp(1e-6 * e) @ T) - se3_log(se3_exp(-1e-6 * e) @ T)) / 2e-6 for e in np.eye(6)]
    np.testing.assert_allclose(ladder.inverse_left_jacobian(twist), np.transpose(numeric), atol=2e-5)
    assert np.abs(ladder.inverse_left_jacobian(twist) - np.eye(6)).max() > 1e-3, "or the identity would do"


def test_curvature_lies_between_its_bounds(rung):
    """The curvature is the observed information itself where that lies within the bounds."""
    forward, backward, T = rung
    data = ladder.two_way(forward, backward, State(T), INLINE)
    L = np.linalg.inv(np.linalg.cholesky(data.information))
    shares = np.linalg.eigvalsh(L @ ladder.curvature(data) @ L.T)
    observed = np.linalg.eigvalsh(L @ data.observed @ L.T)
    np.testing.assert_allclose(shares, np.clip(observed, ladder.SMALLEST_CURVATURE, 1), atol=1e-6)
    raised = np.linalg.eigvalsh(L @ ladder.curvature(data, 0.9) @ L.T)
    np.testing.assert_allclose(raised, np.clip(observed, 0.9, 1), atol=1e-6)
    assert observed[0] < 0.9


def test_displacement_is_that_of_points_moved_at_random():
    points = np.random.default_rng(0).normal((0, 0, 3), 1, (3, 3))
    covariance = np.diag([1, 4, 9, 0.1, 0.2, 0.3]) * 1e-6 + 5e-8
    rng = np.random.default_rng(1)
    twists = rng.multivariate_normal(np.zeros(6), covariance, size=20_000)
    moves = twists[:, None, :3] + np.cross(twists[:, None, 3:], points[None])
    for index, expected in enumerate(ladder.displacement(points, covariance)):
        np.testing.assert_allclose(np.cov(moves[:, index].T), expected, atol=0.05 * expected.max())


def test_a_precise_start_skips_the_wide_rungs(views):
    source = to_device(views[0], Config())
    entries = [ladder.entry(source, TRUTH, scale * FREE, LADDER) for scale in np.geomspace(1e3, 1e-4, 60)]
    assert entries == sorted(entries) and set(entries) == set(range(len(LADDER)))
    assert ladder.entry(source, TRUTH, 1e4 * FREE, LADDER) == 0
    assert ladder.entry(source, TRUTH, FREE, LADDER[:1]) == 0


def test_the_last_rung_alone_does_not_find_the_way(views):
    """From the same start, the finest rung by itself ends further off than the whole ladder."""
    annealing = Config().replace({"alignment.guess_uncertainty": 1e6})  # or a start this vague would be searched from
    start = disturbed(twist=3 * DISTURBANCE, covariance=9 * FREE)
    alone = align_mixtures(*views, start, annealing.replace({"alignment.ladder": LADDER[-1:]}))
    whole = align_mixtures(*views, start, annealing)
    assert off(whole.T_target_source, TRUTH)[0] < 1e-3 < off(alone.T_target_source, TRUTH)[0]


def test_a_camera_sees_its_own_components_and_none_behind_it(views):
    cloud = to_device(views[0], DOUBLE)
    frustum, turned = views[0].frustum, np.diag([1.0, -1, -1, 1])
    assert visible(cloud, np.eye(4), frustum, 0.1).double().mean() > 0.97
    assert not visible(cloud, turned, frustum, 0.1).any()
    behind = np.eye(4)
    behind[:3, :3] *= 1.3  # 30 per cent further along every ray: hidden by the surface
    assert not visible(cloud, behind, frustum, 0.1).any()
    assert visible(cloud, behind, None, 0.1).all()
    assert overlap(cloud, cloud, np.eye(4), DOUBLE.alignment) > 0.97
