# SPDX-License-Identifier: Apache-2.0
"""Settings for the whole suite; they must stand before anything imports a message class."""

import contextlib
import ctypes
import gc
import os
import socket
import sys
from pathlib import Path

import pytest
from hypothesis import settings

# Without this, Jazzy accepts a scalar of the wrong type and publishes garbage for it.
os.environ["ROS_PYTHON_CHECK_FIELDS"] = "1"

# For the whole process: Fast DDS reads it at the first context and never again. Without it, images that two cameras
# send at once do not fit into a process' 512 KiB of shared memory, and on a busy machine never arrive.
os.environ["FASTRTPS_DEFAULT_PROFILES_FILE"] = str(Path(__file__).resolve().parent / "fast_discovery.xml")

# No deadline: a shared machine may stall for longer than any example takes. The same examples every time, so that a
# change is judged by what it changes; GARPS_TEST_PROFILE=explore looks for new ones.
settings.register_profile("garps", deadline=None, derandomize=True)
settings.register_profile("explore", deadline=None, max_examples=1000)
settings.load_profile(os.environ.get("GARPS_TEST_PROFILE", "garps"))


@pytest.fixture(scope="session", autouse=True)
def no_network():
    """Python's sockets reach this machine only: going further fails a test. DDS has its own sockets, in C."""
    allowed = {"localhost", "127.0.0.1", "::1"}
    real = {name: getattr(socket.socket, name) for name in ("connect", "connect_ex")}

    def guarded(name):
        def connect(self, address):
            if self.family in (socket.AF_INET, socket.AF_INET6) and address[0] not in allowed:
                raise PermissionError(f"a test went to {address[0]} by network: expected this machine only")
            return real[name](self, address)

        return connect

    with pytest.MonkeyPatch.context() as patch:
        for name in real:
            patch.setattr(socket.socket, name, guarded(name))
        yield


@pytest.fixture(scope="module", autouse=True)
def memory_given_back():
    """After each file its networks are dropped and freed memory returns to the system.

    Otherwise the C library keeps it, and a worker grows to the sum of the peaks of its files.
    """
    yield
    if align := sys.modules.get("garps_core.align"):
        align.NETWORKS._kept.clear()
    gc.collect()
    with contextlib.suppress(AttributeError, OSError):  # glibc has it, other C libraries do not
        ctypes.CDLL(None).malloc_trim(0)


@pytest.fixture(scope="module")
def one_thread():
    """Torch with one thread, as in the node: several wait for each other on a busy machine, and sum in other orders."""
    import torch

    before = torch.get_num_threads()
    torch.set_num_threads(1)
    torch.exp(torch.zeros(1))  # the first large one of a process may be wrong
    yield
    torch.set_num_threads(before)


@pytest.fixture(scope="module")
def domain(tmp_path_factory):
    """A ROS domain that nobody else on this machine uses, for the tests of one file."""
    from graph import private_domain

    with private_domain(tmp_path_factory.mktemp("ros")) as held:
        yield held
