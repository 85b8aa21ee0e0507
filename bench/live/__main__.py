# SPDX-License-Identifier: Apache-2.0
"""`python -m bench.live`: what the live node costs beyond the estimator, on a real graph.

overhead: time from the newest image of a pair to its PoseStamped, seen from outside, less the estimator's own time.
load:     share of 15 Hz 640x480 images that arrive, and how late, while computations of 1.5 s and more run.
memory:   growth of the node's resident memory over thousands of pairs of a cheap configuration.

Cameras, node and listener are real processes on a real graph with the Fast DDS profile for large images. Needs rclpy.
"""

from __future__ import annotations

import array
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer
from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import PoseStamped
from rclpy.qos import QoSProfile
from rich.console import Console
from rich.progress import Progress
from rich.table import Table
from sensor_msgs.msg import CameraInfo, Image

from bench.live.graph import Listener, LiveError, end, listener, private_domain, start
from bench.rooms import RoomPair, make_pair
from msg_adapters import ns_to_stamp, stamp_to_ns

ROOM_SEED, ROOM_LEVEL = 3, 2
SLOW = (
    "lifting.stride: 1\nmethod: paper\npaper.steps: 8\npaper.neighbours: 20\n"
    "paper.opacity_threshold: 0.0\npaper.component_stride: 1\n"
)
"""Settings under which a pair of 640x480 takes 1.5 s and more on two cores; nobody would want them."""
CHEAP = "lifting.stride: 8\nstart.max_features: 300\n"
"""Settings under which the estimate takes little beside what is measured."""
WARM_UP = 3
ANSWER_S, START_S = 20.0, 60.0
LAST_DELAY = "target/depth delay p50 / max (ms)"
console = Console()


@dataclass
class Answers:
    """Messages that have come from the node."""

    poses_s: dict[int, float] = field(default_factory=dict)
    """Arrival (steady time, s) by stamp, ns."""
    values: dict[str, str] = field(default_factory=dict)
    """All values of the last diagnostics."""

    def pose(self, message: PoseStamped) -> None:
        """A pose has come."""
        self.poses_s[stamp_to_ns(message.header.stamp)] = time.monotonic()

    def diagnostics(self, message: DiagnosticArray) -> None:
        """Diagnostics have come."""
        for status in message.status:
            self.values |= {pair.key: pair.value for pair in status.values}

    def number(self, key: str) -> float:
        """A value of the diagnostics as a number. Raises LiveError when it is not there."""
        try:
            return float(self.values[key].split(" / ")[-1])
        except (KeyError, ValueError):
            raise LiveError(f"the node's diagnostics have no {key!r}: {self.values}") from None


class Cameras:
    """Publishes both views of a room pair as their drivers would; the messages are made once."""

    def __init__(self, heard: Listener, pair: RoomPair) -> None:
        self._all: list[tuple[Any, Any]] = []
        for side, rgb, depth, K in (
            ("source", pair.rgb0, pair.depth0, pair.K0),
            ("target", pair.rgb1, pair.depth1, pair.K1),
        ):
            millimetres = np.nan_to_num(np.rint(1000 * depth)).astype(np.uint16)
            for topic, message in (
                ("camera_info", camera_info(K, rgb.shape)),
                ("image", image(rgb, "rgb8")),
                ("depth", image(millimetres, "16UC1")),
            ):
                message.header.frame_id = f"{side}_optical"
                self._all.append((heard.ros.create_publisher(type(message), f"{side}/{topic}", QOS), message))

    def matched(self) -> bool:
        """The node hears every topic."""
        return all(publisher.get_subscription_count() for publisher, _ in self._all)

    def publish(self, stamp_ns: int) -> float:
        """Publish a pair; returns the steady time just before the newest message, s."""
        sec, nanosec = ns_to_stamp(stamp_ns)
        for publisher, message in self._all:
            message.header.stamp.sec, message.header.stamp.nanosec = sec, nanosec
            sent_s = time.monotonic()
            publisher.publish(message)
        return sent_s


QOS = QoSProfile(depth=10)


def image(pixels: Any, encoding: str) -> Image:
    """A sensor_msgs/Image."""
    message = Image(height=pixels.shape[0], width=pixels.shape[1], encoding=encoding)
    message.step = pixels.nbytes // pixels.shape[0]
    data = array.array("B")
    data.frombytes(np.ascontiguousarray(pixels).tobytes())
    message.data = data
    return message


def camera_info(K: Any, shape: tuple[int, ...]) -> CameraInfo:
    """The calibration of a camera without distortion."""
    message = CameraInfo(height=shape[0], width=shape[1], distortion_model="plumb_bob")
    message.d = array.array("d", [0.0] * 5)
    message.k = np.asarray(K, np.float64).ravel()
    message.p = np.hstack([K, np.zeros((3, 1))]).ravel()
    return message


@contextmanager
def rig(settings: str, width: int, height: int) -> Iterator[tuple[Listener, Cameras, Answers]]:
    """Start a node with the text of a settings file, and its cameras; yield what it answers, all warmed up."""
    folder = Path(tempfile.mkdtemp(prefix="garps_live_"))
    file, log = folder / "settings.yaml", folder / "node.log"
    file.write_text(settings, encoding="utf-8")
    with private_domain(), log.open("w", encoding="utf-8") as output, listener("bench") as heard:
        node = start("garps_ros.pose_node", ["--ros-args", "-p", f"settings_file:={file}"], output)
        try:
            cameras = Cameras(heard, make_pair(ROOM_SEED, ROOM_LEVEL, width=width, height=height))
            answers = Answers()
            heard.ros.create_subscription(PoseStamped, "/pose_node/pose", answers.pose, QOS)
            heard.ros.create_subscription(DiagnosticArray, "/diagnostics", answers.diagnostics, QOS)
            if not heard.wait(cameras.matched, START_S):
                raise LiveError(f"the node did not come up within {START_S:g} s: see {log}")
            heard.wait(lambda: False, 1.0)  # until it has subscribed in the QoS offered
            for _ in range(WARM_UP):
                answered(heard, cameras, answers)
            yield heard, cameras, answers
            if (code := end(node)) != 0:
                raise LiveError(f"the node ended with exit code {code}: see {log}")
        finally:
            node.kill()


