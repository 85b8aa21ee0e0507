# SPDX-License-Identifier: Apache-2.0
"""Every verdict of the diagnostics: its level, what it names, and the counts that come with it."""

import mmap
import time
from dataclasses import replace

import numpy as np
import pytest
from recordings import SECOND, START

from garps_ros.live.arrivals import Arrivals
from garps_ros.live.health import WINDOW, Health, InputState, Level, memory

NOW, TIMEOUT, SLOP = 1000.0, 5.0, 0.02
IMAGE = InputState("source/image", "/right/image_rect", Arrivals(), 1, "RELIABLE")
INFO = InputState("source/camera_info", "/right/camera_info", Arrivals(), 1, "RELIABLE", once=True)
PRIOR = InputState("prior", "/pose_node/prior", Arrivals(), 0, "BEST_EFFORT", once=True, optional=True)


def arrivals(age_s=0.0, count=30, rate=15.0, kept=1.0):
    """Messages of a steady camera, the last one `age_s` before NOW; only a share is kept."""
    found, rng = Arrivals(), np.random.default_rng(0)
    for back in range(count - 1, -1, -1):
        if back == 0 or rng.random() < kept:
            stamp_ns = START - round(back / rate * SECOND)
            found.note(NOW - age_s - back / rate, stamp_ns, stamp_ns + 20_000_000)
    return found


FINE = replace(IMAGE, arrivals=arrivals())


def inputs(*states, health=None, waiting="", now_s=NOW):
    return (health or Health()).inputs(states, now_s, TIMEOUT, waiting)


def estimates(health, idle="", gaps_s=None, now_s=NOW, busy_s=0.0):
    return health.estimates(idle, busy_s, gaps_s or {}, SLOP, now_s, TIMEOUT)


def machine(health, stage="", busy_s=0.0, **values):
    return health.machine(stage, busy_s, 10.0, values)


def test_levels_are_those_of_the_message():
    status = pytest.importorskip("diagnostic_msgs.msg").DiagnosticStatus
    assert [bytes([level]) for level in Level] == [status.OK, status.WARN, status.ERROR]
    assert [level.name for level in Level] == ["OK", "WARN", "ERROR"]


# --- inputs -----------------------------------------------------------------------------------------------------------


def test_inputs_that_arrive_are_fine():
    finding = inputs(FINE, replace(INFO, arrivals=arrivals()), replace(PRIOR, arrivals=arrivals()))
    assert (finding.name, finding.level, finding.message) == ("inputs", Level.OK, "all inputs arrive")


@pytest.mark.parametrize("publishers", [0, 2])
@pytest.mark.parametrize("state", [IMAGE, INFO])
def test_a_missing_input_is_named_with_its_topic_and_publishers(state, publishers):
    finding = inputs(FINE, replace(state, publishers=publishers))
    assert finding.level == Level.ERROR and "nothing received" in finding.message
    for word in (state.role, state.topic, f"{publishers} publisher"):
        assert word in finding.message


def test_all_that_is_missing_is_named():
    finding = inputs(IMAGE, INFO, replace(FINE, role="source/depth", arrivals=arrivals(age_s=7.0)))
    assert finding.level == Level.ERROR
    for word in ("source/image", "source/camera_info", "source/depth", "silent", "7.0 s"):
        assert word in finding.message
    assert "prior" not in finding.message


@pytest.mark.parametrize(("age_s", "level"), [(4.9, Level.OK), (5.1, Level.ERROR)])
def test_an_input_is_silent_after_the_timeout(age_s, level):
    assert inputs(replace(IMAGE, arrivals=arrivals(age_s))).level == level


def test_where_only_depth_never_comes_a_network_is_named():
    depth = replace(IMAGE, role="source/depth")
    hint = "reconstruction.method:=depth_anything_v2 with preset:=monocular does without depth"
    assert hint in inputs(FINE, depth).message
    assert hint not in inputs(IMAGE, depth).message and hint not in inputs(FINE, IMAGE).message


def test_a_latched_calibration_is_never_silent():
    assert inputs(FINE, replace(INFO, arrivals=arrivals(age_s=4000, count=1))).level == Level.OK


def test_a_prior_may_be_absent_and_may_cease():
    assert inputs(FINE, PRIOR).level == Level.OK
    assert inputs(FINE, replace(PRIOR, arrivals=arrivals(age_s=4000))).level == Level.OK


@pytest.mark.parametrize("state", [IMAGE, FINE, PRIOR])
def test_a_known_problem_of_type_or_qos_is_said_instead_of_the_silence(state):
    finding = inputs(replace(state, problem="incompatible QoS: driver offers BEST_EFFORT"))
    assert finding.level == Level.ERROR and "nothing received" not in finding.message
    assert state.role in finding.message and state.topic in finding.message
    assert finding.message.endswith("incompatible QoS: driver offers BEST_EFFORT")


