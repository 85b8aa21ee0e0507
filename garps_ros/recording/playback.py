# SPDX-License-Identifier: Apache-2.0
"""Plays a recording into a live ROS 2 graph, with /clock and without rosbag2. Needs rclpy.

Messages travel as they were recorded (CDR), never through Python message objects; those of ROS 1 are rewritten byte by
byte, which takes Header.seq away.
"""

from __future__ import annotations

import atexit
import gc
import time
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import rclpy
from rclpy.context import Context
from rclpy.duration import Duration
from rclpy.node import Node
from rclpy.qos import HistoryPolicy, QoSProfile, ReliabilityPolicy
from rclpy.signals import SignalHandlerOptions
from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn
from rich.table import Table
from rosgraph_msgs.msg import Clock

from garps_ros.recording.bags import BagError
from garps_ros.recording.raw_bags import RawBag
from garps_ros.recording.routes import CLOCK_TOPIC, Route, open_routes
from garps_ros.recording.session import stop_on_signals
from garps_ros.recording.topics import IMAGE_TYPES
from msg_adapters import NANOSECONDS

INTERRUPTED = 130
TICK_S = 0.008
"""Wall time between two /clock messages, s: 100 Hz, with room for a coarse timer."""
LEAD_S = 0.1
"""Wall time that /clock runs before the first message, s."""
LATE_S = 0.2
"""Lag of the playback behind the recording beyond which a line is printed, s."""
SETTLE_S = 0.6
"""Time without a new subscription after which the listeners count as complete, s: they are matched one after another,
and `pose_node`, which looks at the publishers every 0.2 s, then subscribes anew with the QoS that they offer."""
PATIENCE_S = 3.0
"""Time that replaces `SETTLE_S` while the graph shows unmatched subscriptions, s; wrong QoS is never matched."""
DELIVERY_S = 5.0
"""Time that slow subscribers may take to acknowledge the last messages, s."""

# What rclpy and rclcpp subscribe /clock with, and what rosbag2 offers.
CLOCK_QOS = QoSProfile(history=HistoryPolicy.KEEP_LAST, depth=1, reliability=ReliabilityPolicy.BEST_EFFORT)
Say = Callable[[str], None]


def play(path: Path, rate: float, loop: bool, topics: list[str], wait_s: float) -> int:
    """Play a recording; return the exit code: 0 = to its end, 1 = no message could be sent, 130 = interrupted.

    Args:
        path: the recording, see `Bag`.
        rate: seconds of the recording per second.
        loop: again from the start, until interrupted; /clock jumps back.
        topics: what to play; empty for all whose type is installed.
        wait_s: how long to wait for a subscriber of an image before the first message.
    Raises:
        BagError: the recording or its topics cannot be played, or ROS does not start.
    """
    if not 0 < rate < float("inf"):
        raise BagError(f"--rate is {rate}: expected a speed above 0, such as 0.5 or 2")
    atexit.register(gc.freeze)  # else Python walks through all of torch once more before it ends: a second after Ctrl-C
    # Plain text: a topic must not be broken over two lines.
    console = Console(stderr=True, markup=False, emoji=False, highlight=False, soft_wrap=True)
    with RawBag(path) as bag, stop_on_signals() as stopped, _node() as node:
        routes, left_out = open_routes(node, bag, topics)
        if left_out:
            console.print(f"left out: {'; '.join(f'{topic} ({why})' for topic, why in left_out.items())}")
        player = Player(node, bag, routes, rate, stopped, console.print)
        if wait_s > 0:
            player.wait_for_listeners(wait_s)
        columns = (
            TextColumn("{task.description}"),
            BarColumn(),
            TextColumn("{task.completed:.1f} of {task.total:.1f} s"),
        )
        with Progress(*columns, console=console, transient=True, disable=not console.is_terminal) as progress:
            player.play(loop, progress)
        player.wait_for_delivery()
        Console(markup=False, emoji=False).print(_summary(routes, bag.broken_end))
        if stopped():
            return INTERRUPTED
        return 0 if any(route.sent for route in routes.values()) else 1


