# SPDX-License-Identifier: Apache-2.0
"""The node inside this process, with faults put into it: it reports them, and goes on."""

import subprocess
import sys
import threading
import time
from contextlib import contextmanager

import pytest
from graph import ROOT, SECOND, Camera, Peer, room_pair

pytest.importorskip("rclpy")
import rclpy
from nav_msgs.msg import Odometry
from rclpy.executors import SingleThreadedExecutor
from recordings import COVARIANCE, answering, moved

from garps_core.types import PoseEstimate, Status
from garps_ros.live import jobs
from garps_ros.live.node import PoseNode
from msg_adapters import header_stamp_ns


class Inside:
    """A node in a thread of this process, a peer, two cameras, and the poses that come."""

    def __init__(self, domain, peer, settings):
        words = [word for setting in settings for word in ("-p", setting)]
        self.context = rclpy.Context()
        self.context.init(args=["--ros-args", *words] if words else [], domain_id=domain.number)
        self.ros = rclpy.create_node("pose_node", context=self.context)
        self.node = PoseNode(self.ros)
        self.errors = []
        self._stopped = threading.Event()
        self._thread = threading.Thread(target=self._spin)
        self._thread.start()
        self.peer = peer
        self.cameras = [Camera(peer, side, room_pair()) for side in ("source", "target")]
        self.found = peer.collect(Odometry, "/pose_node/odometry")
        self._stamp_ns = 1_700_000_000 * SECOND

    def _spin(self):
        executor = SingleThreadedExecutor(context=self.context)
        executor.add_node(self.ros)
        while not self._stopped.is_set():
            try:
                executor.spin_once(timeout_sec=0.05)
            except Exception as error:
                self.errors.append(error)
                self.node.failed(error, "trace")
        executor.shutdown()

    def close(self):
        self._stopped.set()
        self._thread.join(5)
        assert self.node.stop(10)
        self.ros.destroy_node()
        self.context.try_shutdown()

    def answer(self, seconds=20):
        """Send pairs until one is answered."""
        sent, end = set(), time.monotonic() + seconds
        while time.monotonic() < end:
            sent.add(self.send())
            self.peer.spin(0.3)
            if any(header_stamp_ns(message) in sent for _, message in self.found):
                return
        pytest.fail(f"no pose; {self.peer.diagnostics()}")

    def send(self):
        self._stamp_ns += SECOND // 10
        for camera in self.cameras:
            camera.publish(self._stamp_ns)
        return self._stamp_ns

    def says(self, name, text, seconds=6):
        """Wait until a status holds a text; return its level."""
        full = f"pose_node: {name}"
        self.peer.wait(lambda: text in self.peer.diagnostics().get(full, (0, "", {}))[1], seconds, f"{name}: {text!r}")
        return self.peer.diagnostics()[full][0]


@pytest.fixture
def estimates(monkeypatch):
    """The estimator's next answer: a function put in `estimates.next` is called once in its place."""

    class Estimates:
        next = None

    def estimate(source, target, config, prior=None):
        fault, Estimates.next = Estimates.next, None
        found = PoseEstimate(Status.CONVERGED, "", moved(0.1), COVARIANCE, overlap=0.9) if fault is None else fault()
        return found, None

    monkeypatch.setattr(jobs, "Estimator", answering(estimate))
    return Estimates


@contextmanager
def inside(domain, *settings):
    with Peer(domain) as peer:
        held = Inside(domain, peer, settings)
        try:
            yield held
        finally:
            held.close()


def test_a_dead_worker_is_an_error_and_is_replaced(domain, estimates):
    def die():
        raise SystemExit("made to die")

    with inside(domain) as node:
        node.answer()
        estimates.next = die
        node.send()
        assert node.says("machine", "worker: ended by SystemExit: made to die; restarted") == 2
        node.found.clear()
        node.answer()
        assert node.errors == []


def test_an_unexpected_error_is_a_rejected_pair(domain, estimates):
    def fail():
        raise RuntimeError("CUDA error: out of memory")

    with inside(domain) as node:
        node.answer()
        estimates.next = fail
        node.send()
        assert node.says("estimates", "core_error: RuntimeError: CUDA error: out of memory") == 1
        node.found.clear()
        node.answer()


def test_a_computation_that_hangs_is_called_stuck(domain, estimates):
    released = threading.Event()

    def hang():
        released.wait(30)
        return PoseEstimate(Status.LOW_OVERLAP, "late")

    with inside(domain, "stage_timeout:=0.5") as node:
        node.answer()
        estimates.next = hang
        node.send()
        assert node.says("machine", "stuck: estimate has taken") == 2
        released.set()
        node.found.clear()
        node.answer()


def test_an_error_in_a_callback_is_counted_and_survived(domain, estimates, monkeypatch):
    with inside(domain) as node:
        node.answer()

        def broken(*_):
            monkeypatch.undo()
            raise ValueError("made to fail")

        monkeypatch.setattr(node.node._intake, "add", broken)
        node.send()
        assert node.says("machine", "callback: ValueError: made to fail") == 2
        assert [str(error) for error in node.errors] == ["made to fail"]


@pytest.mark.parametrize(
    ("estimate", "status"),
    [
        (lambda: PoseEstimate(Status.POOR_FIT, "few", moved(0.1), COVARIANCE, overlap=0.9), "poor_fit: few"),
        (lambda: PoseEstimate(Status.NO_INITIAL_POSE, "nothing"), "no_initial_pose: nothing"),
        (lambda: PoseEstimate(Status.CONVERGED, "", moved(0.1), 0 * COVARIANCE, overlap=0.9), "not_publishable: "),
        (lambda: PoseEstimate(Status.CONVERGED, "", moved(float("nan")), COVARIANCE, overlap=1), "not_publishable: "),
    ],
)
def test_what_is_not_fit_to_use_is_not_published(domain, estimates, estimate, status):
    with inside(domain) as node:
        node.answer()
        node.peer.spin(0.3)
        before, used = len(node.found), node.node._counts.used
        estimates.next = estimate
        node.send()
        assert node.says("estimates", status) == 1
        assert len(node.found) == before and node.node._counts.used == used
        assert node.node._counts.rejected.total() == 1


def test_a_loop_that_stalls_ends_the_process_and_says_where():
    """The call that takes a message may never return; nothing of Python runs then."""
    code = """if True:
        import time
        from garps_ros import pose_node
        class Executor:
            def spin_once(self, timeout_sec):
                stalled_in_here()
        class Node:
            start_error = ""
        def stalled_in_here():
            time.sleep(60)
        pose_node.STALL_S = 0.5
        pose_node._run(Executor(), None, Node(), [])
    """
    done = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, timeout=30)
    assert done.returncode == 1
    assert "Timeout" in done.stderr and "stalled_in_here" in done.stderr
