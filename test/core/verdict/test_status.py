# SPDX-License-Identifier: Apache-2.0
"""Verdicts: every status with its reason, the gravest first, and the quality as one number."""

from dataclasses import replace

import numpy as np
import pytest
from candidates import SMALL, candidate
from surfaces import TRUTH, disturbed, look, off, room

from garps_core import Config, Mixture, Prior, Status, estimate_relative_pose
from garps_core.config import Alignment
from garps_core.geometry import ros_from_twist, se3_exp
from garps_core.verdict.status import FIXED_STEPS_SUPPORT, quality, relative_uncertainty, verdict

SETTINGS = Alignment()
WIDE = np.diag([0.3**2] * 3 + [0.2**2] * 3)
START = Prior(np.eye(4), WIDE, "identity")


def status_of(found, start=START, guess=True, uncertainty=0.01, settings=SETTINGS):
    status, reason = verdict(found, start, guess, uncertainty, settings)
    assert reason and "\n" not in reason and not reason.endswith(".")
    return status, reason


def test_a_good_candidate_has_converged():
    assert status_of(candidate()) == (Status.CONVERGED, "converged in 17 steps, 0.7 sigmas from the start")


def test_a_pose_far_from_its_start_is_inconsistent():
    tight = Prior(np.eye(4), WIDE / 400, "given")
    status, reason = status_of(candidate(), tight, guess=False)
    assert status is Status.INCONSISTENT
    assert reason == "the views pull 14.7 sigmas away from the start (8 allowed)"
    assert (
        status_of(candidate(), tight, False, settings=replace(SETTINGS, max_prior_sigmas=20.0))[0] is Status.CONVERGED
    )


@pytest.mark.parametrize(
    ("guess", "correlation", "wanted"),
    [
        (False, None, SETTINGS.min_support),
        (False, 0.95, SETTINGS.min_support),
        (True, 0.95, SETTINGS.min_support),
        (True, None, SETTINGS.guess_support),
    ],
)
def test_few_components_with_a_partner_are_a_poor_fit(guess, correlation, wanted):
    """After a guess nearly all must have one, unless brightness was compared."""
    status, reason = status_of(candidate(support=wanted - 0.01, correlation=correlation), guess=guess)
    assert status is Status.POOR_FIT
    assert reason.startswith(f"{wanted - 0.01:.0%} of the components found a partner, expected {wanted:.0%} after")
    assert "(identity): possibly a wrong optimum, give a better prior" in reason
    assert status_of(candidate(support=wanted, correlation=correlation), guess=guess)[0] is Status.CONVERGED


@pytest.mark.parametrize(("guess", "least"), [(True, SETTINGS.guess_correlation), (False, SETTINGS.min_correlation)])
def test_brightness_that_disagrees_is_a_poor_fit(guess, least):
    status, reason = status_of(candidate(correlation=least - 0.19), guess=guess)
    assert status is Status.POOR_FIT
    wanted = f"brightness agrees to {least - 0.19:.2f} (correlation), expected {least:g} after this start (identity)"
    assert reason == f"{wanted}: possibly a wrong optimum, give a better prior"
    assert status_of(candidate(correlation=least), guess=guess)[0] is Status.CONVERGED
    assert status_of(candidate(correlation=None), guess=guess)[0] is Status.CONVERGED, "nothing to compare"


def test_an_open_direction_is_degenerate():
    status, reason = status_of(candidate(), uncertainty=0.0712)
    assert status is Status.DEGENERATE
    assert reason == "a direction stays open: scene points are uncertain by 7.1% of their range (5.0% allowed)"
    assert status_of(candidate(), uncertainty=0.0499)[0] is Status.CONVERGED


def test_a_solution_that_still_moves_has_too_few_steps():
    assert status_of(candidate(converged=False)) == (Status.MAX_ITERATIONS, "still moving after 17 steps")


def test_the_gravest_comes_first():
    """A candidate with every fault, which are put right one after the other."""
    bad = {"support": 0.1, "correlation": 0.1, "converged": False}
    tight, open_direction = Prior(np.eye(4), WIDE / 400, "given"), 0.2
    order = [status_of(candidate(**bad), tight, True, open_direction)]
    for name, start, uncertainty in (("", START, 0.2), ("support", START, 0.2), ("correlation", START, 0.2)):
        bad.pop(name, None)
        order.append(status_of(candidate(**bad), start, True, uncertainty))
    order.append(status_of(candidate(converged=False), START, True, 0.01))
    assert [status.value for status, _ in order] == [
        "inconsistent", "poor_fit", "poor_fit", "degenerate", "max_iterations",
    ]  # fmt: skip
    assert "partner" in order[1][1] and "brightness" in order[2][1]


