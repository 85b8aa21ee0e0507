# SPDX-License-Identifier: Apache-2.0
"""How the live node is doing: counts of everything that went in or was left out, and the verdict once a second."""

from __future__ import annotations

import enum
import os
from collections import Counter, deque
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import torch

from garps_ros.live.arrivals import MANY_MISSING, Arrivals

WINDOW = 200
"""Results that latencies look back on."""
WITHOUT_DEPTH = (
    "reconstruction.method:=depth_anything_v2 with preset:=monocular does without depth, and preset:=demo_net shows it "
    "without weights"
)


class Level(enum.IntEnum):
    """Of diagnostic_msgs/DiagnosticStatus."""

    OK = 0
    WARN = 1
    ERROR = 2


@dataclass(frozen=True)
class Finding:
    """One DiagnosticStatus: its name after the node's, level, one line for people, values for machines."""

    name: str
    level: Level
    message: str
    values: Mapping[str, str]


@dataclass(frozen=True)
class InputState:
    """An input at the time of the verdict.

    Args:
        role: "source/image" and so on.
        topic: what it is connected to.
        arrivals: of its messages.
        publishers: how many there are.
        qos: how it is subscribed.
        problem: why nothing can arrive; "" when no reason is known.
        once: one message is enough: a calibration may be latched.
        optional: nothing is wrong when nothing comes.
    """

    role: str
    topic: str
    arrivals: Arrivals
    publishers: int
    qos: str
    problem: str = ""
    once: bool = False
    optional: bool = False


@dataclass
class Health:
    """Counts since the start; latencies of the last results."""

    pairs_in: int = 0
    used: int = 0
    last_pair_s: float | None = None
    """Steady time at which frames last became complete."""
    dropped: Counter[str] = field(default_factory=Counter)
    rejected: Counter[str] = field(default_factory=Counter)
    refused: Counter[str] = field(default_factory=Counter)
    """Messages that could not be used at all, by topic."""
    last_refused: str = ""
    last_rejected: str = ""
    last_status: str = ""
    errors: Counter[str] = field(default_factory=Counter)
    """Errors of the node itself: worker deaths, callbacks."""
    last_error: str = ""
    restarts: int = 0
    """How often everything of before has been forgotten: resets, time going back."""
    last_restart: str = ""
    facts: dict[str, str] = field(default_factory=dict)
    """Of the last estimate: overlap, keyframe, prior."""
    latencies_s: deque[float] = field(default_factory=lambda: deque(maxlen=WINDOW))
    waiting_s: deque[float] = field(default_factory=lambda: deque(maxlen=WINDOW))
    core_s: deque[float] = field(default_factory=lambda: deque(maxlen=WINDOW))
    _seen: dict[str, int] = field(default_factory=dict)
    _complete_since_s: float | None = None
    """Steady time since which every input has been arriving."""

    def refuse(self, topic: str, reason: str) -> None:
        """Count a message that cannot be used."""
        self.refused[topic] += 1
        self.last_refused = f"{topic}: {reason}"

    def reject(self, status: str, reason: str) -> None:
        """Count frames without a pose."""
        self.rejected[status] += 1
        self.last_status, self.last_rejected = status, f"{status}: {reason}"

    def fail(self, kind: str, reason: str) -> None:
        """Count an error of the node itself."""
        self.errors[kind] += 1
        self.last_error = f"{kind}: {reason}"

    def publish(self, latency_s: float, waiting_s: float, core_s: float) -> None:
        """Count a pose that was published.

        Args:
            latency_s: from the arrival of the newest message to publication, s.
            waiting_s: of it for the worker to become free, s.
            core_s: of it inside the estimator, s.
        """
        self.used += 1
        self.last_status = "converged"
        for durations, seconds in (
            (self.latencies_s, latency_s),
            (self.waiting_s, waiting_s),
            (self.core_s, core_s),
        ):
            durations.append(seconds)

    def inputs(self, states: Iterable[InputState], now_s: float, timeout_s: float, waiting: str) -> Finding:
        """The verdict on the inputs; `waiting` names what the clock waits for, "" when it runs."""
        states = list(states)
        troubles = _troubles(states, now_s, timeout_s)
        self._complete_since_s = None if troubles else self._complete_since_s or now_s
        lossy = [state for state in states if not state.once and state.arrivals.missing() > MANY_MISSING]
        fresh = self._grown("refused", self.refused.total())
        level, message = Level.OK, "all inputs arrive"
        if troubles or waiting:
            level, message = Level.ERROR, "; ".join([*troubles, *([waiting] if waiting else [])])
        elif fresh:
            level, message = Level.WARN, f"{fresh} message(s) refused in the last second: {self.last_refused}"
        elif lossy:
            level, message = Level.WARN, "; ".join(_loss(state) for state in lossy)
        values = {key: value for state in states for key, value in _input_values(state, now_s).items()}
        values["messages refused"] = str(self.refused.total())
        values |= {f"refused: {topic}": str(count) for topic, count in sorted(self.refused.items())}
        values["last refused"] = self.last_refused
        return Finding("inputs", level, message, values)

    def estimates(
        self, idle: str, busy_s: float, gaps_s: Mapping[str, float], slop_s: float, now_s: float, timeout_s: float
    ) -> Finding:
        """The verdict on what came of the inputs; to be asked for after theirs.

        Args:
            idle: why nothing is computed on purpose; "" when it is.
            busy_s: for how long the present computation has been running, s; 0 when there is none.
            gaps_s: between newest stamps of streams that belong together, s.
            slop_s: the largest gap that pairs, s.
            now_s: steady time, s.
            timeout_s: for so long inputs may arrive without any becoming complete.
        """
        since_s = self._complete_since_s
        unpaired = since_s is not None and now_s - max(since_s, self.last_pair_s or since_s) > timeout_s
        rejected = self._grown("rejected", self.rejected.total())
        used = self._grown("used", self.used)
        waiting = f"computing for {busy_s:.1f} s" if busy_s else "waiting for images"
        level, message = Level.OK, f"{used} pose(s) in the last second" if used else waiting
        if idle:
            message = idle
        elif unpaired:
            apart = "; ".join(f"{names} are {gap:+.3f} s apart" for names, gap in gaps_s.items())
            level = Level.WARN
            message = f"images arrive, but none belong together within sync_slop = {slop_s:g} s: {apart or 'no stamps'}"
        elif rejected:
            level, message = Level.WARN, f"{rejected} rejected in the last second: {self.last_rejected}"
        values = {"pairs in": str(self.pairs_in), "poses used": str(self.used), "last status": self.last_status}
        values |= {f"dropped: {reason}": str(count) for reason, count in sorted(self.dropped.items())}
        values |= {f"rejected: {status}": str(count) for status, count in sorted(self.rejected.items())}
        values["last rejected"] = self.last_rejected
        values["began anew"] = f"{self.restarts}, last: {self.last_restart}" if self.restarts else "0"
        values |= self._latency_values() | self.facts
        return Finding("estimates", level, message, values)

    def machine(self, stage: str, busy_s: float, stage_timeout_s: float, values: Mapping[str, str]) -> Finding:
        """The verdict on the worker: `busy_s` into its present job, in `stage`."""
        fresh = self._grown("errors", self.errors.total())
        level, message = Level.OK, f"computing: {stage}" if stage else "idle"
        if fresh:
            level, message = Level.ERROR, self.last_error
        elif busy_s > stage_timeout_s:
            level = Level.ERROR
            message = f"stuck: {stage} has taken {busy_s:.1f} s, expected at most {stage_timeout_s:g} s (stage_timeout)"
        counts = {f"errors: {kind}": str(count) for kind, count in sorted(self.errors.items())}
        own = {"stage": stage, "busy (s)": f"{busy_s:.2f}", "last error": self.last_error}
        return Finding("machine", level, message, {**own, **counts, **values})

    def _latency_values(self) -> dict[str, str]:
        if not self.latencies_s:
            return {}
        latencies, waiting, core = (1000 * np.array(s) for s in (self.latencies_s, self.waiting_s, self.core_s))
        return {
            "latency p50 (ms)": f"{np.percentile(latencies, 50):.1f}",
            "latency p95 (ms)": f"{np.percentile(latencies, 95):.1f}",
            "core p50 (ms)": f"{np.percentile(core, 50):.1f}",
            "waiting p50 (ms)": f"{np.percentile(waiting, 50):.1f}",
            "overhead p50 (ms)": f"{np.percentile(latencies - waiting - core, 50):.1f}",
        }

    def _grown(self, name: str, count: int) -> int:
        """By how much a count has grown since the last verdict."""
        before, self._seen[name] = self._seen.get(name, 0), count
        return count - before


