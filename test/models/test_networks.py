# SPDX-License-Identifier: Apache-2.0
"""`Networks`: loaded once for all threads, kept by kind, empty when copied, usable after a fork."""

import os
import pickle
import threading
from typing import Any

import pytest

from garps_core import Config
from garps_core.models import in_use
from garps_core.models.depth_networks import load_network
from garps_core.models.in_use import Networks

DEMO = Config.preset("demo_net")


@pytest.fixture
def loads(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """One entry, the name, for every time that a depth network is loaded, which takes a while."""
    found: list[str] = []

    def slowly(name: str, *given: str) -> Any:
        found.append(name)
        threading.Event().wait(0.05)
        return load_network(name, *given)

    monkeypatch.setattr(in_use, "load_network", slowly)
    return found


def test_threads_that_want_a_network_at_once_load_it_once(loads: list[str]) -> None:
    networks, gate, found = Networks(), threading.Barrier(4), []

    def want() -> None:
        gate.wait()
        found.append(networks.depth_network(DEMO))

    threads = [threading.Thread(target=want) for _ in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert len(loads) == 1 and len(found) == 4 and len(set(map(id, found))) == 1


def test_every_owner_has_its_own(loads: list[str]) -> None:
    one, other = Networks(), Networks()
    assert one.depth_network(DEMO) is one.depth_network(DEMO) is not other.depth_network(DEMO)
    assert len(loads) == 2


def test_a_copy_is_empty(loads: list[str]) -> None:
    networks = Networks()
    first = networks.depth_network(DEMO)
    copy = pickle.loads(pickle.dumps(networks))
    assert len(pickle.dumps(networks)) < 1000
    assert copy.depth_network(DEMO) is not first and len(loads) == 2


def test_of_every_kind_the_last_is_kept() -> None:
    """Another folder, file or scene is another network."""
    networks, loads = Networks(), []
    for name in ("a", "a", "b", "a"):
        networks._once("depth", (name,), lambda name=name: loads.append(name))
        networks._once("labels", (), lambda: loads.append("labels"))
    assert loads == ["a", "labels", "b", "a"]


def test_what_could_not_be_loaded_is_tried_again() -> None:
    networks = Networks()

    def fail() -> None:
        raise OSError("no such file")

    for _ in range(2):
        with pytest.raises(OSError, match="no such file"):
            networks._once("depth", (), fail)
    assert networks._once("depth", (), lambda: 1) == 1


@pytest.mark.skipif(not hasattr(os, "fork"), reason="no fork on this system")
def test_a_child_forked_while_a_thread_loads_does_not_hang(loads: list[str]) -> None:
    networks, loading, forked = Networks(), threading.Event(), threading.Event()

    def load() -> int:
        loading.set()
        assert forked.wait(60)
        return 1

    thread = threading.Thread(target=networks._once, args=("depth", (), load))
    thread.start()
    assert loading.wait(60)
    child = os.fork()
    if child == 0:
        answer = threading.Thread(target=lambda: os._exit(0 if networks._once("labels", (), lambda: 7) == 7 else 1))
        answer.daemon = True
        answer.start()
        answer.join(30)
        os._exit(2)
    forked.set()
    thread.join()
    assert os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) == 0
