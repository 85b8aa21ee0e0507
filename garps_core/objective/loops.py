# SPDX-License-Identifier: Apache-2.0
"""Compiled loops over pairs: the objective, and its sums over partners and over rows.

Loops release the interpreter, so that both directions run at once. One flat scratch array with constant offsets lets
the compiler see that nothing overlaps, so it works on 8 or 16 rows at a time. `compiled.py` calls them.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, TypeVar

import numpy as np
import numpy.typing as npt

Float32 = npt.NDArray[np.float32]
Float64 = npt.NDArray[np.float64]
Int64 = npt.NDArray[np.int64]
Loop = TypeVar("Loop", bound=Callable[..., Any])

try:
    import numba
except ImportError:  # optional: pip install ".[fast]"
    numba = None

AVAILABLE = numba is not None
"""True where numba is installed; without it the loops run as plain Python."""
ROWS = 128
"""Rows handled at a time: the scratch of 36 planes stays in a core's first-level cache."""
FINITE_MATH = {"contract", "reassoc", "arcp", "nsz", "afn"}
"""Liberties the compiler may take. It must keep infinities, which mean "no partner"."""


def loop(function: Loop) -> Loop:
    """Compile `function`, or return it unchanged without numba."""
    if numba is None:
        return function
    options: dict[str, Any] = {"nogil": True, "fastmath": FINITE_MATH, "error_model": "numpy"}
    try:
        compiled = numba.njit(cache=True, **options)(function)
    except RuntimeError:  # no folder to keep machine code in: compile in every process
        compiled = numba.njit(**options)(function)
    return compiled  # type: ignore[no-any-return]


@loop
def exponential(x: np.float32) -> np.float32:
    """Exponential e^x for -80 < x < 80, relative error 2e-7: 2^n times a polynomial (Cephes expf)."""
    n = np.int32(np.int32(x * np.float32(1.44269504) + np.float32(256.5)) - np.int32(256))
    whole = np.float32(n)
    r = x - whole * np.float32(0.693359375) + whole * np.float32(2.12194440e-4)
    p = np.float32(1.9875691500e-4)
    p = p * r + np.float32(1.3981999507e-3)
    p = p * r + np.float32(8.3334519073e-3)
    p = p * r + np.float32(4.1665795894e-2)
    p = p * r + np.float32(1.6666665459e-1)
    p = p * r + np.float32(5.0000001201e-1)
    p = p * r * r + r + np.float32(1)
    return p * np.int32((n + np.int32(127)) << np.int32(23)).view(np.float32)


@loop
def logarithm(s: np.float32) -> np.float32:
    """Logarithm of 1 + s for finite s >= 0, relative error 1e-6: n log 2 and an odd series of f / (2 + f) (fdlibm).

    Below 0.1 it is a Taylor series: 1 + s would lose digits, and a compensation would not survive fast math.
    """
    one, half = np.float32(1), np.float32(0.5)
    few = one / np.float32(4) - s * (one / np.float32(5) - s / np.float32(6))
    few = s * (one - s * (half - s * (one / np.float32(3) - s * few)))
    bits = np.int32(np.float32(one + s).view(np.int32) + np.int32(0x3F800000 - 0x3F3504F3))
    n = np.float32(np.int32(bits >> np.int32(23)) - np.int32(127))
    f = np.int32((bits & np.int32(0x007FFFFF)) + np.int32(0x3F3504F3)).view(np.float32) - one
    t = f / (np.float32(2) + f)
    z = t * t
    series = np.float32(0.24279078841) * z + np.float32(0.28498786688)
    series = (series * z + np.float32(0.40000972152)) * z + np.float32(0.66666662693)
    square = half * f * f
    many = n * np.float32(0.69314718056) + (t * (square + series * z) - square + f)
    return few if s < np.float32(0.1) else many


@loop
def row_sums(
    mu: Float32, S: Float32, partners: Float32, covariances: Float32, log_weights: Float32, floor: Float32
) -> Float32:
    """(16, n) sums of `plain.row_sums`, from mu (3, n), S (6, n) and planes (3, k, n), (6, k, n), (k, n), (n,)."""
    n = log_weights.shape[1]
    out = np.empty((16, n), np.float32)
    w, total = np.empty(20 * ROWS, np.float32), np.empty(16 * ROWS, np.float32)
    for begin in range(0, n, ROWS):
        rows = min(ROWS, n - begin)
        for plane in range(3):
            for r in range(rows):
                w[plane * ROWS + r] = mu[plane, begin + r]
        for plane in range(6):
            for r in range(rows):
                w[(3 + plane) * ROWS + r] = S[plane, begin + r]
        _sum_partners(w, total, begin, rows, partners, covariances, log_weights, floor)
        for plane in range(16):
            for r in range(rows):
                out[plane, begin + r] = total[plane * ROWS + r]
    return out


