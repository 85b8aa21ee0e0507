# SPDX-License-Identifier: Apache-2.0
"""Live messages pair as in a recording of them; refused ones are reported; a jump back in time begins anew."""

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from recordings import SECOND, START, write
from ros_messages import camera_info, changed, image

from garps_ros.frames.frame import CameraTopics
from garps_ros.frames.stamps import MAX_WAITING_LIVE, Pairer
from garps_ros.live.intake import DEPTH, IMAGE, JUMP_BACK_NS, STUBBORN, Intake
from garps_ros.recording.bags import Bag
from garps_ros.recording.frame_reader import Frames

MS = 1_000_000
SLOP = 20 * MS
PERIOD = 100 * MS
TINY = np.zeros((2, 2, 3), np.uint8)
TOPICS = [CameraTopics(f"/{side}/image", f"/{side}/info", f"/{side}/depth") for side in ("source", "target")]
SOURCE, TARGET = 0, 1


def message(stamp_ns, library="namespace"):
    return image(TINY, "rgb8", library, stamp_ns=stamp_ns)


class Live:
    """An intake and everything that it says; calibrated unless told otherwise."""

    def __init__(self, cameras=2, slop_ns=SLOP, calibrated=True):
        self.refused, self.jumps = [], []
        self.intake = Intake(TOPICS[:cameras], slop_ns, lambda *told: self.refused.append(told), self.jumps.append)
        for index in range(cameras if calibrated else 0):
            self.intake.add_info(index, camera_info(size=(2, 2)))

    def frame(self, stamp_ns, index=SOURCE, depth_after_ns=0):
        """Image and depth of one camera; stamps (ns from START) of what became complete."""
        found = self.add(stamp_ns, index, IMAGE)
        return found + self.add(stamp_ns + depth_after_ns, index, DEPTH)

    def pair(self, stamp_ns, apart_ns=0):
        return self.frame(stamp_ns) + self.frame(stamp_ns + apart_ns, TARGET)

    def add(self, stamp_ns, index=SOURCE, role=IMAGE):
        complete = self.intake.add(index, role, message(START + stamp_ns))
        return [tuple(frame.stamp_ns - START for frame in frames) for frames in complete]


def test_a_frame_is_what_belongs_together_and_knows_its_camera():
    live = Live()
    infos = [camera_info(size=(2, 2), frame_id=side) for side in ("s", "t")]
    sent = {}
    for index, info in enumerate(infos):
        live.intake.add_info(index, info)
        for role in (IMAGE, DEPTH):
            sent[index, role] = message(START)
            complete = live.intake.add(index, role, sent[index, role])
    ((source, target),) = complete
    for index, frame in enumerate((source, target)):
        assert frame.image is sent[index, IMAGE] and frame.depth is sent[index, DEPTH]
        assert frame.info is infos[index] and frame.topics == TOPICS[index] and frame.stamp_ns == START


def test_one_camera_gives_its_frames_alone():
    live = Live(cameras=1)
    assert live.frame(0) == [(0,)] and live.frame(PERIOD) == [(PERIOD,)]
    assert live.frame(2 * PERIOD, depth_after_ns=5 * MS) == [], "a nearer image may still come: no rhythm is known"
    assert live.frame(3 * PERIOD, depth_after_ns=5 * MS) == [(2 * PERIOD,), (3 * PERIOD,)]
    assert live.frame(4 * PERIOD, depth_after_ns=5 * MS) == [(4 * PERIOD,)], "the next image comes a period later"


def test_what_waits_for_a_better_partner_is_not_held_for_ever():
    live = Live()
    assert live.pair(0, 3 * MS) == []
    assert live.intake.settle() == [], "something has just come"
    ((source, target),) = live.intake.settle()
    assert (source.stamp_ns, target.stamp_ns) == (START, START + 3 * MS)
    assert live.frame(PERIOD, depth_after_ns=5 * MS) == [] and live.intake.settle() == []
    assert live.intake.settle() == [], "the frame is complete, its partner is not there"
    assert live.frame(PERIOD + 5 * MS, TARGET) == [] and live.intake.settle() == []
    assert len(live.intake.settle()) == 1 and live.intake.unpaired == 0


