# SPDX-License-Identifier: Apache-2.0
"""Independent jobs on local processes, or on a Dask cluster that runs already; results in the order of the jobs.

A cluster: `dask scheduler`, then `dask worker ADDRESS --nthreads 1` on as many machines as there are, each with this
package's environment and started in its folder; here `--scheduler ADDRESS`. A worker that dies loses nothing:
its job goes to another.
"""

from __future__ import annotations

import multiprocessing
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from typing import TypeVar

import cv2
import torch

Given = TypeVar("Given")
Made = TypeVar("Made")
IN_FLIGHT = 4
"""Jobs that a cluster holds per thread: enough to keep it busy, few enough to fit its memory."""


def one_thread_each() -> None:
    """Processes share the cores; times compare only if none takes more than one."""
    torch.set_num_threads(1)
    cv2.setNumThreads(1)


def computed(
    function: Callable[[Given], Made], given: Sequence[Given], workers: int = 1, scheduler: str = ""
) -> Iterator[Made]:
    """`function` of each, in their order, as soon as those before are there.

    Args:
        function: a module's own function, or a `functools.partial` of one: other processes import it.
        given: what it is called with.
        workers: local processes; 1 = this one.
        scheduler: address of a Dask scheduler; then `workers` does not count.
    Raises:
        ValueError: there is no scheduler at that address, or it has no workers. And what the function raises.
    """
    if scheduler:
        yield from _on_cluster(function, given, scheduler)
    elif workers == 1:
        yield from map(function, given)
    else:
        # A fork of a process whose libraries have started threads may wait for them for ever.
        context = multiprocessing.get_context("spawn")
        with ProcessPoolExecutor(workers, context, one_thread_each) as pool:
            yield from pool.map(function, given)


def _on_cluster(function: Callable[[Given], Made], given: Sequence[Given], scheduler: str) -> Iterator[Made]:
    from distributed import Client

    try:
        client = Client(scheduler, timeout="10s", set_as_default=False)
    except (OSError, ValueError, TimeoutError) as error:
        raise ValueError(f"no Dask scheduler at {scheduler} ({error}): start one with `dask scheduler`") from None
    with client:
        threads = sum(client.nthreads().values())
        if not threads:
            raise ValueError(f"the scheduler at {scheduler} has no workers: start some with `dask worker {scheduler}`")
        client.run(one_thread_each)
        waiting = []
        for i, one in enumerate(given):
            waiting.append(client.submit(function, one, pure=False, key=f"garps-{id(given)}-{i}"))
            if len(waiting) >= IN_FLIGHT * threads:
                yield waiting.pop(0).result()
        for future in waiting:
            yield future.result()