@contextmanager
def _node() -> Iterator[Node]:
    """Make a node with its own context; signals stay with the caller, so that no publisher is torn down in use."""
    context = Context()
    try:
        rclpy.init(args=[], context=context, signal_handler_options=SignalHandlerOptions.NO)
        node = Node("garps_replay", context=context, enable_rosout=False, start_parameter_services=False)
    except RuntimeError as error:  # what rcl's errors are
        context.try_shutdown()
        raise BagError(
            f"ROS 2 does not start: {' '.join(str(error).split())}. See ROS_DOMAIN_ID and its like"
        ) from None
    try:
        yield node
    finally:
        node.destroy_node()
        context.try_shutdown()


class Timeline:
    """The recording time that is due, by the steady clock: single sleeps do not add up to a drift.

    Args:
        first_ns: recording time of the first message, which is due `LEAD_S` from now.
        rate: seconds of the recording per second.
    """

    def __init__(self, first_ns: int, rate: float) -> None:
        self._first_ns, self._rate = first_ns, rate
        self._due_ns = time.monotonic_ns() + round(LEAD_S * NANOSECONDS)

    def now_ns(self) -> int:
        """Return the recording time that is due now, ns."""
        return self._first_ns + round((time.monotonic_ns() - self._due_ns) * self._rate)

    def remaining_s(self, recording_ns: int) -> float:
        """Return the wall time until a recording time is due, s; negative when it has passed."""
        return (recording_ns - self.now_ns()) / self._rate / NANOSECONDS


