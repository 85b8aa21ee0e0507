# SPDX-License-Identifier: Apache-2.0
"""Every check of the diagnostics: its level, its message and its lines."""

import mmap
from dataclasses import replace

import numpy as np
import pytest
from recordings import SECOND, START

from garps_ros.estimates.outcomes import Origin, Outcome, Row
from garps_ros.live.arrivals import Arrivals, InputState
from garps_ros.live.counts import WINDOW, Counts
from garps_ros.live.diagnostics import Diagnostics, Level, NodeState, memory
from garps_ros.live.jobs import Result
from garps_ros.parameters.settings import NodeSettings

NOW = 1000.0
STATE = NodeState(NodeSettings(input_timeout=5.0, sync_slop=0.02, stage_timeout=10.0), NOW)
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


class Node(Diagnostics):
    """The diagnostics of a node with its counts."""

    def __init__(self, counts=None):
        self.counts = counts or Counts()
        super().__init__(self.counts)


def inputs(*states, node=None, waiting="", now_s=NOW):
    return (node or Node()).inputs(replace(STATE, inputs=states, clock_warning=waiting, now_s=now_s))


def estimates(node, **state):
    return node.estimates(replace(STATE, **state))


def machine(node, stage="", busy_s=0.0, **state):
    return node.machine(replace(STATE, stage=stage, busy_s=busy_s, **state))


def test_levels_are_those_of_the_message():
    status = pytest.importorskip("diagnostic_msgs.msg").DiagnosticStatus
    assert [bytes([level]) for level in Level] == [status.OK, status.WARN, status.ERROR]
    assert [level.name for level in Level] == ["OK", "WARN", "ERROR"]


# --- inputs -----------------------------------------------------------------------------------------------------------


def test_inputs_that_arrive_are_fine():
    check = inputs(FINE, replace(INFO, arrivals=arrivals()), replace(PRIOR, arrivals=arrivals()))
    assert (check.name, check.level, check.message) == ("inputs", Level.OK, "all inputs arrive")


@pytest.mark.parametrize("publishers", [0, 2])
@pytest.mark.parametrize("state", [IMAGE, INFO])
def test_a_missing_input_is_named_with_its_topic_and_publishers(state, publishers):
    check = inputs(FINE, replace(state, publishers=publishers))
    assert check.level == Level.ERROR and "nothing received" in check.message
    for word in (state.role, state.topic, f"{publishers} publisher"):
        assert word in check.message


def test_all_that_is_missing_is_named():
    check = inputs(IMAGE, INFO, replace(FINE, role="source/depth", arrivals=arrivals(age_s=7.0)))
    assert check.level == Level.ERROR
    for word in ("source/image", "source/camera_info", "source/depth", "silent", "7.0 s"):
        assert word in check.message
    assert "prior" not in check.message


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
def test_a_known_reason_of_type_or_qos_is_said_instead_of_the_silence(state):
    check = inputs(replace(state, warning="incompatible QoS: driver offers BEST_EFFORT"))
    assert check.level == Level.ERROR and "nothing received" not in check.message
    assert state.role in check.message and state.topic in check.message
    assert check.message.endswith("incompatible QoS: driver offers BEST_EFFORT")


def test_a_clock_that_has_not_come_is_an_error_beside_the_others():
    waiting = "use_sim_time is true and nothing has come on /clock yet"
    assert (inputs(FINE, waiting=waiting).level, inputs(FINE, waiting=waiting).message) == (Level.ERROR, waiting)
    both = inputs(IMAGE, waiting=waiting).message
    assert both.endswith("; " + waiting) and "source/image" in both


def test_what_was_refused_is_said_for_a_second_and_counted_for_ever():
    node = Node()
    node.counts.refuse("/a", "header.stamp is zero")
    node.counts.refuse("/b", "no camera_info yet")
    node.counts.refuse("/a", "header.stamp is null")
    first, second = inputs(FINE, node=node), inputs(FINE, node=node)
    assert first.level == Level.WARN
    assert first.message == "3 message(s) refused in the last second: /a: header.stamp is null"
    assert (second.level, second.message) == (Level.OK, "all inputs arrive")
    node.counts.refuse("/b", "no camera_info yet")
    third = inputs(FINE, node=node)
    assert third.level == Level.WARN and third.message.startswith("1 message(s) refused")
    counts = {"messages refused": "4", "refused: /a": "2", "refused: /b": "2", "last refused": "/b: no camera_info yet"}
    assert third.values.items() >= counts.items()