def answered(heard: Listener, cameras: Cameras, answers: Answers) -> float:
    """Publish a pair and wait for its pose; returns the seconds between. Raises LiveError when none comes."""
    stamp_ns = time.time_ns()
    sent_s = cameras.publish(stamp_ns)
    if not heard.wait(lambda: stamp_ns in answers.poses_s, ANSWER_S):
        raise LiveError(f"no pose within {ANSWER_S:g} s; diagnostics: {answers.values}")
    return answers.poses_s.pop(stamp_ns) - sent_s


def measure_overhead(pairs: int, progress: Progress) -> list[tuple[str, str]]:
    """One pair at a time, so that none waits for another; cheap to estimate, so that its spread hides nothing."""
    with rig(CHEAP, 640, 480) as (heard, cameras, answers):
        seconds = []
        for _ in progress.track(range(pairs), description="overhead"):
            seconds.append(answered(heard, cameras, answers))
            heard.wait(lambda: False, 0.05)
        heard.wait(lambda: False, 1.5)  # the diagnostics of the last ones
        total, core = 1000 * float(np.median(seconds)), answers.number("core p50 (ms)")
        return [
            ("newest image -> PoseStamped, median", f"{total:.1f} ms"),
            ("of it inside estimate_relative_pose, median", f"{core:.1f} ms"),
            ("beyond it", f"{total - core:.1f} ms"),
            ("last image: delay from stamp to callback, median / largest", f"{answers.values[LAST_DELAY]} ms"),
            ("of that inside the node", f"{answers.number('overhead p50 (ms)'):.1f} ms"),
        ]


def measure_load(seconds: float, progress: Progress, rate_hz: float = 15.0) -> list[tuple[str, str]]:
    """Cameras at full rate while the worker is never idle."""
    roles = [f"{side}/{part}" for side in ("source", "target") for part in ("image", "depth")]
    with rig(SLOW, 640, 480) as (heard, cameras, answers):
        heard.wait(lambda: False, 1.5)
        before = {role: answers.number(f"{role} count") for role in roles}
        sent, began = 0, time.monotonic()
        for _ in progress.track(range(round(seconds * rate_hz)), description="load"):
            cameras.publish(time.time_ns())
            sent += 1
            heard.wait(lambda: False, max(0.0, began + sent / rate_hz - time.monotonic()))
        heard.wait(lambda: False, 1.5)
        seen = min((answers.number(f"{role} count") - before[role]) / sent for role in roles)
        delays = [answers.values[f"{role} delay p50 / max (ms)"].split(" / ") for role in roles]
        return [
            ("computation, median", f"{answers.number('core p50 (ms)') / 1000:.2f} s"),
            (f"of {sent} images at {rate_hz:g} Hz seen, worst of {len(roles)} topics", f"{seen:.1%}"),
            ("delay from stamp to callback, median / largest", " / ".join(f"{d:.0f} ms" for d in _worst(delays))),
        ]


def _worst(delays: list[list[str]]) -> tuple[float, float]:
    return max(float(median) for median, _ in delays), max(float(largest) for _, largest in delays)


def measure_memory(pairs: int, progress: Progress) -> list[tuple[str, str]]:
    """Resident memory after a tenth of the pairs and at the end."""
    with rig(CHEAP, 160, 120) as (heard, cameras, answers):
        resident = []
        for index in progress.track(range(pairs), description="memory"):
            answered(heard, cameras, answers)
            if index in (pairs // 10, pairs - 1):
                heard.wait(lambda: False, 1.5)
                resident.append(answers.number("memory (MB)"))
        return [
            (f"resident after {pairs // 10} pairs", f"{resident[0]:.1f} MB"),
            (f"resident after {pairs} pairs", f"{resident[1]:.1f} MB"),
            ("growth", f"{resident[1] - resident[0]:+.1f} MB"),
        ]


def main(
    pairs: Annotated[int, typer.Option(help="Pairs for the overhead.", min=1)] = 60,
    seconds: Annotated[float, typer.Option(help="Duration of the load.", min=1)] = 20.0,
    memory_pairs: Annotated[int, typer.Option(help="Pairs for the memory.", min=20)] = 2000,
    only: Annotated[str, typer.Option(help="overhead, load or memory; all when empty.")] = "",
) -> int:
    """Measure and print a table."""
    with Progress(console=console, transient=True) as progress:
        parts = {
            "overhead": lambda: measure_overhead(pairs, progress),
            "load": lambda: measure_load(seconds, progress),
            "memory": lambda: measure_memory(memory_pairs, progress),
        }
        if only and only not in parts:
            console.print(f"bench.live: error: --only is {only!r}: expected one of {', '.join(parts)}")
            return 2
        rows = [row for name, part in parts.items() if only in ("", name) for row in part()]
    table = Table("what", "measured", title="Live node")
    for row in rows:
        table.add_row(*row)
    console.print(table)
    return 0


if __name__ == "__main__":
    app = typer.Typer(add_completion=False, rich_markup_mode=None)
    app.command()(main)
    sys.exit(app(standalone_mode=False))
