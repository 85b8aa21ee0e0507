# SPDX-License-Identifier: Apache-2.0
"""Jobs give the same results in the same order here, in other processes and on a cluster, one of whose workers dies."""

import os
import signal
from functools import partial
from pathlib import Path

import pytest
from dask_cluster import ENVIRONMENT, running_cluster, slow_square

from bench.machine.jobs import computed


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


def test_a_worker_that_is_killed_loses_nothing(tmp_path: Path) -> None:
    pytest.importorskip("distributed")
    notes = tmp_path / "notes"
    notes.mkdir()
    with running_cluster(tmp_path) as (address, workers):
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