def test_a_missing_input_goes_before_refused_messages_which_are_not_said_later():
    node = Node()
    node.counts.refuse("/a", "header.stamp is zero")
    assert inputs(IMAGE, node=node).level == Level.ERROR
    assert inputs(FINE, node=node).level == Level.OK


def test_loss_on_the_way_is_a_warning_that_says_what_helps():
    lossy = replace(IMAGE, arrivals=arrivals(count=200, kept=0.4))
    check = inputs(FINE, lossy)
    assert check.level == Level.WARN
    for word in ("source/image: about ", "%", "/right/image_rect", "fastdds_large_images.xml", "compressed"):
        assert word in check.message
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
    node = Node()
    assert estimates(node).message == "waiting for images"
    for _ in range(3):
        node.counts.publish(0.3, 0.1, 0.15)
    first, second = estimates(node), estimates(node)
    assert (first.name, first.level, first.message) == ("estimates", Level.OK, "3 pose(s) in the last second")
    assert second.message == "waiting for images" and second.values["poses used"] == "3"


def test_a_rejection_is_a_warning_with_its_reason_for_a_second():
    node = Node()
    node.counts.publish(0.3, 0.1, 0.15)
    node.counts.reject("low_overlap", "3 % of the components")
    node.counts.reject("degenerate", "one direction is open")
    first, second = estimates(node), estimates(node)
    assert first.level == Level.WARN
    assert first.message == "2 pair(s) rejected in the last second: degenerate: one direction is open"
    assert second.level == Level.OK
    assert second.values["rejected: low_overlap"] == second.values["rejected: degenerate"] == "1"
    assert second.values["last rejected"] == "degenerate: one direction is open"
    assert second.values["last status"] == "degenerate"
    node.counts.publish(0.3, 0.1, 0.15)
    assert estimates(node).values["last status"] == "converged"


def test_doing_nothing_on_purpose_is_fine_whatever_else():
    node = Node()
    inputs(FINE, node=node, now_s=1.0)
    node.counts.reject("low_overlap", "early")
    check = estimates(node, idle="nobody subscribes (lazy)")
    assert (check.level, check.message) == (Level.OK, "nobody subscribes (lazy)")
    assert estimates(node, now_s=1.0).level == Level.OK, "the rejection was of an earlier second"


def watched(node, seconds, state=FINE, last_pair_s=None):
    """The check on estimates after some seconds of watching the inputs."""
    node.counts.last_pair_s = last_pair_s
    for second in range(seconds + 1):
        steady = replace(state, arrivals=arrivals(NOW - (NOW + second))) if state is FINE else state
        inputs(steady, node=node, now_s=NOW + second)
    return estimates(node, gaps_s={"/a and /b": -0.25, "/c and /d": 0.0}, now_s=NOW + seconds)


def test_inputs_that_never_pair_are_a_warning_with_gaps_and_slop():
    check = watched(Node(), 6)
    assert check.level == Level.WARN
    for word in ("none belong together", "sync_slop = 0.02 s", "/a and /b are -0.250 s apart", "/c and /d are +0.000"):
        assert word in check.message
    assert watched(Node(), 5).level == Level.OK, "not yet for longer than the timeout"


def test_inputs_that_pair_no_longer_are_a_warning_too():
    assert watched(Node(), 6, last_pair_s=NOW - 100).level == Level.WARN
    assert watched(Node(), 6, last_pair_s=NOW + 0.9).level == Level.WARN
    assert watched(Node(), 6, last_pair_s=NOW + 1.1).level == Level.OK


