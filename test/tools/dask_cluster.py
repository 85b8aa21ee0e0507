# SPDX-License-Identifier: Apache-2.0
"""A real Dask cluster on this machine: a scheduler and two workers, each a process of its own, and work for them."""

import json
import os
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from places import ROOT

ENVIRONMENT = os.environ | {"PYTHONPATH": os.pathsep.join([str(ROOT), str(ROOT / "test" / "tools")])}
"""In it, other processes can import this file and the packages."""


def slow_square(number: int, notes: Path) -> tuple[int, int]:
    """The square and the process that made it, which also leaves a note of it."""
    (notes / f"{number}.{os.getpid()}").touch()
    time.sleep(0.3)
    return number * number, os.getpid()


@contextmanager
def running_cluster(tmp_path: Path) -> Iterator[tuple[str, list[subprocess.Popen]]]:
    """The scheduler's address, and the workers."""
    words = [sys.executable, "-m", "distributed.cli.dask_scheduler", "--host", "127.0.0.1", "--port", "0"]
    words += ["--no-dashboard", "--scheduler-file", str(tmp_path / "scheduler.json")]
    log = (tmp_path / "log.txt").open("w")
    started = [subprocess.Popen(words, env=ENVIRONMENT, stdout=log, stderr=log, cwd=tmp_path)]
    try:
        address = wait_for_address(tmp_path / "scheduler.json")
        for name in ("one", "two"):
            worker = [sys.executable, "-m", "distributed.cli.dask_worker", address, "--nthreads", "1", "--no-nanny"]
            worker += ["--name", name, "--no-dashboard", "--host", "127.0.0.1"]
            started.append(subprocess.Popen(worker, env=ENVIRONMENT, stdout=log, stderr=log, cwd=tmp_path))
        wait_for_workers(address, 2)
        yield address, started[1:]
    finally:
        for process in reversed(started):
            process.kill()
            process.wait()
        log.close()


def wait_for_address(path: Path) -> str:
    end = time.monotonic() + 60
    while time.monotonic() < end:
        if path.is_file() and path.stat().st_size:
            try:
                return json.loads(path.read_text())["address"]
            except ValueError:
                pass
        time.sleep(0.1)
    raise AssertionError("no scheduler after a minute")


def wait_for_workers(address: str, count: int) -> None:
    from distributed import Client

    with Client(address, set_as_default=False) as client:
        client.wait_for_workers(count, timeout=60)