def test_a_fixed_number_of_steps_has_converged():
    expected = "the paper's fixed number of steps, 17, 0.7 sigmas from the start"
    assert status_of(candidate(fixed_steps=True)) == (Status.CONVERGED, expected)


@pytest.mark.parametrize(
    ("fault", "start", "uncertainty", "status"),
    [
        ({}, Prior(np.eye(4), WIDE / 400, "given"), 0.01, Status.INCONSISTENT),
        ({"correlation": 0.5}, START, 0.01, Status.POOR_FIT),
        ({"support": FIXED_STEPS_SUPPORT - 0.01}, START, 0.01, Status.POOR_FIT),
        ({}, START, 0.0712, Status.DEGENERATE),
    ],
)
def test_a_fixed_number_of_steps_is_judged_as_any_other_solution(fault, start, uncertainty, status):
    assert status_of(candidate(**fault, fixed_steps=True), start, uncertainty=uncertainty)[0] is status


def test_relative_uncertainty_is_a_share_of_the_range():
    """A shift of all points by 5 cm sigma at 2.5 m is 2 per cent; a turn of 0.02 rad is 2 per cent at any range."""
    rng = np.random.default_rng(0)
    means = rng.normal(size=(2000, 3))
    means *= 2.5 / np.linalg.norm(means, axis=1)[:, None]
    ones = np.ones(2000)
    ball = Mixture(means, np.tile(1e-4 * np.eye(3), (2000, 1, 1)), ones, np.full((2000, 3), 0.5))
    none = 1e-18 * np.eye(6)
    shift, turn = none + np.diag([0.05**2] * 3 + [0] * 3), none + np.diag([0] * 3 + [0.02**2] * 3)
    assert relative_uncertainty(ball, np.eye(4), shift) == pytest.approx(0.02, rel=1e-3)
    assert relative_uncertainty(ball, np.eye(4), turn) == pytest.approx(0.02, rel=1e-3)
    T = se3_exp(np.array([0, 0, 10, 0, 0, 0]))
    assert relative_uncertainty(ball, T, shift) == pytest.approx(0.005, rel=0.1), "ranges are those in the target"
    assert relative_uncertainty(ball, T, ros_from_twist(turn, T)) == pytest.approx(0.02, rel=0.1)


WORSE = {
    "less precise": {"covariance": 225 * SMALL},
    "brightness agrees less": {"correlation": 0.6},
    "fewer components with a partner": {"support": 0.3},
}


@pytest.mark.parametrize("name", WORSE)
@pytest.mark.parametrize("guess", [False, True])
def test_quality_falls_with_everything_that_speaks_against_a_pose(name, guess):
    good, worse = quality(candidate(), guess), quality(candidate(**WORSE[name]), guess)
    assert 0 <= worse < 0.6 * good and 0.5 < good <= 1


@pytest.mark.parametrize("correlation", [-1.0, 0.0, 1.0, None])
@pytest.mark.parametrize("support", [0.0, 1.0])
@pytest.mark.parametrize("scale", [1e-12, 1.0, 1e12])
def test_quality_is_a_number_from_0_to_1(correlation, support, scale):
    for guess in (False, True):
        value = quality(candidate(support=support, correlation=correlation, covariance=scale * SMALL), guess)
        assert isinstance(value, float) and np.isfinite(value) and 0 <= value <= 1


def test_quality_of_a_right_pose_is_larger_than_of_a_wrong_one():
    """The same pair, from a good prior and from one that leads elsewhere; and two views of different rooms."""
    source, target, truth = room(1, 2)
    alone = Config().replace({"start.features": False, "alignment.guess_uncertainty": 1e6})
    right = estimate_relative_pose(source, target, alone, disturbed(truth, twist=[0.02, 0, 0, 0, 0.01, 0]))
    lost = disturbed(truth, twist=[0.3, 0.2, 0, 0, 0.35, 0], covariance=WIDE)
    wrong = estimate_relative_pose(source, target, alone, lost)
    assert off(right.T_target_source, truth)[0] < 0.01 and off(wrong.T_target_source, truth)[0] > 0.1
    elsewhere = estimate_relative_pose(source, room(2, 1)[1], Config())
    assert right.quality > 0.8
    assert 0 <= wrong.quality < 0.3 and 0 <= elsewhere.quality < 0.3


def test_a_pose_by_shape_alone_has_a_quality_too():
    estimate = estimate_relative_pose(look(TRUTH), look(), prior=disturbed())
    assert estimate.ok and 0.3 < estimate.quality <= 1