def test_without_inputs_it_is_not_said_that_they_do_not_pair():
    check = watched(Node(), 60, IMAGE)
    assert (check.level, check.message) == (Level.OK, "waiting for images")


def test_inputs_that_come_back_get_their_time_to_pair():
    node = Node()
    inputs(FINE, node=node, now_s=NOW)
    inputs(IMAGE, node=node, now_s=NOW + 60)
    inputs(replace(FINE, arrivals=arrivals(-61)), node=node, now_s=NOW + 61)
    assert estimates(node, now_s=NOW + 62).level == Level.OK
    assert estimates(node, now_s=NOW + 67).level == Level.WARN


def test_every_pair_is_accounted_for():
    node = Node(Counts(pairs_in=10))
    node.counts.dropped["a newer pair came"] += 4
    values = estimates(node).values
    assert values["pairs in"] == "10" and values["poses used"] == "0"
    assert values["dropped: a newer pair came"] == "4" and values["transform"] == "off"
    assert not any("(ms)" in key for key in values), "no latency before the first pose"


def result(status="converged", overlap=0.81, **fields):
    row = Row(1, 2, "left", "right", status, "", overlap, quality=0.7)
    return Result(None, [Outcome(row, "right", "left", None, None, None)], **fields)


def test_the_lines_of_the_last_result_stay_until_the_node_begins_anew():
    node = Node()
    node.note(result(prior="used", warnings=["one", "two"], keyframes=3))
    node.note(result(overlap=None, warnings=["three"]))
    expected = {"frames": "left in right", "overlap": "0.81", "quality": "0.70", "keyframes": "3"}
    assert estimates(node).values.items() >= {**expected, "prior": "none", "warnings": "three"}.items()
    node.note(Result(None, [Origin(1, "left_start", "left", 5)]))
    assert estimates(node).values["frames"] == "left in left_start"
    node.forget()
    assert not {*expected, "prior", "warnings"} & set(estimates(node).values)


def test_latency_is_told_apart():
    node = Node()
    for index in range(1, 101):
        node.counts.publish(latency_s=0.010 * index, waiting_s=0.002 * index, core_s=0.005 * index)
    values = estimates(node).values
    expected = {"latency p50": 505, "latency p95": 950.5, "core p50": 252.5, "waiting p50": 101, "overhead p50": 151.5}
    assert {key: float(values[f"{key} (ms)"]) for key in expected} == pytest.approx(expected, abs=0.06)
    for _ in range(WINDOW):
        node.counts.publish(0.020, 0.0, 0.015)
    assert estimates(node).values["latency p95 (ms)"] == "20.0", "what is long ago no longer counts"


# --- machine ----------------------------------------------------------------------------------------------------------


def test_the_worker_at_work_and_at_rest():
    assert (machine(Node()).level, machine(Node()).message) == (Level.OK, "idle")
    busy = machine(Node(), "estimate", 9.9, unpaired=2, scale="the depth topics, m")
    assert (busy.name, busy.level, busy.message) == ("machine", Level.OK, "computing: estimate")
    expected = {"stage": "estimate", "busy (s)": "9.90", "last error": "", "device": "cpu", "enabled": "True"}
    assert busy.values.items() >= {**expected, "unpaired messages": "2", "scale from": "the depth topics, m"}.items()


def test_a_stuck_computation_is_an_error_that_names_its_stage():
    check = machine(Node(), "estimate", 12.34)
    assert check.level == Level.ERROR
    for word in ("stuck: estimate", "12.3 s", "at most 10 s", "stage_timeout"):
        assert word in check.message


def test_a_death_of_the_worker_is_an_error_for_a_second_and_counted_for_ever():
    node = Node()
    node.counts.fail("worker", "ended by MemoryError: ; restarted")
    node.counts.fail("callback", "ValueError: x")
    node.counts.fail("worker", "ended by SystemExit: 3; restarted")
    first, second = machine(node, "estimate", 99.0), machine(node)
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


def test_a_long_computation_is_not_waiting_for_images():
    node = Node()
    assert estimates(node).message == "waiting for images"
    assert estimates(node, busy_s=2.5).message == "computing for 2.5 s"
