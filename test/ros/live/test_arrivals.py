# SPDX-License-Identifier: Apache-2.0
"""Rate, age, delay and loss of an input, from the arrivals of its messages."""

import numpy as np
import pytest
from recordings import SECOND, START

from garps_ros.live.arrivals import FEW, MANY_MISSING, PAUSE_S, WINDOW, Arrivals


def arrived(stamps_s, times_s=None, delay_s=0.0):
    """Messages with these stamps after START; they come at once unless `times_s` (steady) says otherwise."""
    arrivals = Arrivals()
    for stamp, time in zip(stamps_s, stamps_s if times_s is None else times_s, strict=True):
        stamp_ns = START + round(stamp * SECOND)
        arrivals.note(float(time), stamp_ns, stamp_ns + round(delay_s * SECOND))
    return arrivals


def test_nothing_is_known_before_the_first_message():
    arrivals = Arrivals()
    assert (arrivals.count, arrivals.age_s(5.0), arrivals.delay_ms()) == (0, None, None)
    assert arrivals.rate_hz(5.0) == 0 and arrivals.missing() == 0


def test_the_age_is_that_of_the_last_one_on_the_steady_clock():
    arrivals = arrived([0, 1, 2], times_s=[100, 101, 102.5])
    assert arrivals.age_s(104.0) == 1.5 and arrivals.count == 3


@pytest.mark.parametrize("rate", [0.5, 2, 15, 30, 200])
def test_the_rate_is_that_of_the_arrivals(rate):
    times = np.arange(0, 20, 1 / rate)
    assert arrived(times * 7, times).rate_hz(times[-1]) == pytest.approx(rate, rel=1e-6)


def test_the_rate_of_now_is_not_that_of_long_ago():
    times = np.concatenate([np.arange(0, 3, 0.1), np.arange(3, 10, 0.5)])
    arrivals = arrived(times)
    assert arrivals.rate_hz(10.0) == pytest.approx(2.0)
    assert arrivals.rate_hz(13.6) < 2.1 and arrivals.rate_hz(20.0) == 0
    assert arrived([0, 9.0]).rate_hz(10.0) == pytest.approx(0.2), "one in five seconds"


def test_messages_at_one_moment_have_a_finite_rate():
    assert np.isfinite(arrived([0, 1], times_s=[3, 3]).rate_hz(3.0))


def test_the_delay_is_from_stamp_to_arrival_on_the_ros_clock():
    arrivals = arrived(np.arange(9) / 10, delay_s=0.020)
    arrivals.note(1.0, START + SECOND, START + SECOND + 350_000_000)
    assert arrivals.delay_ms() == pytest.approx((20.0, 350.0))


def test_without_a_clock_the_delay_is_unknown():
    arrivals = Arrivals()
    arrivals.note(1.0, START, 0)
    assert arrivals.delay_ms() is None
    arrivals.note(2.0, START + 1, START + 2_000_001)
    assert arrivals.delay_ms() == pytest.approx((2.0, 2.0))


def lossy(share, rate=15.0, count=1500, seed=0, jitter=0.0):
    """Arrivals of a steady camera of which a share is lost at random."""
    rng = np.random.default_rng(seed)
    stamps = np.arange(count) / rate + jitter / rate * rng.uniform(-1, 1, count)
    return arrived(stamps[rng.random(count) >= share])


@pytest.mark.parametrize("seed", range(5))
@pytest.mark.parametrize("share", [0.0, 0.5, 0.6, 0.83])
def test_random_loss_is_seen_as_large_as_it_is(share, seed):
    """23 and 10 of 60 large images arrived over best effort with the default transport."""
    assert lossy(share, seed=seed).missing() == pytest.approx(share, abs=0.2 * share + 1e-3)


@pytest.mark.parametrize("seed", range(5))
def test_even_the_loss_of_nearly_all_is_seen_as_much(seed):
    """4 of 60 arrived at 1920x1080."""
    assert lossy(0.93, count=6000, seed=seed).missing() > 2 * MANY_MISSING


@pytest.mark.parametrize("seed", range(5))
def test_the_jitter_of_a_driver_is_no_loss(seed):
    assert lossy(0.0, jitter=0.1, seed=seed).missing() < MANY_MISSING / 2
    assert lossy(0.5, jitter=0.1, seed=seed).missing() == pytest.approx(0.5, abs=0.13)


