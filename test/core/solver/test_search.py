# SPDX-License-Identifier: Apache-2.0
"""From a guess: the right pose is found, by shape alone if need be, and no pose where there is none."""

from dataclasses import replace

import numpy as np
import pytest
from problems import problem_of
from scipy.spatial.transform import Rotation
from surfaces import FREE, TRUTH, disturbed, off, random_pose, room, two_mixtures

from garps_core import Config, Status, align_mixtures, estimate_relative_pose
from garps_core.geometry import se3_inverse, se3_log
from garps_core.mixture_alignment import weighted_start
from garps_core.mixtures.reconstruct import reconstruct
from garps_core.objective.state import WeightedStart
from garps_core.solver import ladder, methods, search
from garps_core.start.identity_start import identity

FROM_IDENTITY = Config().replace({"start.method": "identity"})
LADDER_ONLY = FROM_IDENTITY.replace({"alignment.guess_uncertainty": 1e6})


def grey(view):
    """The view without texture: only its depth tells anything."""
    return replace(view, rgb=np.full_like(view.rgb, 128))


def start_at(sigma_rad, T):
    return WeightedStart(T, np.linalg.inv(np.diag([0.3**2] * 3 + [sigma_rad**2] * 3)))


@pytest.mark.parametrize("sigma", [0.05, 0.2])
def test_starting_poses_surround_the_guess_which_is_the_first(sigma):
    T = random_pose(1, 0.5)
    poses = search.starting_poses(start_at(sigma, T), search.RINGS)
    assert poses[0] is T and 9 <= len(poses) <= 40
    turns = np.array([Rotation.from_matrix((pose @ se3_inverse(T))[:3, :3]).as_rotvec() for pose in poses[1:]])
    sizes = np.linalg.norm(turns, axis=1) / sigma
    assert sizes.min() > 0.9 and 2.5 < sizes.max() < 4, "in sigmas of the guess"
    np.testing.assert_allclose(turns[:, 2], 0, atol=1e-12)
    np.testing.assert_allclose(turns.sum(0), 0, atol=1e-9)
    directions = np.sort(np.arctan2(turns[:, 1], turns[:, 0]))
    assert np.diff(directions, append=directions[0] + 2 * np.pi).max() < np.pi / 2 + 1e-9, "all around"
    for pose in poses:
        np.testing.assert_allclose((pose @ se3_inverse(T))[:3, 3], 0, atol=1e-12)


def test_shape_alone_is_found_from_twenty_degrees_away():
    """The pose is 0.6 m and 20 degrees from identity, where the ladder alone ends elsewhere."""
    source, target, truth = room(1, 4)
    assert off(truth, np.eye(4))[0] == pytest.approx(0.6) and np.degrees(off(truth, np.eye(4))[1]) > 19
    estimate = estimate_relative_pose(grey(source), grey(target), FROM_IDENTITY)
    metres, radians = off(estimate.T_target_source, truth)
    assert estimate.status is Status.CONVERGED and estimate.initial.origin == "identity"
    assert metres < 0.005 and np.degrees(radians) < 0.1
    annealed = estimate_relative_pose(grey(source), grey(target), LADDER_ONLY)
    assert not annealed.ok and off(annealed.T_target_source, truth)[0] > 0.2


def test_colours_and_brightness_do_not_mislead_it():
    source, target, truth = room(2, 4)
    estimate = estimate_relative_pose(source, target, FROM_IDENTITY)
    assert estimate.ok and off(estimate.T_target_source, truth)[0] < 0.005


@pytest.mark.parametrize("rooms", [(1, 2), (2, 1)])
def test_views_of_different_rooms_have_no_converged_pose(rooms):
    """Walls and floors of any two rooms coincide to a degree, so a pose after a guess needs more evidence."""
    source, target = (room(seed, 4)[view] for view, seed in enumerate(rooms))
    estimate = estimate_relative_pose(source, target, FROM_IDENTITY)
    assert not estimate.ok
    assert estimate.status in (Status.POOR_FIT, Status.LOW_OVERLAP, Status.INCONSISTENT), estimate.reason


def test_solutions_have_final_pairs_and_are_computed_only_when_asked_for(monkeypatch):
    source, target, truth = room(1, 4)
    start, asked = weighted_start(identity(Config(), ""), Config()), []
    problem = problem_of([reconstruct(view) for view in (source, target)], start)
    by_shape = search._by_shape
    monkeypatch.setattr(search, "_by_shape", lambda *given: asked.append(1) or by_shape(*given))
    solutions = search.search(problem)
    found = [next(solutions)]
    assert not asked, "the first is found by brightness"
    found += solutions
    assert asked and 1 < len(found) <= problem.settings.search_followed
    assert min(off(solution.T, truth)[0] for solution in found) < 0.005
    for solution in found:
        assert min(len(pairs.means) for pairs in solution.pairs) > 0
        assert solution.pairs[0].log_weights.shape[0] == ladder.FINAL_NEIGHBOURS
    fewer = replace(problem, config=problem.config.replace({"alignment.search_followed": 1}))
    (one,) = search.search(fewer)
    assert one.T.tobytes() == found[0].T.tobytes()


def test_a_convincing_solution_ends_the_search(monkeypatch):
    source, target, _ = room(1, 4)
    mixtures = [reconstruct(view) for view in (source, target)]
    start, followed, searched = identity(Config(), ""), {}, methods.search

    def counted(*given):
        for solution in searched(*given):
            followed[enough] = followed.get(enough, 0) + 1
            yield solution

    monkeypatch.setattr(methods, "search", counted)
    for enough in (-1.0, 1.0):
        config = Config().replace({"alignment.enough_correlation": enough, "alignment.brightness_measurements": 0.05})
        estimate = align_mixtures(*mixtures, start, config)
        assert (estimate.agreement > 0) and estimate.initial is start
    assert followed[-1.0] == 1 < followed[1.0]


def test_poses_that_lie_together_are_one():
    states = [ladder.State(T) for T in (random_pose(1), random_pose(2), random_pose(1, 0.3001), random_pose(2))]
    assert list(search._distinct(states)) == states[:2]
    assert np.linalg.norm(se3_log(states[0].T @ se3_inverse(states[1].T))) > search.SAME_RAD


def test_a_precise_start_is_not_searched_from(monkeypatch):
    """The uncertainty of scene points, as a share of their range, decides."""
    mixtures, calls = two_mixtures(), []
    searched = methods.search
    monkeypatch.setattr(methods, "search", lambda *given: calls.append(given) or searched(*given))
    assert align_mixtures(*mixtures, disturbed()).ok and not calls
    assert align_mixtures(*mixtures, disturbed(covariance=16 * FREE)).ok and len(calls) == 1


def test_from_a_guess_where_nothing_is_shared_there_is_no_pose():
    """Both look the other way, so every starting pose finds too few components."""
    away = np.diag([-1.0, 1, -1, 1]) @ TRUTH
    estimate = align_mixtures(*two_mixtures(), replace(identity(Config(), ""), T_target_source=away))
    assert estimate.status is Status.LOW_OVERLAP and estimate.T_target_source is None
    assert "expected at least 10%" in estimate.reason