def test_a_clock_that_has_not_come_is_an_error_beside_the_others():
    waiting = "use_sim_time is true and nothing has come on /clock yet"
    assert (inputs(FINE, waiting=waiting).level, inputs(FINE, waiting=waiting).message) == (Level.ERROR, waiting)
    both = inputs(IMAGE, waiting=waiting).message
    assert both.endswith("; " + waiting) and "source/image" in both


def test_what_was_refused_is_said_for_a_second_and_counted_for_ever():
    health = Health()
    health.refuse("/a", "header.stamp is zero")
    health.refuse("/b", "no camera_info yet")
    health.refuse("/a", "header.stamp is null")
    first, second = inputs(FINE, health=health), inputs(FINE, health=health)
    assert first.level == Level.WARN
    assert first.message == "3 message(s) refused in the last second: /a: header.stamp is null"
    assert (second.level, second.message) == (Level.OK, "all inputs arrive")
    health.refuse("/b", "no camera_info yet")
    third = inputs(FINE, health=health)
    assert third.level == Level.WARN and third.message.startswith("1 message(s) refused")
    counts = {"messages refused": "4", "refused: /a": "2", "refused: /b": "2", "last refused": "/b: no camera_info yet"}
    assert third.values.items() >= counts.items()


def test_a_missing_input_goes_before_refused_messages_which_are_not_said_later():
    health = Health()
    health.refuse("/a", "header.stamp is zero")
    assert inputs(IMAGE, health=health).level == Level.ERROR
    assert inputs(FINE, health=health).level == Level.OK


def test_loss_on_the_way_is_a_warning_that_says_what_helps():
    lossy = replace(IMAGE, arrivals=arrivals(count=200, kept=0.4))
    finding = inputs(FINE, lossy)
    assert finding.level == Level.WARN
    for word in ("source/image: about ", "%", "/right/image_rect", "fastdds_large_images.xml", "compressed"):
        assert word in finding.message
    assert inputs(replace(lossy, once=True)).level == Level.OK, "a calibration may come as it likes"
    assert inputs(replace(IMAGE, arrivals=arrivals(count=200, kept=0.95))).level == Level.OK


def test_the_values_of_an_input_are_complete():
    values = inputs(FINE, INFO).values
    assert values["source/image"] == "/right/image_rect, RELIABLE, 1 publisher(s)"
    assert values["source/image count"] == "30" and values["source/image rate (Hz)"] == "15.0"
    assert values["source/image age (s)"] == "0.00"
    assert values["source/image delay p50 / max (ms)"] == "20.0 / 20.0"
    empty = {"count": "0", "rate (Hz)": "0.0", "age (s)": "", "delay p50 / max (ms)": ""}
    assert values.items() >= {f"source/camera_info {key}": value for key, value in empty.items()}.items()
    assert values["messages refused"] == "0" and values["last refused"] == ""


# --- estimates --------------------------------------------------------------------------------------------------------


def test_poses_are_counted_by_the_second():
    health = Health()
    assert estimates(health).message == "waiting for images"
    for _ in range(3):
        health.publish(0.3, 0.1, 0.15)
    first, second = estimates(health), estimates(health)
    assert (first.name, first.level, first.message) == ("estimates", Level.OK, "3 pose(s) in the last second")
    assert second.message == "waiting for images" and second.values["poses used"] == "3"


def test_a_rejection_is_a_warning_with_its_reason_for_a_second():
    health = Health()
    health.publish(0.3, 0.1, 0.15)
    health.reject("low_overlap", "3 % of the components")
    health.reject("degenerate", "one direction is open")
    first, second = estimates(health), estimates(health)
    assert first.level == Level.WARN
    assert first.message == "2 rejected in the last second: degenerate: one direction is open"
    assert second.level == Level.OK
    assert second.values["rejected: low_overlap"] == second.values["rejected: degenerate"] == "1"
    assert second.values["last rejected"] == "degenerate: one direction is open"
    assert second.values["last status"] == "degenerate"
    health.publish(0.3, 0.1, 0.15)
    assert estimates(health).values["last status"] == "converged"


def test_doing_nothing_on_purpose_is_fine_whatever_else():
    health = Health()
    inputs(FINE, health=health, now_s=1.0)
    health.reject("low_overlap", "early")
    finding = estimates(health, idle="nobody subscribes (lazy)")
    assert (finding.level, finding.message) == (Level.OK, "nobody subscribes (lazy)")
    assert estimates(health, now_s=1.0).level == Level.OK, "the rejection was of an earlier second"


def watched(health, seconds, state=FINE, last_pair_s=None):
    """The finding on estimates after some seconds of watching the inputs."""
    health.last_pair_s = last_pair_s
    for second in range(seconds + 1):
        steady = replace(state, arrivals=arrivals(NOW - (NOW + second))) if state is FINE else state
        inputs(steady, health=health, now_s=NOW + second)
    return estimates(health, gaps_s={"/a and /b": -0.25, "/c and /d": 0.0}, now_s=NOW + seconds)