def test_live_pairs_of_regular_cameras_come_a_period_sooner_and_are_the_same():
    live, offline = Live(), Pairer(SLOP)
    came, expected = [], []
    for number in range(20):
        stamps = number * PERIOD, number * PERIOD + 8 * MS
        came.append(live.pair(stamps[0], 8 * MS))
        expected += [pair for stream in (0, 1) for pair in offline.add(stream, stamps[stream] + 1, stamps[stream])]
    assert all(len(pairs) == 1 for pairs in came[5:])
    assert [pair for pairs in came for pair in pairs][: len(expected)] == expected


def test_little_is_kept_of_a_stream_without_partner():
    live = Live()
    for number in range(100):
        live.add(number * PERIOD, SOURCE, IMAGE)
    assert live.intake.unpaired == 100 - MAX_WAITING_LIVE


def test_the_newest_calibration_counts():
    live = Live(cameras=1)
    newest = camera_info(size=(2, 2), K=np.diag([9, 9, 1]))
    live.intake.add_info(SOURCE, newest)
    live.intake.add(SOURCE, DEPTH, message(START))
    ((frame,),) = live.intake.add(SOURCE, IMAGE, message(START))
    assert frame.info is newest


OFFSETS = st.lists(st.integers(-30, 30), min_size=1, max_size=12)