def most_missing(stamps_s):
    """Return the largest share of missing messages reported while these came in."""
    arrivals, shares = Arrivals(), []
    for stamp in stamps_s:
        arrivals.note(float(stamp), START + round(stamp * SECOND), 0)
        shares.append(arrivals.missing())
    return max(shares)


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("kind", ["uniform", "normal"])
def test_even_jitter_of_a_third_of_the_period_is_no_loss(seed, kind):
    rng = np.random.default_rng(seed)
    jitter = rng.uniform(-0.3, 0.3, 300) if kind == "uniform" else 0.2 * rng.normal(size=300)
    assert most_missing((np.arange(300) + jitter) / 15) < MANY_MISSING / 2


@pytest.mark.parametrize("jitter", [0.0, 0.1])
@pytest.mark.parametrize(("before", "after"), [(30, 15), (15, 30), (30, 10), (30, 20), (30, 12)])
def test_another_rate_is_no_loss(before, after, jitter):
    """Drivers expose longer in the dark."""
    stamps = np.cumsum(np.repeat([1 / before, 1 / after], 150))
    stamps += jitter / 30 * np.random.default_rng(0).uniform(-1, 1, len(stamps))
    assert most_missing(stamps) < MANY_MISSING / 2


@pytest.mark.parametrize("seed", range(5))
@pytest.mark.parametrize("share", [0.5, 0.6, 0.83])
def test_loss_is_seen_through_jitter_and_at_any_time(share, seed):
    rng = np.random.default_rng(seed)
    stamps = (np.arange(2000) + rng.uniform(-0.1, 0.1, 2000)) / 15
    arrivals, shares = Arrivals(), []
    for stamp in stamps[rng.random(2000) >= share]:
        arrivals.note(float(stamp), START + round(stamp * SECOND), 0)
        shares.append(arrivals.missing())
    assert min(shares[WINDOW:]) > 1.15 * MANY_MISSING


def test_bursts_on_arrival_are_no_loss():
    stamps = np.arange(200) / 15
    assert arrived(stamps, np.ceil(stamps)).missing() == pytest.approx(0, abs=1e-4)


def test_a_burst_of_stamps_is_no_loss():
    """A driver that catches up stamps a few images in quick succession."""
    stamps = np.arange(80) / 15
    caught_up = np.sort(np.concatenate([stamps, stamps[40] + np.arange(1, 6) * 1e-3]))
    assert arrived(caught_up).missing() < 0.1


def test_a_pause_of_the_publisher_is_no_loss():
    before, pause = np.arange(60) / 15, 60.0
    for after in (1, 9, 30, 200):
        assert arrived(np.concatenate([before, before[-1] + pause + np.arange(after) / 15])).missing() < 1e-4
    slow = np.arange(30) * (PAUSE_S + 1)
    assert arrived(slow).missing() == 0


def test_a_long_gap_short_of_a_pause_is_loss():
    stamps = np.arange(0, 4, 0.1)
    assert arrived(np.concatenate([stamps, stamps + 3.9 + PAUSE_S - 0.1])).missing() > 0.3


def test_few_messages_say_nothing_of_loss():
    gaps = [1, 3, 1, 4, 1, 5, 1, 9, 2, 1, 3, 1, 4, 1, 5, 1, 9, 2, 1]
    stamps = np.cumsum([0, *gaps]) / 10
    assert arrived(stamps[: FEW - 1]).missing() == 0
    assert len(stamps) == FEW and arrived(stamps).missing() == pytest.approx(1 - 19 / 55, abs=1e-4)


def test_a_recording_that_begins_again_is_no_loss():
    stamps = np.arange(40) / 15
    assert arrived(np.concatenate([stamps + 1000, stamps])).missing() == pytest.approx(0, abs=1e-4)
    assert arrived(np.concatenate([stamps, stamps[-1:], stamps[-1] + stamps[1:]])).missing() == pytest.approx(
        0, abs=1e-4
    )


def test_loss_of_long_ago_is_forgotten():
    rng = np.random.default_rng(0)
    bad = np.arange(600)[rng.random(600) > 0.6] / 15
    arrivals = arrived(np.concatenate([bad, bad[-1] + np.arange(1, WINDOW + 1) / 15]))
    assert arrivals.missing() == pytest.approx(0, abs=1e-3) and arrivals.count == len(bad) + WINDOW
