# SPDX-License-Identifier: Apache-2.0
"""A live graph for demo and benchmarks: a domain of one's own, child processes, and a node that listens."""

from __future__ import annotations

import os
import random
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import IO
from unittest import mock

from rclpy.context import Context
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node

LARGE_IMAGES = Path(__file__).resolve().parents[2] / "config" / "fastdds_large_images.xml"
STOP_S = 10.0
"""Patience with a process that has been told to end."""


class LiveError(Exception):
    """A node did not come up, or did not do what is measured."""


@contextmanager
def private_domain() -> Iterator[None]:
    """Nobody else's messages: this machine only, a domain that is unlikely to be in use; large images get through."""
    ours = {
        "ROS_DOMAIN_ID": str(random.randint(1, 101)),
        "ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST",
        "FASTRTPS_DEFAULT_PROFILES_FILE": str(LARGE_IMAGES),
    }
    with mock.patch.dict(os.environ, ours):
        yield


def start(module: str, arguments: list[str], output: IO[str]) -> subprocess.Popen[bytes]:
    """Start `python -m module` with everything it writes going to `output`."""
    return subprocess.Popen([sys.executable, "-m", module, *arguments], stdout=output, stderr=subprocess.STDOUT)


def end(process: subprocess.Popen[bytes]) -> int:
    """The exit code after SIGINT; after SIGKILL when that does nothing."""
    process.send_signal(signal.SIGINT)
    try:
        return process.wait(STOP_S)
    except subprocess.TimeoutExpired:
        process.kill()
        return process.wait()


class Listener:
    """A node of this process and what runs its callbacks."""

    def __init__(self, ros: Node, executor: SingleThreadedExecutor) -> None:
        self.ros, self._executor = ros, executor

    def wait(self, done: Callable[[], bool], seconds: float = float("inf")) -> bool:
        """Receive until `done`, at most so long; returns whether it was."""
        until = time.monotonic() + seconds
        while not done() and time.monotonic() < until:
            self._executor.spin_once(timeout_sec=min(0.05, max(0.0, until - time.monotonic())))
        return done()


@contextmanager
def listener(name: str) -> Iterator[Listener]:
    """A listener in a context of its own; enter `private_domain` first."""
    context = Context()
    context.init(args=[])
    try:
        ros = Node(name, context=context)
        executor = SingleThreadedExecutor(context=context)
        executor.add_node(ros)
        yield Listener(ros, executor)
        executor.shutdown()
        ros.destroy_node()
    finally:
        context.try_shutdown()
