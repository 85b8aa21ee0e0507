# SPDX-License-Identifier: Apache-2.0
"""The worker computes the newest job, loses nothing but what a newer one replaced, and survives its own death."""

import threading
import time
from contextlib import contextmanager

import pytest
from counted_time import CountedTime

from garps_ros.live import worker as module
from garps_ros.live.worker import Worker

LIMIT_S = 20


def eventually(condition):
    """Wait for something that must happen; False when it does not."""
    limit = time.monotonic() + LIMIT_S
    while not condition() and time.monotonic() < limit:
        time.sleep(0.002)
    return condition()


class Gate:
    """A computation that lasts until it is let through; `begun` holds the jobs in order."""

    def __init__(self):
        self.begun, self._let = [], threading.Semaphore(0)

    def __call__(self, job):
        self.begun.append(job)
        assert self._let.acquire(timeout=LIMIT_S)
        return f"{job} done"

    def open(self, times=1):
        self._let.release(times)


@contextmanager
def working(compute, finished=lambda: None):
    before = set(threading.enumerate())
    worker = Worker(compute, finished)
    try:
        yield worker
    finally:
        assert worker.stop(LIMIT_S)
        assert set(threading.enumerate()) <= before, "a thread is left behind"


@contextmanager
def gated():
    gate = Gate()
    with working(gate) as worker:
        try:
            yield worker, gate
        finally:
            gate.open(1000)


def test_a_job_is_computed_in_the_workers_thread_and_told():
    threads, told = [], []

    def compute(job):
        threads.append(threading.current_thread())
        return job * 2

    with working(compute, lambda: told.append(threading.current_thread())) as worker:
        assert worker.offer(21) is False
        assert eventually(lambda: told)
        assert worker.take() == [42] and worker.take() == []
        assert threads == told and threads[0] is not threading.current_thread()
        assert threads[0].name == "garps-worker" and threads[0].daemon


def test_the_result_is_there_when_it_is_told():
    taken = []
    with working(lambda job: job, lambda: taken.append(worker.take())) as worker:
        for job in range(1, 6):
            worker.offer(job)
            assert eventually(lambda: len(taken) == job)  # noqa: B023
    assert taken == [[1], [2], [3], [4], [5]]


def test_the_newest_wins_and_what_it_replaced_is_told():
    with gated() as (worker, gate):
        assert worker.offer("a") is False
        assert eventually(lambda: gate.begun == ["a"])
        assert worker.offer("b") is False, "a has begun: nothing is replaced"
        assert worker.offer("c") is True
        assert worker.offer("d") is True
        gate.open(2)
        assert eventually(lambda: len(worker._results) == 2)
        assert gate.begun == ["a", "d"] and worker.take() == ["a done", "d done"]
        assert worker.offer("e") is False


def test_results_come_oldest_first():
    with working(lambda job: job) as worker:
        for job in range(1, 8):
            worker.offer(job)
            assert eventually(lambda: len(worker._results) == job)  # noqa: B023
        assert worker.take() == [1, 2, 3, 4, 5, 6, 7]


def test_a_withdrawn_job_is_not_computed():
    with gated() as (worker, gate):
        assert worker.withdraw() is False
        worker.offer("a")
        assert eventually(lambda: gate.begun == ["a"])
        assert worker.withdraw() is False, "what has begun cannot be taken back"
        worker.offer("b")
        assert worker.withdraw() is True and worker.withdraw() is False
        gate.open()
        assert eventually(lambda: worker._results)
        worker.offer("c")
        assert eventually(lambda: len(gate.begun) == 2)
        assert gate.begun == ["a", "c"]


@pytest.fixture
def clock(monkeypatch):
    """The worker's clock, which only the test advances."""
    clock = CountedTime()
    monkeypatch.setattr(module, "time", clock)
    return clock


def test_jobs_begin_a_period_apart_and_the_newest_of_it_is_taken(clock):
    begun = []
    with working(begun.append) as worker:
        worker.min_period_s = 10.0
        worker.offer(0)
        assert eventually(lambda: begun == [0])
        assert [worker.offer(job) for job in (1, 2, 3)] == [False, True, True]
        clock.now_s += 9.0
        assert worker.offer(4) is True, "the period is not over: the job before still waits"
        clock.now_s += 1.0
        assert worker.offer(5) is True
        assert eventually(lambda: len(begun) == 2)
    assert begun == [0, 5]


