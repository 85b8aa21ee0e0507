# SPDX-License-Identifier: Apache-2.0
"""Jobs give the same results in the same order here, in other processes and on a cluster, one of whose workers dies."""

import os
import signal
import subprocess
import sys
import time
from functools import partial
from pathlib import Path

import pytest

from bench.jobs import computed

ROOT = Path(__file__).resolve().parent.parent
ENVIRONMENT = os.environ | {"PYTHONPATH": os.pathsep.join([str(ROOT), str(ROOT / "test")])}


def slow_square(number: int, notes: Path) -> tuple[int, int]:
    """Also leaves a note of the process that did it."""
    (notes / f"{number}.{os.getpid()}").touch()
    time.sleep(0.3)
    return number * number, os.getpid()


def fails_at(number: int) -> int:
    if number == 2:
        raise RuntimeError("as it happens")
    return number


def test_the_order_is_that_of_the_jobs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("PYTHONPATH", ENVIRONMENT["PYTHONPATH"])
    work = partial(slow_square, notes=tmp_path)
    here, processes = (list(computed(work, range(5), workers)) for workers in (1, 2))
    assert [value for value, _ in here] == [value for value, _ in processes] == [0, 1, 4, 9, 16]
    assert {pid for _, pid in here} == {os.getpid()} and os.getpid() not in {pid for _, pid in processes}


def test_a_failure_comes_out() -> None:
    found = computed(fails_at, range(4))
    assert [next(found), next(found)] == [0, 1]
    with pytest.raises(RuntimeError, match="as it happens"):
        next(found)


@pytest.fixture
def cluster(tmp_path: Path):
    """A real scheduler and two workers, each a process: their address and the workers."""
    pytest.importorskip("distributed")
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
    import json

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


def test_a_worker_that_is_killed_loses_nothing(cluster, tmp_path: Path) -> None:
    address, workers = cluster
    notes = tmp_path / "notes"
    notes.mkdir()
    found = computed(partial(slow_square, notes=notes), range(12), scheduler=address)
    results = [next(found)]
    workers[0].send_signal(signal.SIGKILL)
    results += found
    assert [value for value, _ in results] == [n * n for n in range(12)]
    assert workers[0].wait() == -signal.SIGKILL
    done = {int(path.name.split(".")[0]) for path in notes.iterdir()}
    assert done == set(range(12)) and len({path.suffix for path in notes.iterdir()}) == 2


def test_no_scheduler_is_one_line() -> None:
    pytest.importorskip("distributed")
    with pytest.raises(ValueError, match="no Dask scheduler at"):
        list(computed(fails_at, [1], scheduler="tcp://127.0.0.1:9"))