class Player:
    """Sends the messages of a recording when they are due, and /clock with them.

    Args:
        node: the publisher of /clock.
        bag: an open recording.
        routes: topic -> where its messages go.
        rate: seconds of the recording per second.
        stopped: says whether to end.
        say: prints a line.
    Raises:
        BagError: the recording breaks off before the first message.
    """

    def __init__(
        self, node: Node, bag: RawBag, routes: dict[str, Route], rate: float, stopped: Callable[[], bool], say: Say
    ) -> None:
        self._node, self._bag, self._routes, self._rate, self._stopped = node, bag, routes, rate, stopped
        self._say = say
        self._clock = node.create_publisher(Clock, CLOCK_TOPIC, CLOCK_QOS)
        first = next(bag.raw_messages(routes), None)
        if first is None:
            raise BagError(f"{bag.path} breaks off before its first message: {bag.broken_end or 'none can be read'}")
        self._first_ns = first[1]
        self._start_ns = max(0, self._first_ns - round(LEAD_S * rate * NANOSECONDS))
        self._clock_ns = 0
        self._late_said = False
        self._reading_s = self._sending_s = 0.0

    def wait_for_listeners(self, wait_s: float) -> None:
        """Wait for the first subscriber of any image, and for its other topics; /clock stands still until then."""
        images = [topic for topic, route in self._routes.items() if route.kind in IMAGE_TYPES] or list(self._routes)
        self._say(f"waiting up to {wait_s:g} s for a subscriber of {', '.join(images)}")
        begin = since = time.monotonic()
        seen = 0
        while not self._stopped():
            now = time.monotonic()
            matched = sum(route.listeners() for route in self._routes.values())
            if matched != seen:
                seen, since = matched, now
            heard = any(self._routes[topic].listeners() for topic in images)
            if (heard and now - since > self._settling_s(matched)) or (not heard and now - begin > wait_s):
                break
            self._tick(self._start_ns)
            time.sleep(TICK_S)
        if not self._stopped():
            self._say(self._listeners() if heard else "nobody listens to an image: playing all the same")

    def _settling_s(self, matched: int) -> float:
        """Return the time without a new subscription to wait for, s; longer while a known one is not yet matched."""
        known = sum(self._node.count_subscribers(topic) for topic in self._routes)
        return SETTLE_S if matched >= known else PATIENCE_S

    def _listeners(self) -> str:
        nodes: Counter[str] = Counter()
        for topic in self._routes:
            for info in self._node.get_subscriptions_info_by_topic(topic):
                nodes[f"{info.node_namespace.rstrip('/')}/{info.node_name}"] += 1
        return f"listening: {', '.join(f'{name} ({count} topics)' for name, count in sorted(nodes.items()))}"

    def play(self, loop: bool, progress: Progress) -> None:
        """Send everything, once or until stopped, showing how far it is."""
        total_s = max(0.0, (self._bag.end_ns - self._first_ns) / NANOSECONDS)
        task = progress.add_task("playing", total=total_s)
        rounds = 0
        while not self._stopped() and (loop or rounds == 0):
            rounds += 1
            progress.update(task, completed=0.0, description=f"round {rounds}" if loop else "playing")
            self._clock_ns = 0
            self._play_once(lambda done_s: progress.update(task, completed=min(max(done_s, 0.0), total_s)))

    def _play_once(self, show: Callable[[float], None]) -> None:
        timeline = Timeline(self._first_ns, self._rate)
        asked = time.monotonic()
        for topic, stamp_ns, raw in self._bag.raw_messages(self._routes):
            got = time.monotonic()
            self._reading_s += got - asked
            if not self._wait_until(stamp_ns, timeline, show):
                return
            began = time.monotonic()
            self._tick(stamp_ns)
            self._routes[topic].send(raw)
            asked = time.monotonic()
            self._sending_s += asked - began

    def _wait_until(self, stamp_ns: int, timeline: Timeline, show: Callable[[float], None]) -> bool:
        """Keep /clock running until a message is due; False when stopped."""
        remaining_s = timeline.remaining_s(stamp_ns)
        if remaining_s < -LATE_S and not self._late_said:
            self._say_late(-remaining_s, stamp_ns)
        elif remaining_s > 0:
            self._reading_s = self._sending_s = 0.0  # in time: what it took does not matter
        while remaining_s > 0 and not self._stopped():
            now_ns = min(timeline.now_ns(), stamp_ns)
            self._tick(now_ns)
            show((now_ns - self._first_ns) / NANOSECONDS)
            time.sleep(min(remaining_s, TICK_S))
            remaining_s = timeline.remaining_s(stamp_ns)
        return not self._stopped()

    def _tick(self, recording_ns: int) -> None:
        """Publish /clock; within a round it never goes back, even where a recording is out of order."""
        self._clock_ns = max(self._clock_ns, recording_ns, self._start_ns)
        message = Clock()
        message.clock.sec, message.clock.nanosec = divmod(self._clock_ns, NANOSECONDS)
        self._clock.publish(message)

    def _say_late(self, late_s: float, stamp_ns: int) -> None:
        self._late_said = True
        longer_s, what = max((self._reading_s, "reading the recording"), (self._sending_s, "sending"))
        cause = f"{what} took {longer_s:.1f} s of it" if longer_s > late_s / 2 else "the machine was busy or asleep"
        at_s = (stamp_ns - self._first_ns) / NANOSECONDS
        self._say(
            f"{late_s:.1f} s behind at {at_s:.1f} s of the recording: {cause}; messages go out late, close together. "
            "Expected to keep up: lower --rate, or play fewer --topics"
        )

    def wait_for_delivery(self) -> None:
        """Stay until subscribers have acknowledged what was sent: with the publisher its messages are gone."""
        end = time.monotonic() + DELIVERY_S
        waiting = list(self._routes.values())
        while waiting and not self._stopped():
            slow = (route for route in waiting if not route.delivered(Duration(seconds=0.02)))
            waiting = [route for route in slow if not self._stopped()]
            if waiting and time.monotonic() > end:
                topics = ", ".join(route.topic for route in waiting)
                self._say(f"not acknowledged within {DELIVERY_S:g} s, the last messages may be lost: {topics}")
                return


def _summary(routes: dict[str, Route], broken_end: str) -> Table:
    """Return a table of the messages by topic, with the reasons of those refused."""
    table = Table(title="Played")
    for heading, justify in (("topic", "left"), ("type", "left"), ("messages", "right")):
        table.add_column(heading, justify=justify, overflow="fold")  # type: ignore[arg-type]
    for route in routes.values():
        table.add_row(route.topic, route.kind, str(route.sent))
        if route.refused:
            table.add_row("", f"refused: {route.reason}", str(route.refused))
    if broken_end:
        table.add_row("recording breaks off", broken_end, "")
    return table
