# SPDX-License-Identifier: Apache-2.0
"""Given poses: the choice of the one for an image, and the reasons why others are refused."""

import numpy as np
import pytest
from recordings import COVARIANCE, SECOND, START, moved
from ros_messages import header, message_class

from garps_ros.live.priors import KEPT, Priors, prior_from_message
from msg_adapters import MessageError, PoseWriter

LIBRARIES = ("rclpy", "rosbags")
AGE = SECOND // 2


def message(stamp_ns, x=0.0, frame_id="left", library="rosbags"):
    make = PoseWriter(message_class(library))
    posed = make.pose_with_covariance_stamped(moved(x, 0.2), COVARIANCE, max(stamp_ns, 0), frame_id)
    if library == "rclpy":  # as it arrives: a flat array of its own
        posed.pose.covariance = np.array(posed.pose.covariance)
    return posed


def kept(*stamps):
    priors = Priors()
    for index, stamp_ns in enumerate(stamps):
        priors.add(message(stamp_ns, x=float(index)))
    return priors


def found(priors, stamp_ns, max_age_ns=AGE):
    """Return the place of the message that is chosen; None when there is none."""
    posed = priors.near(stamp_ns, max_age_ns)
    return None if posed is None else int(posed.pose.pose.position.x)


def test_the_nearest_in_time_is_found_whatever_the_order():
    priors = kept(START, START + 2 * SECOND, START + SECOND)
    expected = {-0.3: 0, 0.0: 0, 0.4: 0, 0.6: 2, 1.0: 2, 1.4: 2, 1.6: 1, 2.4: 1}
    assert {at: found(priors, START + round(at * SECOND)) for at in expected} == expected


@pytest.mark.parametrize("side", [-1, 1])
def test_one_that_is_too_old_or_too_new_is_not_used(side):
    priors = kept(START)
    assert found(priors, START + side * AGE) == 0
    assert found(priors, START + side * (AGE + 1)) is None
    assert found(priors, START + side, max_age_ns=0) is None and found(priors, START, max_age_ns=0) == 0


def test_without_any_there_is_none():
    assert Priors().near(START, AGE) is None


def test_of_equal_stamps_the_latest_counts():
    assert found(kept(START, START), START) == 1


def test_a_zero_stamp_stands_for_all_times_until_the_next():
    priors = kept(0)
    assert found(priors, START) == 0 and found(priors, 1, max_age_ns=0) == 0
    priors.add(message(0, x=7.0))
    assert found(priors, START) == 7


def test_a_timely_one_goes_before_a_standing_one():
    priors = kept(0, START)
    assert found(priors, START + AGE) == 1
    assert found(priors, START + AGE + 1) == 0


def test_a_standing_one_near_time_zero_is_not_taken_for_a_timely_one():
    assert found(kept(10, 0), 3) == 0


def test_forgetting_drops_what_belongs_to_a_time_only():
    priors = kept(0, START)
    priors.forget()
    assert found(priors, START) == 0
    timed = kept(START)
    timed.forget()
    assert found(timed, START) is None
    priors.forget(standing=True)
    assert found(priors, START) is None


def test_the_newest_are_kept_and_not_more():
    priors = kept(*(START + index * SECOND for index in range(KEPT + 3)))
    assert [found(priors, START + index * SECOND) for index in (2, 3, KEPT + 2)] == [None, 3, KEPT + 2]


def test_a_malformed_stamp_is_refused():
    posed = message(START)
    posed.header.stamp.nanosec = SECOND
    with pytest.raises(MessageError, match="nanosec"):
        Priors().add(posed)


@pytest.mark.parametrize("library", LIBRARIES)
@pytest.mark.parametrize("frame_id", ["left", ""])
def test_a_prior_is_the_pose_and_covariance_as_given(library, frame_id):
    posed = message(START, 0.25, library=library)
    posed.header = header(library, START, frame_id)
    prior = prior_from_message(posed, "left")
    np.testing.assert_allclose(prior.T_target_source, moved(0.25, 0.2), atol=1e-15)
    np.testing.assert_allclose(prior.covariance, COVARIANCE, rtol=1e-12)
    assert prior.reason == "from the prior topic"


def changed(part, **values):
    """A message in which some numbers are replaced."""
    posed = message(START, 0.25, library="rclpy")
    target = posed.pose.pose.orientation if part == "orientation" else posed.pose.pose.position
    for name, value in values.items():
        setattr(target, name, value)
    return posed


def with_covariance(covariance):
    posed = message(START, library="rclpy")
    posed.pose.covariance = np.asarray(covariance, float).ravel()
    return posed


LEANING = np.diag([1e-4] * 6) + np.eye(6, k=1) * 1e-5
WRONG = {
    "frame": (lambda: message(START, frame_id="base_link"), "prior is in frame 'base_link': expected.* in 'left', the"),
    "NaN position": (lambda: changed("position", y=float("nan")), "position"),
    "infinite position": (lambda: changed("position", x=float("inf")), "position"),
    "NaN orientation": (lambda: changed("orientation", w=float("nan")), "orientation"),
    "long quaternion": (lambda: changed("orientation", w=2.0), "norm.*unit quaternion"),
    "no quaternion": (lambda: changed("orientation", x=0.0, y=0.0, z=0.0, w=0.0), "norm.*unit quaternion"),
    "zero covariance": (lambda: with_covariance(np.zeros(36)), "zeros do not mean unknown"),
    "NaN covariance": (lambda: with_covariance(np.full(36, np.nan)), "covariance"),
    "unsymmetric": (lambda: with_covariance(LEANING), "not symmetric"),
    "negative": (lambda: with_covariance(-COVARIANCE), "variances"),
    "indefinite": (lambda: with_covariance(np.full((6, 6), 1e-4)), "not positive definite"),
}


@pytest.mark.parametrize("name", WRONG)
def test_what_is_no_prior_is_refused_with_the_reason(name):
    pytest.importorskip("rclpy", reason="its fields take any number")
    make, reason = WRONG[name]
    with pytest.raises(MessageError, match=reason):
        prior_from_message(make(), "left")


def test_a_pose_without_covariance_is_none():
    bare = PoseWriter(message_class("rosbags")).pose_stamped(moved(0.1), START, "left")
    with pytest.raises(MessageError, match="no covariance: expected PoseWithCovarianceStamped"):
        prior_from_message(bare, "left")
