# SPDX-License-Identifier: Apache-2.0
"""Statistics of the arrivals at one input: rate, age, delay, and how many messages seem to be missing."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from garps_core.checks import Float64Array

WINDOW = 100
"""Number of arrivals that statistics look back on."""
MANY_MISSING = 0.3
"""Smallest share of missing messages that is reported."""
PAUSE_S = 5.0
"""Smallest gap of stamps that counts as a pause of the publisher and not as a loss, s."""
NEAR = 0.25
"""Distance from a whole number of periods, in periods, within which a gap counts as that number."""
LONG = 3
"""Number of periods above which a gap is a loss, however near it is to a whole number; jitter is shorter."""
STEADY = 6
"""Number of equal gaps in a row that count as a new period; random losses are less regular."""
SURE_SIGMAS = 3.0
"""Standard deviations by which the near gaps must outnumber those expected by chance, for a period to be accepted."""
SPREAD = 6.0
"""Ratio of the ninth to the first decile of the gaps that means loss even where no period is found."""
ROUNDS = 20
FEW = 20
"""Smallest number of messages from which loss is estimated."""


class Arrivals:
    """Arrival times and stamps of one topic."""

    def __init__(self) -> None:
        self.count = 0
        self._times_s: deque[float] = deque(maxlen=WINDOW)
        self._stamps_s: deque[float] = deque(maxlen=WINDOW)
        self._delays_s: deque[float] = deque(maxlen=WINDOW)

    def note(self, now_s: float, stamp_ns: int, clock_ns: int) -> None:
        """Note the arrival of a message.

        Args:
            now_s: steady time, s.
            stamp_ns: header stamp, ns.
            clock_ns: the ROS clock, ns; 0 when it is not running.
        """
        self.count += 1
        self._times_s.append(now_s)
        if self._stamps_s and not 0 < stamp_ns * 1e-9 - self._stamps_s[-1] < PAUSE_S:
            self._stamps_s.clear()
        self._stamps_s.append(stamp_ns * 1e-9)
        if clock_ns:
            self._delays_s.append((clock_ns - stamp_ns) * 1e-9)

    def age_s(self, now_s: float) -> float | None:
        """Return the steady time since the last arrival, s; None before the first."""
        return now_s - self._times_s[-1] if self._times_s else None

    def rate_hz(self, now_s: float, window_s: float = 5.0) -> float:
        """Return the arrivals per second over the last few seconds."""
        recent = [time for time in self._times_s if now_s - time <= window_s]
        if len(recent) < 2:
            return len(recent) / window_s
        return (len(recent) - 1) / max(recent[-1] - recent[0], 1e-6)

    def delay_ms(self) -> tuple[float, float] | None:
        """Return median and maximum of the time from stamp to arrival on the ROS clock, ms; None while unknown."""
        if not self._delays_s:
            return None
        return 1000 * float(np.median(self._delays_s)), 1000 * max(self._delays_s)

    def missing(self) -> float:
        """Estimate the share of messages that were lost, from gaps between stamps; 0 while unknown.

        Lost are those between stamps a whole multiple of the period apart. Jitter makes other gaps, and a camera that
        slows down, as for its exposure, many equal ones: both are no loss.
        """
        if len(self._stamps_s) < FEW:
            return 0.0
        multiples = _multiples(np.diff(np.asarray(self._stamps_s)))
        lost = float((multiples - 1)[(multiples > 1) & ~_in_long_run(multiples)].sum())
        return lost / (lost + len(multiples))


@dataclass(frozen=True)
class InputState:
    """The state of an input at the time of a check.

    Args:
        role: "source/image" and so on.
        topic: name of its topic, after remapping.
        arrivals: of its messages.
        publishers: number of publishers on the topic.
        qos: QoS of the subscription, in words.
        warning: why nothing can arrive; "" when no reason is known.
        once: one message is enough, because a calibration may be latched.
        optional: its absence is no error.
    """

    role: str
    topic: str
    arrivals: Arrivals
    publishers: int
    qos: str
    warning: str = ""
    once: bool = False
    optional: bool = False


def _multiples(gaps_s: Float64Array) -> Float64Array:
    """Return the length of each gap in periods; 0 where it is no whole number, or cannot be told."""
    ordered_s = np.sort(gaps_s)
    tenth = len(gaps_s) // 10
    far_apart = ordered_s[-1 - tenth] > SPREAD * ordered_s[tenth]
    best = np.rint(gaps_s / _refined_s(tenth, ordered_s)) if far_apart else np.zeros_like(gaps_s)
    highest = SURE_SIGMAS
    for share in (50, 25, 10, 5, 2):  # from the largest: of two periods that explain as much the one with less loss
        periods = gaps_s / _refined_s(len(gaps_s) * share // 100, ordered_s)
        multiples = np.rint(periods)
        near, long = np.abs(periods - multiples) < NEAR, multiples > LONG
        short = np.count_nonzero(~long)
        # By chance half of the gaps are near.
        sigmas = (2 * np.count_nonzero(near & ~long & (multiples > 0)) - short) / np.sqrt(short)
        if sigmas > highest:
            best, highest = np.where(near | long, multiples, 0.0), sigmas
    return best


def _refined_s(index: int, ordered_s: Float64Array) -> float:
    """Return the median of the gaps of one period, s, starting at the gap of that index, which may be too short."""
    for _ in range(ROUNDS):
        index = (int(np.searchsorted(ordered_s, 1.5 * ordered_s[index])) - 1) // 2
    return float(ordered_s[index])


def _in_long_run(multiples: Float64Array) -> npt.NDArray[np.bool_]:
    """Mark each gap that is one of `STEADY` or more equal ones in a row."""
    ends = np.flatnonzero(np.diff(multiples)) + 1
    lengths = np.diff([0, *ends, len(multiples)])
    return np.repeat(lengths >= STEADY, lengths)
