# SPDX-License-Identifier: Apache-2.0
"""The node as a process, started anew or forked; killed and shown when it hangs. See `graph` for its surroundings."""

import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any

import pytest
from places import ROOT

PATIENCE_S = 120.0
"""Time after which something that must happen counts as hanging, s; a busy machine takes long."""


class NodeProcess:
    """A node in a process and session of its own, its output in a file.

    As a context it ends the node with SIGINT and expects exit code 0 and no traceback.

    Args:
        arguments: of the node.
        environment: of the process, see `Domain`.
        log: file for its output.
        module: what to run.
        nursery: start it from there; `environment` and `module` are the nursery's then.
    """

    def __init__(
        self,
        arguments: Sequence[str],
        environment: dict[str, str],
        log: Path,
        module: str = "garps_ros.pose_node",
        nursery: "Nursery | None" = None,
    ) -> None:
        self._log = log
        if nursery is not None:
            self.process: subprocess.Popen[bytes] | Born = nursery.start(arguments, log)
            return
        with log.open("wb") as output:
            command = [sys.executable, "-m", module, *arguments]
            self.process = subprocess.Popen(
                command, cwd=ROOT, env=environment, stdout=output, stderr=subprocess.STDOUT, start_new_session=True
            )

    def __enter__(self) -> "NodeProcess":
        return self

    def __exit__(self, kind: type | None, error: BaseException | None, _: Any) -> None:
        if error is not None:
            self._kill()
            error.add_note(self._tail())
            return
        if self.process.poll() is None:
            self.signal(signal.SIGINT)
        code = self.wait()
        assert code == 0, f"exit code {code}\n{self._tail()}"
        assert "Traceback" not in self.log(), self._tail()

    def signal(self, number: int) -> None:
        """Send a signal to the node alone, as a launch file does."""
        self.process.send_signal(number)

    def wait(self, seconds: float = PATIENCE_S) -> int:
        """Return the exit code; a node that hangs is made to say where, killed, and the test fails."""
        try:
            return self.process.wait(seconds)
        except subprocess.TimeoutExpired:
            self._kill()
        pytest.fail(f"node still runs {seconds:g} s after it was told to end\n{self._tail(100)}")

    def log(self) -> str:
        """Return everything that the node has written so far."""
        return self._log.read_text(encoding="utf-8", errors="replace")

    def wait_for(self, text: str) -> None:
        """Wait until the node has written a text; the test fails when that takes too long."""
        end = time.monotonic() + PATIENCE_S
        while text not in self.log():
            if time.monotonic() > end:
                pytest.fail(f"waited {PATIENCE_S:g} s for {text!r}\n{self._tail()}")
            time.sleep(0.05)

    def _kill(self) -> None:
        if self.process.poll() is None:
            self.signal(signal.SIGABRT)  # faulthandler writes where every thread is
            time.sleep(0.3)
        with suppress(ProcessLookupError):
            os.killpg(self.process.pid, signal.SIGKILL)
        self.process.wait()

    def _tail(self, lines: int = 40) -> str:
        return "\n".join([f"--- end of {self._log.name}:", *self.log().splitlines()[-lines:]])


NURSERY = """
import json, os, sys
import garps_ros.live.node  # torch and ROS; neither has begun a thread yet
from garps_ros.pose_node import main
for line in sys.stdin:
    order = json.loads(line)
    if "pid" in order:
        pid, status = os.waitpid(order["pid"], os.WNOHANG)
        print(json.dumps(os.waitstatus_to_exitcode(status) if pid else None), flush=True)
        continue
    child = os.fork()
    if child == 0:
        os.setsid()
        for stream in (1, 2):
            os.dup2(os.open(order["log"], os.O_WRONLY | os.O_CREAT | os.O_APPEND), stream)
        sys.exit(main(order["arguments"]))
    print(child, flush=True)
"""


class Nursery:
    """A process that has imported everything once and forks a node in 10 ms, for tests that need very many.

    A node runs main() and ends by the interpreter's own end, as if started anew; only its imports are inherited.
    """

    def __init__(self, environment: dict[str, str]) -> None:
        self._process = subprocess.Popen(
            [sys.executable, "-c", NURSERY],
            cwd=ROOT, env=environment, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True,
        )  # fmt: skip

    def __enter__(self) -> "Nursery":
        return self

    def __exit__(self, *_: object) -> None:
        self._process.communicate(timeout=PATIENCE_S)

    def start(self, arguments: Sequence[str], log: Path) -> "Born":
        log.touch()
        return Born(int(self.ask({"arguments": list(arguments), "log": str(log)})), self)

    def ask(self, order: dict[str, Any]) -> Any:
        assert self._process.stdin is not None and self._process.stdout is not None
        self._process.stdin.write(json.dumps(order) + "\n")
        self._process.stdin.flush()
        return json.loads(self._process.stdout.readline())


class Born:
    """The part of Popen that tests use, for a process of a nursery."""

    def __init__(self, pid: int, nursery: Nursery) -> None:
        self.pid, self._nursery = pid, nursery
        self.returncode: int | None = None

    def poll(self) -> int | None:
        if self.returncode is None:
            self.returncode = self._nursery.ask({"pid": self.pid})
        return self.returncode

    def wait(self, timeout: float = PATIENCE_S) -> int:
        end = time.monotonic() + timeout
        while (code := self.poll()) is None:
            if time.monotonic() > end:
                raise subprocess.TimeoutExpired(str(self.pid), timeout)
            time.sleep(0.01)
        return code

    def send_signal(self, number: int) -> None:
        if self.poll() is None:
            os.kill(self.pid, number)