def test_inputs_that_never_pair_are_a_warning_with_gaps_and_slop():
    finding = watched(Health(), 6)
    assert finding.level == Level.WARN
    for word in ("none belong together", "sync_slop = 0.02 s", "/a and /b are -0.250 s apart", "/c and /d are +0.000"):
        assert word in finding.message
    assert watched(Health(), 5).level == Level.OK, "not yet for longer than the timeout"


def test_inputs_that_pair_no_longer_are_a_warning_too():
    assert watched(Health(), 6, last_pair_s=NOW - 100).level == Level.WARN
    assert watched(Health(), 6, last_pair_s=NOW + 0.9).level == Level.WARN
    assert watched(Health(), 6, last_pair_s=NOW + 1.1).level == Level.OK


def test_without_inputs_it_is_not_said_that_they_do_not_pair():
    finding = watched(Health(), 60, IMAGE)
    assert (finding.level, finding.message) == (Level.OK, "waiting for images")


def test_inputs_that_come_back_get_their_time_to_pair():
    health = Health()
    inputs(FINE, health=health, now_s=NOW)
    inputs(IMAGE, health=health, now_s=NOW + 60)
    inputs(replace(FINE, arrivals=arrivals(-61)), health=health, now_s=NOW + 61)
    assert estimates(health, now_s=NOW + 62).level == Level.OK
    assert estimates(health, now_s=NOW + 67).level == Level.WARN


def test_every_pair_is_accounted_for():
    health = Health(pairs_in=10)
    health.dropped["a newer pair came"] += 4
    health.facts["overlap"] = "0.81"
    values = estimates(health).values
    assert values["pairs in"] == "10" and values["poses used"] == "0"
    assert values["dropped: a newer pair came"] == "4" and values["overlap"] == "0.81"
    assert not any("(ms)" in key for key in values), "no latency before the first pose"


def test_latency_is_told_apart():
    health = Health()
    for index in range(1, 101):
        health.publish(latency_s=0.010 * index, waiting_s=0.002 * index, core_s=0.005 * index)
    values = estimates(health).values
    expected = {"latency p50": 505, "latency p95": 950.5, "core p50": 252.5, "waiting p50": 101, "overhead p50": 151.5}
    assert {key: float(values[f"{key} (ms)"]) for key in expected} == pytest.approx(expected, abs=0.06)
    for _ in range(WINDOW):
        health.publish(0.020, 0.0, 0.015)
    assert estimates(health).values["latency p95 (ms)"] == "20.0", "what is long ago no longer counts"


# --- machine ----------------------------------------------------------------------------------------------------------


def test_the_worker_at_work_and_at_rest():
    assert (machine(Health()).level, machine(Health()).message) == (Level.OK, "idle")
    busy = machine(Health(), "estimate", 9.9, device="cpu")
    assert (busy.name, busy.level, busy.message) == ("machine", Level.OK, "computing: estimate")
    assert busy.values == {"stage": "estimate", "busy (s)": "9.90", "last error": "", "device": "cpu"}


def test_a_stuck_computation_is_an_error_that_names_its_stage():
    finding = machine(Health(), "estimate", 12.34)
    assert finding.level == Level.ERROR
    for word in ("stuck: estimate", "12.3 s", "at most 10 s", "stage_timeout"):
        assert word in finding.message


def test_a_death_of_the_worker_is_an_error_for_a_second_and_counted_for_ever():
    health = Health()
    health.fail("worker", "ended by MemoryError: ; restarted")
    health.fail("callback", "ValueError: x")
    health.fail("worker", "ended by SystemExit: 3; restarted")
    first, second = machine(health, "estimate", 99.0), machine(health)
    assert (first.level, first.message) == (Level.ERROR, "worker: ended by SystemExit: 3; restarted")
    assert (second.level, second.message) == (Level.OK, "idle")
    expected = {"errors: worker": "2", "errors: callback": "1", "last error": first.message}
    assert second.values.items() >= expected.items()


def test_memory_is_that_of_this_process():
    before = float(memory("cpu")["memory (MB)"])
    ballast = mmap.mmap(-1, 200_000_000)  # from the system: an array may get memory that this process still holds
    ballast.write(b"1" * len(ballast))
    after = memory("cpu")
    assert 150 < float(after["memory (MB)"]) - before < 500
    assert after["device"] == "cpu" and len(after) == 2


def test_a_verdict_takes_no_time():
    health, states = Health(), [FINE] * 7
    began = time.perf_counter()
    for _ in range(20):
        inputs(*states, health=health)
        estimates(health)
    assert time.perf_counter() - began < 2


def test_a_long_computation_is_not_waiting_for_images():
    health = Health()
    assert estimates(health).message == "waiting for images"
    assert estimates(health, busy_s=2.5).message == "computing for 2.5 s"