@loop
def evaluated(
    means: Float32, own: Float32, R: Float32, t: Float32, turn: Float32, weights: Float32,
    partners: Float32, covariances: Float32, log_weights: Float32, floor: Float32,
) -> tuple[float, float, Float64, Float64]:  # fmt: skip
    """The "log" objective in one pass: value, support, and (10, 15) and (6, 6) of `moments`.

    means (n, 3), own covariances (n, 6) of the rows before the pose (R, t); turn (6, 6): R on packed covariances.
    """
    n = len(means)
    w, total = np.empty(20 * ROWS, np.float32), np.empty(16 * ROWS, np.float32)
    v, missing, share = np.empty(31 * ROWS), np.empty(ROWS), np.empty(ROWS)
    out, turning = np.zeros((10, 15)), np.zeros((6, 6))
    value = support = 0.0
    for begin in range(0, n, ROWS):
        rows = min(ROWS, n - begin)
        for plane in range(3):
            for r in range(rows):
                x, y, z = means[begin + r, 0], means[begin + r, 1], means[begin + r, 2]
                w[plane * ROWS + r] = R[plane, 0] * x + R[plane, 1] * y + R[plane, 2] * z + t[plane]
        for r in range(rows):  # into planes, for the time being in `total`
            for element in range(6):
                total[element * ROWS + r] = own[begin + r, element]
        for plane in range(6):
            a, b, c, e, f, i = turn[plane]
            for r in range(rows):
                turned = a * total[r] + b * total[ROWS + r] + c * total[2 * ROWS + r]
                turned += e * total[3 * ROWS + r] + f * total[4 * ROWS + r] + i * total[5 * ROWS + r]
                w[(3 + plane) * ROWS + r] = turned
        _sum_partners(w, total, begin, rows, partners, covariances, log_weights, floor)
        for r in range(rows):  # into scratch: how a sum is ordered must not depend on where in memory the input lies
            share[r] = weights[begin + r]
        for r in range(rows):
            s, weight = np.float64(total[r]), share[r]
            value += weight * logarithm(total[r])
            share[r] = weight / (1 + s)
            support += share[r] * s
            missing[r] = 1 / max(weight, 1e-300)
        for plane in range(15):
            for r in range(rows):
                v[(10 + plane) * ROWS + r] = total[(1 + plane) * ROWS + r] * share[r]
        for plane in range(6):
            for r in range(rows):
                v[(25 + plane) * ROWS + r] = w[(3 + plane) * ROWS + r]
        _set_powers(v, w, rows)
        _add_moments(v, missing, rows, out, turning)
    return value, support, out, turning


@loop
def _sum_partners(
    w: Float32, total: Float32, begin: int, rows: int,
    partners: Float32, covariances: Float32, log_weights: Float32, floor: Float32,
) -> None:  # fmt: skip
    """Fill `total` for one block of rows; planes of w: 0 mu, 3 S, 9 floor, 10 d, 13 S + S_j, 19 log weight."""
    for r in range(rows):
        w[9 * ROWS + r] = floor[begin + r]
    total[:] = 0
    for j in range(log_weights.shape[0]):
        for plane in range(3):
            from_plane = partners[plane, j]
            for r in range(rows):
                w[(10 + plane) * ROWS + r] = w[plane * ROWS + r] - from_plane[begin + r]
        for plane in range(6):
            from_plane = covariances[plane, j]
            for r in range(rows):
                w[(13 + plane) * ROWS + r] = w[(3 + plane) * ROWS + r] + from_plane[begin + r]
        weights = log_weights[j]
        for r in range(rows):
            w[19 * ROWS + r] = weights[begin + r] - w[9 * ROWS + r]
        _add_partner(w, total, rows)


