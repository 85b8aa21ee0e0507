# SPDX-License-Identifier: Apache-2.0
"""Command garps-replay --to-ros on a live graph: messages arrive as recorded, when they are due, with their time."""

import os
import re
import signal
import subprocess
import sys
import threading
import time
from itertools import pairwise

import pytest
from counted_time import CountedTime
from graph import PATIENCE_S, Peer, private_domain
from places import ROOT
from rclpy.parameter import Parameter
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from rclpy.serialization import deserialize_message
from recordings import PERIOD, SECOND, START, STORAGES, frames, library_of, write
from ros_messages import ROS1, ROS2, rclpy_class
from rosbags.interfaces import Qos, QosDurability, QosHistory, QosLiveliness, QosReliability, QosTime
from rosbags.rosbag1 import Writer as Writer1
from rosbags.rosbag2 import StoragePlugin, Writer
from rosbags.typesys import get_types_from_msg

from garps_ros import replay
from garps_ros.recording import playback

ROS1.register(get_types_from_msg("uint8 value", "made_up_msgs/msg/Thing"))
CAMERA = {
    "/cam/image_raw": "sensor_msgs/msg/Image",
    "/cam/camera_info": "sensor_msgs/msg/CameraInfo",
    "/cam/depth/image_raw": "sensor_msgs/msg/Image",
}
DEEP = QoSProfile(depth=5000, reliability=ReliabilityPolicy.RELIABLE)
CLOCK = QoSProfile(depth=5000, reliability=ReliabilityPolicy.BEST_EFFORT)
LATE = QoSProfile(depth=10, reliability=ReliabilityPolicy.RELIABLE, durability=DurabilityPolicy.TRANSIENT_LOCAL)


@pytest.fixture(scope="module", autouse=True)
def domain(tmp_path_factory):
    with private_domain(tmp_path_factory.mktemp("log")) as domain:
        yield domain


@pytest.fixture(autouse=True)
def clock(monkeypatch):
    """The clock of the playback in this process, which only its own sleeps advance."""
    clock = CountedTime(real_sleep=True)
    monkeypatch.setattr(playback, "time", clock)
    monkeypatch.setattr(playback, "SETTLE_S", 0.3)  # no listener here subscribes anew
    return clock


@pytest.fixture
def sent_s(monkeypatch, clock):
    """Times on that clock at which messages were sent, s."""
    times, send = [], playback.Route.send
    monkeypatch.setattr(playback.Route, "send", lambda *given: (times.append(clock.now_s), send(*given))[1])
    return times


class Listener(Peer):
    """A peer in a thread of its own: serialised messages by topic, their number, and the times of /clock."""

    def __init__(self, domain, topics=CAMERA):
        super().__init__(domain, "listener")
        self.raw, self.arrived, self.clock = {}, 0, []
        self.on_message = lambda topic: None
        for topic, kind in topics.items():
            self.listen(topic, kind)
        self.node.create_subscription(rclpy_class("rosgraph_msgs/msg/Clock"), "/clock", self._time, CLOCK)
        self._done = threading.Event()
        self._thread = threading.Thread(target=self._spin)

    def listen(self, topic, kind, quality=DEEP):
        self.raw.setdefault(topic, [])
        self.node.create_subscription(rclpy_class(kind), topic, lambda raw: self._take(topic, raw), quality, raw=True)

    def _take(self, topic, raw):
        self.raw[topic].append(bytes(raw))
        self.arrived += 1
        self.on_message(topic)

    def _time(self, message):
        self.clock.append(message.clock.sec * SECOND + message.clock.nanosec)

    def _spin(self):
        while not self._done.is_set():
            self.spin(0.1)

    def until(self, condition):
        """Wait until the thread has made a condition true."""
        end = time.monotonic() + PATIENCE_S
        while not condition():
            if time.monotonic() > end:
                pytest.fail(f"the condition did not come true in {PATIENCE_S} s: the thread hangs")
            time.sleep(0.01)

    def __enter__(self):
        self._thread.start()
        return self

    def __exit__(self, *error):
        time.sleep(0.2)  # what is underway
        self._done.set()
        self._thread.join()
        super().__exit__(*error)


def play(bag, *options):
    return replay.main([str(bag), "--to-ros", *map(str, options)])


