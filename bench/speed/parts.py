# SPDX-License-Identifier: Apache-2.0
"""Inputs, interleaved timing and thread counts, shared by the sections of `bench.speed`."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import numpy as np
import torch
from rich.console import Console
from rich.progress import track

from bench.pairs.pair import Pair
from bench.pairs.starts import disturbed_prior
from garps_core import Config, Mixture, Prior, reconstruct


@dataclass(frozen=True, eq=False)
class Inputs:
    """Inputs of every section: settings, image pairs (the first is used where one will do), timed runs."""

    preset: str
    pairs: tuple[Pair, ...]
    runs: int
    console: Console = field(default_factory=lambda: Console(quiet=True))

    @cached_property
    def config(self) -> Config:
        """The settings of the preset."""
        return Config.preset(self.preset)

    @cached_property
    def prior(self) -> Prior:
        """The first pair's disturbed truth."""
        return disturbed_prior(self.pairs[0])

    @cached_property
    def mixtures(self) -> tuple[Mixture, Mixture]:
        """The first pair, lifted."""
        return lifted(self.pairs[0], self.config)


def lifted(pair: Pair, config: Config) -> tuple[Mixture, Mixture]:
    """Both views of a pair as mixtures."""
    return reconstruct(pair.source, config), reconstruct(pair.target, config)


def interleaved(
    calls: Mapping[str, Callable[[], Any]], runs: int, what: str, console: Console
) -> dict[str, list[float]]:
    """Seconds of `runs` calls each, taking turns so that whatever else the machine does hits all alike.

    One round before it is not counted: compilation, thread pools, caches.
    """
    times: dict[str, list[float]] = {name: [] for name in calls}
    for run in track(range(runs + 1), what, console=console):
        for name, call in calls.items():
            began = time.perf_counter()
            call()
            if run > 0:
                times[name].append(time.perf_counter() - began)
    return times


def medians(times: Mapping[str, list[float]]) -> dict[str, float]:
    """Median seconds by name."""
    return {name: float(np.median(values)) for name, values in times.items()}


@contextmanager
def threads(count: int) -> Iterator[None]:
    """Torch, and numba where it is there, on `count` threads."""
    before = torch.get_num_threads()
    numba = imported_numba()
    numba_before = numba.get_num_threads() if numba else 0
    torch.set_num_threads(count)
    if numba:
        numba.set_num_threads(min(count, numba.config.NUMBA_NUM_THREADS))
    try:
        yield
    finally:
        torch.set_num_threads(before)
        if numba:
            numba.set_num_threads(numba_before)


def imported_numba() -> Any:
    """The numba package, or None where it cannot be imported."""
    try:
        import numba
    except ImportError:
        return None
    return numba
