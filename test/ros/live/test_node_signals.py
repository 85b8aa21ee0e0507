# SPDX-License-Identifier: Apache-2.0
"""SIGINT and SIGTERM end the node in good order, whatever it does at that moment: exit code 0, soon, no traceback."""

import random
import signal
import time
from contextlib import ExitStack
from pathlib import Path

import pytest
from graph import NodeProcess, Nursery, Peer, Rig, private_domain, room_pair

geometry_msgs = pytest.importorskip("geometry_msgs.msg")

ROUNDS = 20
SOON_S = 30.0
"""Time after which a node that does not end counts as hanging, s."""
NODES = {
    "idle_int": (signal.SIGINT, False),
    "idle_term": (signal.SIGTERM, False),
    "busy_int": (signal.SIGINT, True),
    "busy_term": (signal.SIGTERM, True),
}
CHEAP = ["-p", "lifting.stride:=4"]
COSTLY = "preset: paper\nlifting.stride: 1\npaper.component_stride: 1\n"
"""Settings of a computation of a thousand steps over all components: still under way when the second signal comes."""


class Stage:
    """A domain with two cameras at 10 Hz and a listener to the poses of every node, for all tests."""

    def __init__(self, domain, peer, nursery):
        self.domain, self.peer, self._nursery = domain, peer, nursery
        # Not reliable: Fast DDS 2.14 can loop for ever in a reliable reader that joins large messages midway.
        self.rig = Rig(peer, room_pair(), reliable=False)
        self.poses = {name: peer.collect(geometry_msgs.PoseStamped, f"/{name}/pose") for name in NODES}

    def node(self, name: str, folder: Path, *settings: str, born: bool = False) -> NodeProcess:
        """A node of that name, started anew or by the nursery; an idle one hears of no camera."""
        quiet = [] if NODES[name][1] else ["-r", "source/image:=/nothing", "-r", "target/image:=/nothing"]
        self.poses[name].clear()
        return NodeProcess(
            ["--ros-args", "-r", f"__node:={name}", *quiet, *settings],
            self.domain.environment,
            folder / f"{name}.log",
            nursery=self._nursery if born else None,
        )

    def stream(self, seconds: float) -> None:
        """Publish pairs at 10 Hz for some seconds."""
        end = time.monotonic() + seconds
        self.rig.publish_until(lambda: time.monotonic() > end, "the end")

    def ended(self, *nodes: NodeProcess, seconds: float = SOON_S) -> None:
        """Go on publishing until the nodes have ended, or as long as they may take."""
        end = time.monotonic() + seconds
        self.rig.publish_until(
            lambda: all(node.process.poll() is not None for node in nodes) or time.monotonic() > end, "the end"
        )
        for node in nodes:
            node.wait(0.01)


def costly(folder: Path) -> tuple[str, str]:
    """Arguments of a node with these settings."""
    file = folder / "costly.yaml"
    file.write_text(COSTLY, encoding="utf-8")
    return "-p", f"settings_file:={file}"


@pytest.fixture(scope="module")
def stage(tmp_path_factory):
    with (
        private_domain(tmp_path_factory.mktemp("ros")) as domain,
        Nursery(domain.environment) as nursery,
        Peer(domain) as peer,
    ):
        yield Stage(domain, peer, nursery)


@pytest.mark.parametrize("turn", range(ROUNDS))
def test_a_signal_ends_nodes_that_idle_and_nodes_that_compute(stage, tmp_path, turn):
    """Four nodes at once: that is also how a machine under load looks."""
    with ExitStack() as running:
        nodes = {name: running.enter_context(stage.node(name, tmp_path, *CHEAP, born=True)) for name in NODES}
        stage.rig.publish_until(
            lambda: stage.poses["busy_int"] and stage.poses["busy_term"], "a pose of both busy nodes"
        )
        stage.peer.wait(lambda: all("ready" in node.log() for node in nodes.values()), what="all nodes to be ready")
        assert not stage.poses["idle_int"] and not stage.poses["idle_term"]
        stage.stream(random.Random(turn).uniform(0.0, 0.8))
        for name, node in nodes.items():
            node.signal(NODES[name][0])
        stage.ended(*nodes.values())


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_computation_that_takes_longer_is_not_waited_for(stage, tmp_path, number):
    with stage.node("busy_int", tmp_path, *costly(tmp_path)) as node:
        computing(stage, node)
        node.signal(number)
        stage.ended(node)


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_second_signal_ends_it_at_once(stage, tmp_path, number):
    node = stage.node("busy_int", tmp_path, *costly(tmp_path))
    computing(stage, node)
    node.signal(number)
    stage.stream(0.5)
    assert node.process.poll() is None, "it ended before the second signal: nothing is tested here"
    node.signal(number)
    assert node.wait() == 128 + number
    assert "Traceback" not in node.log()


@pytest.mark.parametrize("delay_s", [0.0, 0.3, 0.8, 1.5])
def test_a_signal_while_it_starts(stage, tmp_path, delay_s):
    with stage.node("idle_int", tmp_path) as one, stage.node("idle_term", tmp_path) as two:
        for node in (one, two):
            stage.peer.wait(lambda node=node: catches(node, signal.SIGTERM), what="the handlers of the node")
        stage.peer.spin(delay_s)
        one.signal(signal.SIGINT)
        two.signal(signal.SIGTERM)
        for node in (one, two):
            assert node.wait() == 0, node.log()


def computing(stage: Stage, node: NodeProcess) -> None:
    """Publish until the node says that it is in the middle of an estimate."""

    def busy() -> bool:
        _, _, values = stage.peer.diagnostics().get("busy_int: machine", (0, "", {}))
        return values.get("stage") == "estimate"

    stage.peer.diagnostics().clear()
    stage.rig.publish_until(busy, "an estimate to be under way")


def catches(node: NodeProcess, number: int) -> bool:
    """True once the process has a handler of its own for the signal."""
    status = Path(f"/proc/{node.process.pid}/status").read_text(encoding="ascii")
    (mask,) = [line.split()[1] for line in status.splitlines() if line.startswith("SigCgt")]
    return bool(int(mask, 16) >> (number - 1) & 1)
