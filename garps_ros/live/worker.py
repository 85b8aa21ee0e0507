# SPDX-License-Identifier: Apache-2.0
"""One worker thread, fed through a slot that holds only the newest job, so that callers never wait for it."""

from __future__ import annotations

import math
import threading
import time
from collections import deque
from collections.abc import Callable
from typing import Generic, TypeVar

Job = TypeVar("Job")
Result = TypeVar("Result")


class Worker(Generic[Job, Result]):
    """Computes jobs in its own thread, the newest first; older ones that still wait are dropped.

    Args:
        compute: from a job to its result; runs in the thread. Expected failures are results, not exceptions: one
            that escapes ends the thread and is described by `death`; `restart` begins a new one.
        finished: called in the thread when a result is ready to be taken, or when prepared; must not raise.
        prepare: called in the thread before the first job, once, whatever comes of it.
    """

    def __init__(
        self, compute: Callable[[Job], Result], finished: Callable[[], None], prepare: Callable[[], None] | None = None
    ) -> None:
        self._compute, self._finished, self._prepare = compute, finished, prepare
        self._changed = threading.Condition()
        self._waiting: Job | None = None
        self._stopped = False
        self._busy_since: float | None = None
        self._results: deque[Result] = deque()
        self.min_period_s = 0.0
        """Shortest time between the starts of two jobs, s; a change counts from the next offer on."""
        self.death = ""
        """Reason why the thread ended although nobody stopped it; "" while it lives."""
        self.error: BaseException | None = None
        """The exception that ended the thread."""
        self.prepared = prepare is None
        """The thread takes jobs."""
        self._begin()

    def offer(self, job: Job) -> bool:
        """Leave a job for the thread; True when it took the place of one that had not begun."""
        with self._changed:
            replaced, self._waiting = self._waiting is not None, job
            self._changed.notify_all()
        return replaced

    def withdraw(self) -> bool:
        """Take back the job that has not begun; True when there was one."""
        with self._changed:
            waited, self._waiting = self._waiting is not None, None
        return waited

    def take(self) -> list[Result]:
        """Return the results since the last call, oldest first."""
        results = []
        while self._results:
            results.append(self._results.popleft())
        return results

    @property
    def busy_s(self) -> float:
        """Time that the present job has been running, s; 0 when idle."""
        since = self._busy_since
        return 0.0 if since is None else time.monotonic() - since

    def restart(self) -> None:
        """Start a new thread after `death`."""
        self.death, self.error, self._busy_since = "", None, None
        self._begin()

    def stop(self, timeout_s: float) -> bool:
        """Ask the thread to end after the job at hand and wait for it; False when it still runs after the timeout."""
        with self._changed:
            self._stopped, self._waiting = True, None
            self._changed.notify_all()
        self._thread.join(timeout_s)
        return not self._thread.is_alive()

    def _begin(self) -> None:
        # A daemon: a computation that hangs must not keep the process from ending.
        self._thread = threading.Thread(target=self._run, name="garps-worker", daemon=True)
        self._thread.start()

    def _run(self) -> None:
        begun_s = -math.inf
        try:
            self._get_ready()
            while (job := self._next(begun_s)) is not None:
                self._busy_since = begun_s = time.monotonic()
                self._results.append(self._compute(job))
                self._busy_since = None
                self._tell()
        except BaseException as error:  # also SystemExit: whoever watches must know
            self.error, self.death = error, f"{type(error).__name__}: {error}"
            self._tell()

    def _get_ready(self) -> None:
        prepare, self._prepare = self._prepare, None
        if prepare is not None:
            prepare()
        if not self.prepared:
            self.prepared = True
            self._tell()

    def _tell(self) -> None:
        if not self._stopped:  # whoever has stopped it may already be gone
            self._finished()

    def _next(self, begun_s: float) -> Job | None:
        """Wait for a job; return the newest, `min_period_s` after the last has begun, or None when stopped."""
        with self._changed:
            while not self._stopped:
                due_in = begun_s + self.min_period_s - time.monotonic()
                if self._waiting is not None and due_in <= 0:
                    job, self._waiting = self._waiting, None
                    return job
                self._changed.wait(due_in if self._waiting is not None else None)
        return None