def test_a_period_counts_from_the_start_of_a_job(clock):
    with gated() as (worker, gate):
        worker.min_period_s = 10.0
        worker.offer("a")
        assert eventually(lambda: gate.begun == ["a"])
        clock.now_s += 9.0
        gate.open()
        assert eventually(lambda: worker._results)
        clock.now_s += 1.0
        worker.offer("b")
        assert eventually(lambda: gate.begun == ["a", "b"])


def test_a_shorter_period_takes_effect_with_the_next_offer():
    with working(lambda job: job) as worker:
        worker.min_period_s = 1000.0
        worker.offer(1)
        assert eventually(lambda: worker._results)
        worker.offer(2)
        time.sleep(0.05)
        assert len(worker._results) == 1
        worker.min_period_s = 0.0
        worker.offer(3)
        assert eventually(lambda: len(worker._results) == 2) and worker.take() == [1, 3]


def test_stop_while_idle_ends_the_thread():
    worker = Worker(lambda job: job, lambda: None)
    assert worker.stop(LIMIT_S) is True
    assert worker.stop(0) is True and worker.death == ""


def test_stop_does_not_wait_for_the_period():
    with working(lambda job: job) as worker:
        worker.min_period_s = 1000.0
        worker.offer(1)
        assert eventually(lambda: worker._results)
        worker.offer(2)
        assert worker.stop(LIMIT_S) is True
        assert worker.take() == [1]


def test_stop_while_busy_ends_the_job_at_hand_and_begins_no_other():
    with gated() as (worker, gate):
        worker.offer("a")
        assert eventually(lambda: gate.begun == ["a"])
        worker.offer("b")
        assert worker.stop(0.05) is False, "it still runs"
        gate.open(2)
        assert worker.stop(LIMIT_S) is True
        assert worker.take() == ["a done"] and gate.begun == ["a"]
        worker.offer("c")
        time.sleep(0.02)
        assert gate.begun == ["a"]


@pytest.mark.parametrize("error", [SystemExit(3), MemoryError("no room"), KeyboardInterrupt(), ValueError("what")])
def test_death_is_noted_and_told_and_a_new_thread_goes_on(error):
    told = []

    def compute(job):
        if job == "die":
            raise error
        return job

    with working(compute, lambda: told.append(worker.death)) as worker:
        worker.offer("die")
        assert eventually(lambda: told)
        assert told == [f"{type(error).__name__}: {error}"] == [worker.death]
        assert eventually(lambda: not worker._thread.is_alive())
        assert worker.take() == []
        worker.offer("waits")
        assert worker.offer("newest waits") is True
        worker.restart()
        assert worker.death == ""
        assert eventually(lambda: worker._results) and worker.take() == ["newest waits"]
        assert worker.busy_s == 0


def test_a_dead_worker_can_be_restarted_and_stopped():
    with working(lambda job: 1 / job) as worker:
        worker.offer(0)
        assert eventually(lambda: worker.death)
        worker.restart()
        assert worker.busy_s == 0, "what died is over"
        worker.offer(0)
        assert eventually(lambda: worker.death)
        assert worker.stop(LIMIT_S) is True


def test_busy_time_is_that_of_the_present_job(clock):
    with gated() as (worker, gate):
        assert worker.busy_s == 0
        for job in ("a", "b"):
            worker.offer(job)
            assert eventually(lambda: gate.begun[-1:] == [job])  # noqa: B023
            assert worker.busy_s == 0
            clock.now_s += 0.5
            assert worker.busy_s == 0.5
            gate.open()
            assert eventually(lambda: worker.busy_s == 0)


def test_many_offers_from_several_threads_lose_nothing_but_replaced_jobs():
    told, computed = [], []

    def compute(job):
        computed.append(job)
        if job[1] % 7 == 0:
            time.sleep(0.0005)
        return job

    with working(compute, lambda: told.append(1)) as worker:
        replaced, taken = [0] * 4, []
        done = threading.Event()

        def offer(giver):
            for number in range(2000):
                replaced[giver] += worker.offer((giver, number))
                if number % 20 == 0:
                    time.sleep(0.001)

        def take():
            while not done.is_set():
                taken.extend(worker.take())

        givers = [threading.Thread(target=offer, args=(giver,)) for giver in range(4)]
        taker = threading.Thread(target=take)
        for thread in (*givers, taker):
            thread.start()
        for giver in givers:
            giver.join()
        whole = eventually(lambda: len(told) + sum(replaced) == 8000)
        done.set()
        taker.join()
        taken += worker.take()
    assert whole and taken == computed and len(set(taken)) == len(taken) == len(told)
    assert 50 < len(taken) < 8000
    for giver in range(4):
        numbers = [number for who, number in taken if who == giver]
        assert numbers == sorted(numbers)