@given(OFFSETS, OFFSETS, OFFSETS, st.integers(0, 40))
def test_frames_pair_by_the_rule_of_the_pairer(depths, partners, partner_depths, slop_ms):
    """Return the pairs that the intake and the pairers of the replay make of the same stamps."""
    stamps = {(SOURCE, IMAGE): range(0, 50 * len(depths), 50), (SOURCE, DEPTH): [], (TARGET, IMAGE): []}
    stamps[SOURCE, DEPTH] = [50 * i + o // 2 for i, o in enumerate(depths)]
    stamps[TARGET, IMAGE] = [50 * i + o // 2 for i, o in enumerate(partners)]
    stamps[TARGET, DEPTH] = [50 * i + o // 2 for i, o in enumerate(partner_depths)]
    arrivals = sorted((t, *stream) for stream, times in stamps.items() for t in times)
    live, cameras, between = (
        Live(slop_ns=slop_ms * MS),
        [Pairer(slop_ms, True), Pairer(slop_ms, True)],
        Pairer(slop_ms, True),
    )
    for t, index, role in arrivals:
        expected = []
        for frame, _ in cameras[index].add(role, t + 100, t):
            expected += between.add(index, frame + 100, frame)
        assert live.add(t * MS, index, role) == [(a * MS, b * MS) for a, b in expected]
    assert live.intake.unpaired == sum(sum(pairer.unpaired) for pairer in (*cameras, between))
    assert live.refused == [] and live.jumps == []


def test_pairs_are_those_of_the_replay_of_the_same_messages(tmp_path: Path):
    """Only what the replay decides at the end of the recording is still open."""
    rng = np.random.default_rng(4)
    sent = []
    for number in range(40):
        for index, camera in enumerate(TOPICS):
            base = START + number * PERIOD + int(rng.integers(-15, 15)) * MS * index
            if rng.random() < 0.85:
                sent.append((base, index, IMAGE, camera.image))
            if rng.random() < 0.85:
                sent.append((base + int(rng.choice([0, 0, 6])) * MS, index, DEPTH, camera.depth))
    sent.sort()
    infos = [(camera.info, camera_info("rosbags", (2, 2), stamp_ns=START)) for camera in TOPICS]
    messages = [(topic, message(stamp_ns, "rosbags")) for stamp_ns, _, _, topic in sent]
    live = Live()
    complete = [f for (_, i, role, _), (_, m) in zip(sent, messages, strict=True) for f in live.intake.add(i, role, m)]
    found = [tuple(frame.stamp_ns for frame in frames) for frames in complete]
    with Bag(write(tmp_path, "mcap", [*infos, *messages])) as bag:
        offline = Frames(bag, TOPICS, SLOP, live.refused.append)
        expected = [(a.stamp_ns, b.stamp_ns) for a, b in offline.pairs()]
    assert len(found) >= 12 and len(expected) - 2 <= len(found) and expected[: len(found)] == found
    assert any(a != b for a, b in found) and any(a == b for a, b in found)


def waiting_for_calibration():
    """An intake whose source camera has no calibration yet."""
    live = Live(calibrated=False)
    live.intake.add_info(TARGET, camera_info(size=(2, 2)))
    return live


def test_an_image_waits_for_the_first_calibration():
    live = waiting_for_calibration()
    assert live.pair(0) == [] and live.refused == []
    first = camera_info(size=(2, 2))
    ((source, target),) = live.intake.add_info(SOURCE, first)
    assert source.stamp_ns == target.stamp_ns == START and source.info is first
    assert live.intake.add_info(SOURCE, first) == [], "it waited once"
    assert live.pair(PERIOD) == [(PERIOD, PERIOD)] and live.refused == []


def test_older_images_without_calibration_are_left_out_and_it_is_said():
    live = waiting_for_calibration()
    assert [live.pair(number * PERIOD) for number in range(3)] == [[], [], []]
    assert [topic for topic, _ in live.refused] == ["/source/info"] * 2
    assert "no camera_info yet for /source/image" in live.refused[0][1]
    ((source, target),) = live.intake.add_info(SOURCE, camera_info(size=(2, 2)))
    assert source.stamp_ns == target.stamp_ns == START + 2 * PERIOD


def test_an_image_from_before_a_jump_does_not_wait_for_its_calibration():
    live = waiting_for_calibration()
    live.frame(10 * SECOND)
    live.add(0)
    assert len(live.jumps) == 1 and live.intake.add_info(SOURCE, camera_info(size=(2, 2))) == []


@pytest.mark.parametrize(("role", "topic"), [(IMAGE, "/target/image"), (DEPTH, "/target/depth")])
def test_a_malformed_stamp_is_refused_and_nothing_else(role, topic):
    live = Live()
    live.frame(0)
    assert live.intake.add(TARGET, role, message(0)) == []
    assert live.intake.add(TARGET, role, changed(message(START), header=None)) == []
    assert [told for told, _ in live.refused] == [topic, topic]
    assert "header.stamp is zero" in live.refused[0][1]
    assert live.frame(0, TARGET) == [(0, 0)] and live.jumps == []


@pytest.mark.parametrize("back_ns", [0, 1, PERIOD, JUMP_BACK_NS - 1])
def test_a_stamp_that_does_not_grow_is_refused_and_what_waits_stays(back_ns):
    live = Live()
    live.frame(2 * SECOND)
    assert live.add(2 * SECOND - back_ns) == []
    ((topic, reason),) = live.refused
    assert topic == "/source/image" and f"{START + 2 * SECOND - back_ns} ns is not later" in reason
    assert live.jumps == [] and live.frame(2 * SECOND, TARGET) == [(2 * SECOND, 2 * SECOND)]


@pytest.mark.parametrize("back_ns", [JUMP_BACK_NS, 60 * SECOND])
@pytest.mark.parametrize(("index", "role"), [(SOURCE, IMAGE), (SOURCE, DEPTH), (TARGET, IMAGE), (TARGET, DEPTH)])
def test_a_jump_back_begins_anew(back_ns, index, role):
    live = Live()
    last = 100 * SECOND
    assert live.pair(last) == [(last, last)]
    assert live.frame(last + PERIOD) == []
    live.add(last + PERIOD, TARGET)
    newest = last + PERIOD if (index, role) != (TARGET, DEPTH) else last
    again = newest - back_ns
    found = live.add(again, index, role)  # the recording begins again, with this message
    assert len(live.jumps) == 1 and f"time went back by {back_ns / SECOND:.3f} s" in live.jumps[0]
    assert live.jumps[0].startswith((TOPICS[index].image, TOPICS[index].depth)[role] + ":")
    for other in {(i, r) for i in (SOURCE, TARGET) for r in (IMAGE, DEPTH)} - {(index, role)}:
        found += live.add(again, *other)
    assert found == [(again, again)], "the message that jumped is the first after it"
    assert live.pair(again + PERIOD) == [(again + PERIOD,) * 2]
    assert len(live.jumps) == 1 and live.refused == []


def test_what_waited_before_a_jump_pairs_with_nothing_after_it():
    live = Live()
    for stamp_ns in (10 * SECOND, 11 * SECOND):
        live.frame(stamp_ns)
    live.frame(10 * SECOND)  # back by 1 s, to the stamp of a frame that still waits
    assert len(live.jumps) == 1
    assert live.frame(11 * SECOND, TARGET) == [] and live.frame(11 * SECOND) == [(11 * SECOND,) * 2]


def test_the_intake_has_forgotten_when_the_jump_is_told():
    waiting = []
    intake = Intake(TOPICS[:1], SLOP, lambda *_: None, lambda _: waiting.append(intake.gaps_s()))
    for role in (IMAGE, DEPTH):
        intake.add(SOURCE, role, message(START + 10 * SECOND))
    assert intake.gaps_s() != {}
    intake.add(SOURCE, IMAGE, message(START))
    assert waiting == [{}]


@pytest.mark.parametrize("length", [4, 9, 12])
def test_a_looped_recording_shorter_than_the_jump_goes_on(length):
    """Its last stamp comes again, equal to the newest, before there have been many older ones in a row."""
    live = Live(cameras=1)
    loops = [len([f for i in range(length) for f in live.frame(i * PERIOD // 2)]) for _ in range(12)]
    assert loops[0] == length and not any(loops[1 : STUBBORN // length])
    assert sum(loops) >= 3 * length and len(live.jumps) >= 2
    assert "time went back by 0." in live.jumps[0]


def test_late_messages_among_newer_ones_are_no_jump():
    live = Live(cameras=1)
    for number in range(3 * STUBBORN):
        live.frame(number * PERIOD)
        live.frame(number * PERIOD - PERIOD // 2)
    assert live.jumps == [] and len(live.refused) == 2 * 3 * STUBBORN


def test_a_stamp_that_stands_still_is_no_jump():
    live = Live(cameras=1)
    assert [f for _ in range(5 * STUBBORN) for f in live.frame(0)] == [(0,)]
    assert live.jumps == [] and len(live.refused) == 2 * (5 * STUBBORN - 1)


def test_the_slop_can_be_changed_while_running():
    live = Live(slop_ns=0)
    assert live.pair(0, 5 * MS) == [] and live.pair(PERIOD, 5 * MS) == []
    live.intake.slop_ns = SLOP
    live.pair(2 * PERIOD, 5 * MS)
    assert live.pair(3 * PERIOD, 5 * MS)[0] == (2 * PERIOD, 2 * PERIOD + 5 * MS)
    live.intake.slop_ns = 4 * MS
    assert live.pair(4 * PERIOD, 5 * MS) == [] and live.pair(5 * PERIOD, 5 * MS) == []
    live.intake.slop_ns = SLOP
    live.frame(6 * PERIOD, depth_after_ns=10 * MS)  # of image and depth it counts as well
    assert live.frame(6 * PERIOD, TARGET) == [(6 * PERIOD, 6 * PERIOD)]


def test_the_slop_outlives_forgetting():
    live = Live(slop_ns=0)
    live.intake.slop_ns = SLOP
    live.intake.forget()
    live.pair(0, 5 * MS)
    assert live.pair(PERIOD, 5 * MS) == [(0, 5 * MS)]


def test_gaps_say_how_far_streams_are_apart():
    live = Live()
    assert live.intake.gaps_s() == {}
    live.add(0)
    assert live.intake.gaps_s() == {}, "one stream alone has no gap"
    live.add(-250 * MS, SOURCE, DEPTH)
    assert live.intake.gaps_s() == pytest.approx({"/source/image and /source/depth": 0.25})
    live.frame(SECOND)
    live.frame(4 * SECOND, TARGET)
    expected = {"/source/image and /source/depth": 0, "/target/image and /target/depth": 0}
    assert live.intake.gaps_s() == pytest.approx(expected | {"/source/image and /target/image": -3.0})


def test_what_found_no_partner_is_counted_across_forgetting():
    live = Live()
    live.add(0)  # no depth
    live.frame(PERIOD)
    assert live.intake.unpaired == 1
    live.frame(3 * PERIOD, TARGET)
    assert live.intake.unpaired == 2
    for _ in range(3):
        live.intake.forget()
        assert live.intake.unpaired == 2
    live.frame(SECOND)
    live.frame(SECOND + PERIOD, TARGET)
    assert live.intake.unpaired == 3
    live.frame(0)  # a jump
    assert len(live.jumps) == 1 and live.intake.unpaired == 3


def test_forgetting_keeps_the_calibration():
    live = Live()
    live.frame(0)
    live.intake.forget()
    assert live.frame(0, TARGET) == [] and live.frame(0) == [(0, 0)] and live.refused == []
