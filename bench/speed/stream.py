# SPDX-License-Identifier: Apache-2.0
"""One evaluation of the objective against a loop that only reads the same numbers and takes one exponential a pair."""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import partial

import numpy as np
from torch import Tensor

from bench.report.checks import Check, Row, Section
from bench.speed.parts import Inputs, imported_numba, interleaved, medians, threads
from garps_core import Config, Mixture
from garps_core.checks import Float64Array
from garps_core.config import Rung
from garps_core.objective.pairs import pair_up, thin, to_device
from garps_core.objective.shape import Pairs, evaluate

SIZES = ((8000, 12), (2000, 20))
BAR = 4.0
CALLS = 40
"""Interleaved calls of each; one takes milliseconds."""


def stream_section(inputs: Inputs, sizes: tuple[tuple[int, int], ...] = SIZES) -> Section:
    """Objective, gradient and Gauss-Newton information of one set of pairs, one thread, against the loop."""
    checks: list[Check] = []
    rows: list[Row] = []
    stream, how = reference()
    T = inputs.prior.T_target_source
    for n, k in sizes:
        pairs = exact_pairs(inputs.mixtures, T, n, k, inputs.config)
        planes = [plane.contiguous() for plane in _planes(pairs)]
        calls: dict[str, Callable[[], object]] = {
            "evaluate": partial(evaluate, pairs, T, "log"),
            "stream": partial(stream, planes),
        }
        with threads(1):
            median = medians(interleaved(calls, max(CALLS, inputs.runs), f"{n} x {k}", inputs.console))
        ratio = median["evaluate"] / median["stream"]
        checks.append(Check(f"evaluation / streaming its bytes, {n} rows x {k}", ratio, BAR))
        rows.append({"rows x partners": f"{n} x {k}", "evaluate ms": median["evaluate"] * 1e3})
        rows[-1] |= {"stream ms": median["stream"] * 1e3, "evaluate ns a pair": median["evaluate"] / (n * k) * 1e9}
        rows[-1]["stream ns a pair"] = median["stream"] / (n * k) * 1e9
    return Section("One evaluation against streaming its bytes, one thread", checks, rows, [f"stream: {how}"])


def exact_pairs(mixtures: tuple[Mixture, Mixture], T: Float64Array, n: int, k: int, config: Config) -> Pairs:
    """Pairs of exactly n rows (ValueError when there are fewer) with k partners each, by the last rung."""
    rows, partners = (to_device(mixture, config) for mixture in mixtures)
    if len(rows) < n:
        raise ValueError(f"the mixture has {len(rows)} components, {n} rows are wanted: give larger images")
    scale = config.alignment.ladder[-1].covariance_scale
    rung = Rung(covariance_scale=scale, components=n, neighbours=k)
    return pair_up(thin(rows, n), partners, T, rung, config.alignment)


def _planes(pairs: Pairs) -> list[Tensor]:
    """The ten planes (k, n) that an evaluation reads: partner means, covariances, log weights."""
    return [*pairs.partner_means, *pairs.partner_covariances, pairs.log_weights]


def reference() -> tuple[Callable[[list[Tensor]], float], str]:
    """The streaming loop and how it is made: compiled where numba is there, else by torch."""
    numba = imported_numba()
    if numba is None:
        return _torch_stream, "torch, one temporary plane (numba is not there)"
    loop = numba.njit(nogil=True, fastmath=True)(_loop)

    def stream(planes: list[Tensor]) -> float:
        return float(loop(*(plane.numpy().reshape(-1) for plane in planes)))

    vector = "vector" if numba.config.USING_SVML else "scalar"
    return stream, f"numba, fastmath, float32, {vector} exponential"


def _torch_stream(planes: list[Tensor]) -> float:
    total = planes[0].clone()
    for plane in planes[1:]:
        total += plane
    return float(total.exp_().sum())


def _loop(y0, y1, y2, s0, s1, s2, s3, s4, s5, w):  # type: ignore[no-untyped-def]
    """Sum of exp(sum of the ten planes) over flat float32 arrays; compiled by numba."""
    total = np.float32(0)
    for i in range(len(w)):
        total += math.exp(y0[i] + y1[i] + y2[i] + s0[i] + s1[i] + s2[i] + s3[i] + s4[i] + s5[i] + w[i])
    return total
