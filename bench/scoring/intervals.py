# SPDX-License-Identifier: Apache-2.0
"""Confidence intervals of differences between two methods on the same pairs: the paired bootstrap."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

DRAWS = 10_000
Statistic = Callable[..., npt.NDArray[Any]]


class Difference(NamedTuple):
    """A statistic of one method minus that of another, and the interval that most resamplings fall into."""

    value: float
    low: float
    high: float

    @property
    def lower(self) -> bool:
        """Whether the first is surely lower."""
        return self.high < 0

    @property
    def not_higher(self) -> bool:
        """Whether the first is not surely higher."""
        return self.low <= 0

    def __str__(self) -> str:
        return f"{self.value:+.4f} [{self.low:+.4f}, {self.high:+.4f}]"


def paired_difference(
    ours: npt.ArrayLike,
    theirs: npt.ArrayLike,
    statistic: Statistic = np.mean,
    level: float = 0.95,
    draws: int = DRAWS,
    seed: int = 0,
) -> Difference:
    """`statistic(ours) - statistic(theirs)` and its percentile interval over resampled pairs.

    Args:
        ours, theirs: n values each, of the same pairs in the same order; all finite.
        statistic: of an array along `axis`, as `np.mean` and `np.median`.
        level: share of the resamplings within the interval, 0..1.
        draws: resamplings.
        seed: of them.
    Raises:
        ValueError: lengths that differ, no values, or values that are not finite.
    """
    a, b = np.asarray(ours, float), np.asarray(theirs, float)
    if a.shape != b.shape or a.ndim != 1 or not len(a) or not np.isfinite([a, b]).all():
        raise ValueError(f"{a.shape} and {b.shape} values: expected as many finite ones of either, in the same order")
    chosen = np.random.default_rng(seed).integers(len(a), size=(draws, len(a)))
    found = statistic(a[chosen], axis=1) - statistic(b[chosen], axis=1)
    low, high = np.quantile(found, [(1 - level) / 2, (1 + level) / 2])
    return Difference(float(statistic(a, axis=0) - statistic(b, axis=0)), float(low), float(high))


def relative_change(
    ours: npt.ArrayLike, theirs: npt.ArrayLike, level: float = 0.95, draws: int = DRAWS, seed: int = 0
) -> Difference:
    """Mean of `ours` over that of `theirs`, less 1, with its interval over resampled pairs; as `paired_difference`."""
    a, b = np.asarray(ours, float), np.asarray(theirs, float)
    paired_difference(a, b, draws=1)  # raises what it raises
    chosen = np.random.default_rng(seed).integers(len(a), size=(draws, len(a)))
    low, high = np.quantile(a[chosen].mean(axis=1) / b[chosen].mean(axis=1) - 1, [(1 - level) / 2, (1 + level) / 2])
    return Difference(float(a.mean() / b.mean() - 1), float(low), float(high))