def child(bag, *options):
    """The command in a process of its own."""
    command = [sys.executable, "-m", "garps_ros.replay", str(bag), "--to-ros", *map(str, options)]
    return subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, cwd=ROOT)


def body(raw):
    """Return a message without its encapsulation header, padded to four bytes, as it may be on the way."""
    return bytes(raw[4:]) + bytes(-len(raw) % 4)


def as_cdr(messages):
    """Topic -> its messages as ROS 2 serialises them."""
    found = {}
    for topic, message in messages:
        found.setdefault(topic, []).append(body(ROS2.serialize_cdr(message, message.__msgtype__)))
    return found


def received(listener):
    return {topic: [body(raw) for raw in messages] for topic, messages in listener.raw.items()}


@pytest.mark.parametrize("storage", STORAGES)
def test_every_message_arrives_as_recorded_and_the_clock_tells_its_time(domain, tmp_path, capfd, storage):
    bag = write(tmp_path, storage, frames(["/cam"], 8, library_of(storage)))
    with Listener(domain) as listener:
        assert play(bag) == 0
    assert received(listener) == as_cdr(frames(["/cam"], 8, "rosbags"))
    times = [START + index * PERIOD for index in range(1, 9)]
    clock = listener.clock
    assert clock == sorted(clock) and set(times) <= set(clock)
    assert times[0] - 2 * PERIOD < clock[0] < times[0] and clock[-1] == times[-1]
    steps = sorted(late - early for early, late in pairwise(clock) if late > early)
    assert steps[len(steps) // 2] == pytest.approx(8_000_000, abs=10), "100 Hz and more"
    shown = capfd.readouterr()
    assert "waiting up to 10 s for a subscriber of /cam/depth/image_raw, /cam/image_raw" in shown.err
    assert "listening: /listener (3 topics)" in shown.err
    assert re.search(r"/cam/image_raw +│ sensor_msgs/msg/Image +│ +8 ", shown.out)


def test_a_node_on_simulated_time_lives_in_the_recording(domain, tmp_path):
    bag, heard = write(tmp_path, "mcap", frames(["/cam"], 4, "rosbags")), []
    with Listener(domain) as listener:
        listener.node.set_parameters([Parameter("use_sim_time", value=True)])
        listener.node.create_timer(0.05, lambda: heard.append(listener.node.get_clock().now().nanoseconds))
        assert play(bag) == 0
        listener.until(lambda: listener.node.get_clock().now().nanoseconds == START + 4 * PERIOD)
    during = len([at for at in heard if START < at < START + 4 * PERIOD])
    assert 1 <= during <= 9, "at most once in 0.05 s of the recording's 0.4 s"


@pytest.mark.parametrize("rate", [1, 10])
def test_the_rate_is_seconds_of_the_recording_per_second(domain, tmp_path, sent_s, rate):
    bag = write(tmp_path, "mcap", frames(["/cam"], 1 + 5 * rate, "rosbags"))
    with Listener(domain) as listener:
        assert play(bag, "--rate", rate) == 0
    assert len(listener.raw["/cam/image_raw"]) == 1 + 5 * rate
    assert sent_s[-1] - sent_s[0] == pytest.approx(0.5, abs=1e-6)


def test_a_loop_starts_again_and_its_clock_jumps_back(domain, tmp_path):
    bag = write(tmp_path, "mcap", frames(["/cam"], 3, "rosbags"))
    with Listener(domain) as listener:
        listener.on_message = lambda topic: listener.arrived == 12 and os.kill(os.getpid(), signal.SIGINT)
        assert play(bag, "--loop") == 130
    images = received(listener)["/cam/image_raw"]
    assert images[:3] == as_cdr(frames(["/cam"], 3, "rosbags"))["/cam/image_raw"] and images[3] == images[0]
    jumps = [late - early for early, late in pairwise(listener.clock) if late < early]
    assert len(jumps) == 1 and -4 * PERIOD < jumps[0] < -2 * PERIOD


def offered(durability):
    never = QosTime(0, 0)
    return Qos(
        *(QosHistory.KEEP_LAST, 1, QosReliability.RELIABLE, durability),
        *(never, never, QosLiveliness.AUTOMATIC, never, False),
    )


def latched(folder, storage):
    """A string that is said once, at the start, by a publisher that keeps it; and images for a second."""
    if storage == "ros1":
        writer, store, serialize = Writer1(folder / "a.bag"), ROS1, ROS1.serialize_ros1
        extra = {"latching": 1}
    else:
        writer = Writer(folder / "a", version=9, storage_plugin=StoragePlugin.MCAP)
        store, serialize = ROS2, ROS2.serialize_cdr
        extra = {"offered_qos_profiles": [offered(QosDurability.TRANSIENT_LOCAL)]}
    text = store.types["std_msgs/msg/String"]("kept")
    with writer:
        kept = writer.add_connection("/kept", "std_msgs/msg/String", typestore=store, **extra)
        writer.write(kept, START, bytes(serialize(text, text.__msgtype__)))
        said = writer.add_connection("/said", "std_msgs/msg/String", typestore=store)
        for index in range(10):
            writer.write(said, START + index * PERIOD, bytes(serialize(text, text.__msgtype__)))
    return writer.path


@pytest.mark.parametrize("storage", ["mcap", "ros1"])
def test_late_subscribers_get_what_was_latched(domain, tmp_path, storage):
    def join_late(topic):
        if topic == "/said" and len(listener.raw["/said"]) == 3:
            listener.listen("/kept", "std_msgs/msg/String", LATE)

    with Listener(domain, {"/said": "std_msgs/msg/String"}) as listener:
        listener.on_message = join_late
        assert play(latched(tmp_path, storage)) == 0
    text = deserialize_message(listener.raw["/kept"][0], rclpy_class("std_msgs/msg/String"))
    assert text.data == "kept" and len(listener.raw["/kept"]) == 1


def mixed(folder):
    """Images, a type nobody has installed, a clock, and a message of ROS 1 that ROS 2 defines otherwise."""
    make = ROS1.types
    now = make["builtin_interfaces/msg/Time"](1, 0)
    head = make["std_msgs/msg/Header"](seq=1, stamp=now, frame_id="a")
    others = {
        "/thing": make["made_up_msgs/msg/Thing"](1),
        "/clock": make["rosgraph_msgs/msg/Clock"](now),
        "/range": make["sensor_msgs/msg/Range"](head, 0, 0.1, 0.1, 5.0, 1.0),
    }
    raw = [(topic, (m.__msgtype__, ROS1.serialize_ros1(m, m.__msgtype__), START)) for topic, m in others.items()]
    return write(folder, "ros1", [*raw, *frames(["/cam"], 2, "rosbags_ros1")])


def test_what_cannot_be_played_is_named_and_the_rest_is_played(domain, tmp_path, capfd):
    with Listener(domain, {**CAMERA, "/range": "sensor_msgs/msg/Range"}) as listener:
        assert play(mixed(tmp_path)) == 0
    found = received(listener)
    assert found.pop("/range") == [] and found == as_cdr(frames(["/cam"], 2, "rosbags"))
    shown = capfd.readouterr()
    left_out = "left out: /clock (the clock is made from the recording times); /thing (made_up_msgs/msg/Thing is not in"
    assert shown.err.count(left_out) == 1
    assert "refused: does not fit the type installed" in shown.out


def test_only_the_topics_that_were_asked_for_are_played(domain, tmp_path):
    bag = write(tmp_path, "mcap", frames(["/cam"], 2, "rosbags"))
    with Listener(domain) as listener:
        assert play(bag, "--topics", "/cam/camera_info", "--topics", "/cam/image_raw") == 0
    assert {topic: len(raw) for topic, raw in listener.raw.items()} == {
        "/cam/image_raw": 2,
        "/cam/camera_info": 2,
        "/cam/depth/image_raw": 0,
    }


def test_it_waits_for_a_subscriber_or_says_that_there_is_none(tmp_path, capfd, clock, sent_s):
    bag = write(tmp_path, "mcap", frames(["/cam"], 2, "rosbags"))
    began_s = clock.now_s
    assert play(bag, "--wait", 1) == 0
    assert sent_s[0] - began_s > 1
    assert "nobody listens to an image: playing all the same" in capfd.readouterr().err
    began_s = clock.now_s
    sent_s.clear()
    assert play(bag, "--wait", 0) == 0
    assert sent_s[0] - began_s == pytest.approx(playback.LEAD_S)
    assert capfd.readouterr().err == ""


def test_being_late_is_said_once_and_nothing_is_lost(domain, tmp_path):
    bag = write(tmp_path, "mcap", frames(["/cam"], 12, "rosbags"))
    with Listener(domain) as listener, child(bag) as process:
        while len(listener.raw["/cam/image_raw"]) < 2:
            time.sleep(0.02)
        process.send_signal(signal.SIGSTOP)
        time.sleep(0.6)
        process.send_signal(signal.SIGCONT)
        _, errors = process.communicate(timeout=30)
    said = r"\d+\.\d s behind at \d\.\d s of the recording: the machine was busy or asleep; messages go out late"
    assert process.returncode == 0 and len(re.findall(said, errors)) == 1, errors
    assert received(listener) == as_cdr(frames(["/cam"], 12, "rosbags"))


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_an_interruption_ends_it_long_before_the_end(domain, tmp_path, number):
    bag = write(tmp_path, "mcap", frames(["/cam"], 250, "rosbags"))
    process = child(bag, "--wait", 60)
    with process:
        assert process.stderr.readline().startswith("waiting up to 60 s")
        if number == signal.SIGTERM:  # this one while playing
            with Listener(domain) as listener:
                while not listener.arrived:
                    time.sleep(0.05)
        process.send_signal(number)
        played, errors = process.communicate(timeout=60)
    assert process.returncode == 130 and "Traceback" not in errors
    (sent,) = re.findall(r"/cam/image_raw +│ sensor_msgs/msg/Image +│ +(\d+) ", played)
    assert int(sent) < 200 if number == signal.SIGTERM else int(sent) == 0


@pytest.mark.parametrize(("step", "frozen"), [("", False), ("playback.play(Path('nothing'), 1, False, [], 0)", True)])
def test_only_playing_changes_how_the_process_ends(step, frozen):
    """Python calls the exit function that was registered first at last."""
    code = (
        "import atexit, gc; before = gc.get_freeze_count()\n"  # some Pythons start with frozen objects
        "atexit.register(lambda: print(gc.get_freeze_count() > before))\n"
        f"from pathlib import Path; from garps_ros.recording import playback; {step}"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, cwd=ROOT, timeout=60)
    assert done.stdout.strip() == str(frozen), done.stderr


WITHOUT_RCLPY = (
    "import sys; sys.modules['rclpy'] = None; from garps_ros import replay; sys.exit(replay.main(sys.argv[1:]))"
)
MISTAKES = {
    "offline option": (["--limit", "3", "--set", "a=1"], "--limit, --set cannot be used with --to-ros: expected only"),
    "no such topic": (["--topics", "/x"], "topic /x is not in the recording: expected one of /cam/camera_info"),
    "topic not installed": (["--topics", "/thing"], r"cannot play /thing \(made_up_msgs/msg/Thing is not installed\)"),
    "rate": (["--rate", "0"], "--rate"),
    "not a number": (["--rate", "nan"], "--rate"),
    "wait": (["--wait", "-1"], "--wait"),
}


@pytest.mark.parametrize("name", MISTAKES)
def test_mistakes_are_one_line_and_code_2(tmp_path, capfd, name):
    options, expected = MISTAKES[name]
    assert play(mixed(tmp_path), *options) == 2
    err = capfd.readouterr().err
    assert err.startswith("garps-replay: error: ") and err.count("\n") == 1
    assert re.search(expected, err), err


def test_playback_options_are_for_playback(tmp_path, capfd):
    assert replay.main([str(mixed(tmp_path)), "--loop", "--rate", "2"]) == 2
    assert capfd.readouterr().err == "garps-replay: error: --loop, --rate needs --to-ros\n"


def test_a_domain_that_is_none_is_one_line(tmp_path, capfd, monkeypatch):
    monkeypatch.setenv("ROS_DOMAIN_ID", "kitchen")
    assert play(mixed(tmp_path)) == 2
    err = capfd.readouterr().err
    assert "ROS 2 does not start" in err and "ROS_DOMAIN_ID" in err and err.count("\n") == 1


def test_without_rclpy_it_says_how_to_get_it(tmp_path):
    command = [sys.executable, "-c", WITHOUT_RCLPY, str(mixed(tmp_path)), "--to-ros"]
    done = subprocess.run(command, capture_output=True, text=True, cwd=ROOT, timeout=60)
    assert done.returncode == 2 and done.stderr.count("\n") == 1
    assert "--to-ros needs ROS 2 with rclpy" in done.stderr and "/opt/ros/jazzy/setup.bash" in done.stderr