@loop
def _add_partner(w: Float32, total: Float32, rows: int) -> None:
    """Add one partner of each row to the sums; the formulas of `plain._chunk_sums`, in its order."""
    one, left = np.float32(1), np.float32(1.1920929e-07)
    for r in range(rows):
        d0, d1, d2 = w[10 * ROWS + r], w[11 * ROWS + r], w[12 * ROWS + r]
        a, b, c = w[13 * ROWS + r], w[14 * ROWS + r], w[15 * ROWS + r]
        e, f, i = w[16 * ROWS + r], w[17 * ROWS + r], w[18 * ROWS + r]
        r0 = one / a
        l1, l2 = b * r0, c * r0
        second = max(e - b * l1, e * left)
        r1 = one / second
        f = f - c * l1
        l3 = f * r1
        third = max(i - c * l2 - f * l3, i * left)
        p5 = one / third
        m = l1 * l3 - l2
        p4, p2 = -l3 * p5, m * p5
        l1r = l1 * r1
        p1 = m * p4 - l1r
        p0 = r0 + l1 * l1r + m * p2
        p3 = r1 - l3 * p4
        u0 = p0 * d0 + p1 * d1 + p2 * d2
        u1 = p1 * d0 + p3 * d1 + p4 * d2
        u2 = p2 * d0 + p4 * d1 + p5 * d2
        D = d0 * u0 + d1 * u1 + d2 * u2
        exponent = min(max(w[19 * ROWS + r] - np.float32(0.5) * D, np.float32(-60)), np.float32(80))
        g = exponential(exponent) * np.sqrt(r0 * r1 * p5)
        g0, g1, g2 = g * u0, g * u1, g * u2
        total[r] += g
        total[ROWS + r] += g0
        total[2 * ROWS + r] += g1
        total[3 * ROWS + r] += g2
        total[4 * ROWS + r] += p0 * g
        total[5 * ROWS + r] += p1 * g
        total[6 * ROWS + r] += p2 * g
        total[7 * ROWS + r] += p3 * g
        total[8 * ROWS + r] += p4 * g
        total[9 * ROWS + r] += p5 * g
        total[10 * ROWS + r] += g0 * u0
        total[11 * ROWS + r] += g0 * u1
        total[12 * ROWS + r] += g0 * u2
        total[13 * ROWS + r] += g1 * u1
        total[14 * ROWS + r] += g1 * u2
        total[15 * ROWS + r] += g2 * u2


@loop
def moments(c: Float64, missing: Float64, sums: Float32, mu: Float32, S: Float32) -> tuple[Float64, Float64]:
    """(10, 15) and (6, 6) moments of `plain.moments`.

    c (n,) multiplies the sums; missing (n,) multiplies the outer product of a row's own u, 0 for the "sum" form.
    """
    n = len(c)
    out, turning = np.zeros((10, 15)), np.zeros((6, 6))
    w, v = np.empty(3 * ROWS, np.float32), np.empty(31 * ROWS)
    for begin in range(0, n, ROWS):
        rows = min(ROWS, n - begin)
        for plane in range(3):
            for r in range(rows):
                w[plane * ROWS + r] = mu[plane, begin + r]
        for plane in range(15):
            for r in range(rows):
                v[(10 + plane) * ROWS + r] = sums[1 + plane, begin + r] * c[begin + r]
        for plane in range(6):
            for r in range(rows):
                v[(25 + plane) * ROWS + r] = S[plane, begin + r]
        _set_powers(v, w, rows)
        _add_moments(v, missing[begin : begin + rows], rows, out, turning)
    return out, turning


@loop
def _set_powers(v: Float64, w: Float32, rows: int) -> None:
    """Planes 0..9 of v: 1, mu and the products of mu, which is planes 0..2 of w."""
    for r in range(rows):
        x, y, z = np.float64(w[r]), np.float64(w[ROWS + r]), np.float64(w[2 * ROWS + r])
        v[r], v[ROWS + r], v[2 * ROWS + r], v[3 * ROWS + r] = 1.0, x, y, z
        v[4 * ROWS + r], v[5 * ROWS + r], v[6 * ROWS + r] = x * x, x * y, x * z
        v[7 * ROWS + r], v[8 * ROWS + r], v[9 * ROWS + r] = y * y, y * z, z * z


@loop
def _add_moments(v: Float64, missing: Float64, rows: int, out: Float64, turning: Float64) -> None:
    """Add one block's S (planes 25..30) times (u u' - S^-1), and planes 0..9 times u, S^-1 and what is missing.

    Planes 10..12 hold u, 13..18 S^-1, 19..24 u u', from which the outer product of the row's own u is then taken away.
    """
    for a in range(6):
        for b in range(6):
            s = 0.0
            for r in range(rows):
                s += v[(25 + a) * ROWS + r] * (v[(19 + b) * ROWS + r] - v[(13 + b) * ROWS + r])
            turning[a, b] += s
    for r in range(rows):
        u0, u1, u2, q = v[10 * ROWS + r], v[11 * ROWS + r], v[12 * ROWS + r], missing[r]
        v[19 * ROWS + r] -= q * u0 * u0
        v[20 * ROWS + r] -= q * u0 * u1
        v[21 * ROWS + r] -= q * u0 * u2
        v[22 * ROWS + r] -= q * u1 * u1
        v[23 * ROWS + r] -= q * u1 * u2
        v[24 * ROWS + r] -= q * u2 * u2
    for a in range(10):
        for b in range(0, 15, 3):
            s0 = s1 = s2 = 0.0
            for r in range(rows):
                power = v[a * ROWS + r]
                s0 += power * v[(10 + b) * ROWS + r]
                s1 += power * v[(11 + b) * ROWS + r]
                s2 += power * v[(12 + b) * ROWS + r]
            out[a, b] += s0
            out[a, b + 1] += s1
            out[a, b + 2] += s2