def _troubles(states: list[InputState], now_s: float, timeout_s: float) -> list[str]:
    """Why inputs are missing; those of one kind in one clause."""
    troubles, never, silent = [], [], []
    for state in states:
        age = state.arrivals.age_s(now_s)
        where = f"{state.role} ({state.topic}, {state.publishers} publisher(s))"
        if state.problem:
            troubles.append(f"{where}: {state.problem}")
        elif age is None and not state.optional:
            never.append(where)
        elif age is not None and age > timeout_s and not state.once:
            silent.append(f"{where} for {age:.1f} s")
    if never:
        troubles.append(f"nothing received yet: {', '.join(never)}")
        if all("/depth (" in where for where in never):
            troubles[-1] += f" ({WITHOUT_DEPTH})"
    if silent:
        troubles.append(f"silent: {', '.join(silent)}")
    return troubles


def _loss(state: InputState) -> str:
    return (
        f"{state.role}: about {state.arrivals.missing():.0%} of the messages on {state.topic} ({state.qos}) "
        "seem lost on the way; "
        "large images need the profile config/fastdds_large_images.xml on both sides, or image_transport:=compressed"
    )


def _input_values(state: InputState, now_s: float) -> dict[str, str]:
    age, delay = state.arrivals.age_s(now_s), state.arrivals.delay_ms()
    return {
        state.role: f"{state.topic}, {state.qos}, {state.publishers} publisher(s)",
        f"{state.role} count": str(state.arrivals.count),
        f"{state.role} rate (Hz)": f"{state.arrivals.rate_hz(now_s):.1f}",
        f"{state.role} age (s)": "" if age is None else f"{age:.2f}",
        f"{state.role} delay p50 / max (ms)": "" if delay is None else f"{delay[0]:.1f} / {delay[1]:.1f}",
    }


def memory(device: str) -> dict[str, str]:
    """Resident memory of this process and, on a GPU, what torch holds of it; MB."""
    values = {"device": device}
    try:
        pages = int(Path("/proc/self/statm").read_text(encoding="ascii").split()[1])
        values["memory (MB)"] = f"{pages * os.sysconf('SC_PAGE_SIZE') / 1e6:.1f}"
    except OSError:
        values["memory (MB)"] = "unknown on this system"
    if device.startswith("cuda"):
        values["device memory (MB)"] = f"{torch.cuda.memory_allocated(device) / 1e6:.1f}"
    return values
