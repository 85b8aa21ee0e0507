# SPDX-License-Identifier: Apache-2.0
"""Messages on /diagnostics: three checks, once a second, each with a level, a message and lines of `key: value`.

This is the only place where a line is added: one entry in `_input_lines`, `_estimate_lines`, `_result_lines` or
`_machine_lines`. Its value comes from `NodeState`, `Counts`, `Arrivals` or `Result`.
"""

from __future__ import annotations

import enum
import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import torch

from garps_ros.live.arrivals import MANY_MISSING, InputState
from garps_ros.live.counts import Counts
from garps_ros.live.jobs import Result
from garps_ros.parameters.settings import NodeSettings

WITHOUT_DEPTH = (
    "reconstruction.method:=depth_anything_v2 with preset:=monocular does without depth, and preset:=demo_net shows it "
    "without weights"
)


class Level(enum.IntEnum):
    """Levels of diagnostic_msgs/DiagnosticStatus."""

    OK = 0
    WARN = 1
    ERROR = 2


@dataclass(frozen=True)
class Check:
    """One DiagnosticStatus: its name after the node's, level, one message for people, lines for machines."""

    name: str
    level: Level
    message: str
    values: Mapping[str, str]


@dataclass(frozen=True)
class NodeState:
    """The state of the node at the time of the checks.

    Args:
        settings: the node's own.
        now_s: steady time, s.
        inputs: state of every input.
        clock_warning: why the clock does not run; "" when it does.
        idle: why nothing is computed on purpose; "" when something is.
        stage: what the worker does; "" between jobs.
        busy_s: time that the present computation has been running, s; 0 when there is none.
        gaps_s: distance between the newest stamps of streams that belong together, s.
        unpaired: messages that found no partner.
        enabled: as set by ~/enable.
        device: of the estimator.
        scale: source of metric scale, in words.
        transform: state of the transform on /tf, in words.
    """

    settings: NodeSettings
    now_s: float
    inputs: Sequence[InputState] = ()
    clock_warning: str = ""
    idle: str = ""
    stage: str = ""
    busy_s: float = 0.0
    gaps_s: Mapping[str, float] = field(default_factory=dict)
    unpaired: int = 0
    enabled: bool = True
    device: str = "cpu"
    scale: str = ""
    transform: str = "off"


class Diagnostics:
    """The checks of the node; "in the last second" means since the check before.

    Args:
        counts: of the node, which others fill.
    """

    def __init__(self, counts: Counts) -> None:
        self._counts = counts
        self._last: dict[str, str] = {}
        """Lines about the last result."""
        self._before: dict[str, int] = {}
        """Counts at the last check."""
        self._complete_since_s: float | None = None
        """Steady time since which every input has been arriving, s."""

    def note(self, result: Result) -> None:
        """Keep the lines about a result."""
        self._last |= _result_lines(result)

    def forget(self) -> None:
        """Drop the lines about the last result."""
        self._last.clear()

    def checks(self, state: NodeState) -> list[Check]:
        """Run the three checks."""
        return [self.inputs(state), self.estimates(state), self.machine(state)]

    def inputs(self, state: NodeState) -> Check:
        """Check that every input arrives; to be run before `estimates`."""
        missing = _missing(state)
        self._complete_since_s = None if missing else self._complete_since_s or state.now_s
        lossy = [i for i in state.inputs if not i.once and i.arrivals.missing() > MANY_MISSING]
        refused = self._grown("refused", self._counts.refused.total())
        level, message = Level.OK, "all inputs arrive"
        if missing or state.clock_warning:
            level, message = Level.ERROR, "; ".join([*missing, *([state.clock_warning] if state.clock_warning else [])])
        elif refused:
            level, message = Level.WARN, f"{refused} message(s) refused in the last second: {self._counts.last_refused}"
        elif lossy:
            level, message = Level.WARN, "; ".join(_loss(i) for i in lossy)
        return Check("inputs", level, message, _input_lines(state, self._counts))

    def estimates(self, state: NodeState) -> Check:
        """Check that inputs become pairs, and pairs poses."""
        rejected = self._grown("rejected", self._counts.rejected.total())
        used = self._grown("used", self._counts.used)
        waiting = f"computing for {state.busy_s:.1f} s" if state.busy_s else "waiting for images"
        level, message = Level.OK, f"{used} pose(s) in the last second" if used else waiting
        if state.idle:
            message = state.idle
        elif self._is_unpaired(state):
            apart = "; ".join(f"{names} are {gap:+.3f} s apart" for names, gap in state.gaps_s.items()) or "no stamps"
            slop = f"sync_slop = {state.settings.sync_slop:g} s"
            level, message = Level.WARN, f"images arrive, but none belong together within {slop}: {apart}"
        elif rejected:
            level, message = Level.WARN, f"{rejected} pair(s) rejected in the last second: {self._counts.last_rejected}"
        lines = _estimate_lines(state, self._counts) | _latency_lines(self._counts) | self._last
        return Check("estimates", level, message, lines)

    def machine(self, state: NodeState) -> Check:
        """Check that the worker lives and is not stuck."""
        errors = self._grown("errors", self._counts.errors.total())
        level, message = Level.OK, f"computing: {state.stage}" if state.stage else "idle"
        if errors:
            level, message = Level.ERROR, self._counts.last_error
        elif state.busy_s > (timeout_s := state.settings.stage_timeout):
            took = f"{state.stage} has taken {state.busy_s:.1f} s"
            level, message = Level.ERROR, f"stuck: {took}, expected at most {timeout_s:g} s (stage_timeout)"
        return Check("machine", level, message, _machine_lines(state, self._counts))

    def _is_unpaired(self, state: NodeState) -> bool:
        """Whether all inputs have arrived for longer than the timeout without any pair."""
        since_s = self._complete_since_s
        last_s = self._counts.last_pair_s
        return since_s is not None and state.now_s - max(since_s, last_s or since_s) > state.settings.input_timeout

    def _grown(self, name: str, count: int) -> int:
        """Return by how much a count has grown since the last check."""
        before, self._before[name] = self._before.get(name, 0), count
        return count - before


# --- the lines ----------------------------------------------------------------------------------------------------


def _input_lines(state: NodeState, counts: Counts) -> dict[str, str]:
    lines: dict[str, str] = {}
    for i in state.inputs:
        age, delay = i.arrivals.age_s(state.now_s), i.arrivals.delay_ms()
        lines |= {
            i.role: f"{i.topic}, {i.qos}, {i.publishers} publisher(s)",
            f"{i.role} count": str(i.arrivals.count),
            f"{i.role} rate (Hz)": f"{i.arrivals.rate_hz(state.now_s):.1f}",
            f"{i.role} age (s)": "" if age is None else f"{age:.2f}",
            f"{i.role} delay p50 / max (ms)": "" if delay is None else f"{delay[0]:.1f} / {delay[1]:.1f}",
        }
    return {
        **lines,
        "messages refused": str(counts.refused.total()),
        **{f"refused: {topic}": str(count) for topic, count in sorted(counts.refused.items())},
        "last refused": counts.last_refused,
    }


def _estimate_lines(state: NodeState, counts: Counts) -> dict[str, str]:
    return {
        "pairs in": str(counts.pairs_in),
        "poses used": str(counts.used),
        "last status": counts.last_status,
        **{f"dropped: {reason}": str(count) for reason, count in sorted(counts.dropped.items())},
        **{f"rejected: {status}": str(count) for status, count in sorted(counts.rejected.items())},
        "last rejected": counts.last_rejected,
        "began anew": f"{counts.restarts}, last: {counts.last_restart}" if counts.restarts else "0",
        "transform": state.transform,
    }


def _latency_lines(counts: Counts) -> dict[str, str]:
    if not counts.latencies_s:
        return {}
    latencies, waiting, core = (1000 * np.array(s) for s in (counts.latencies_s, counts.waiting_s, counts.core_s))
    return {
        "latency p50 (ms)": f"{np.percentile(latencies, 50):.1f}",
        "latency p95 (ms)": f"{np.percentile(latencies, 95):.1f}",
        "core p50 (ms)": f"{np.percentile(core, 50):.1f}",
        "waiting p50 (ms)": f"{np.percentile(waiting, 50):.1f}",
        "overhead p50 (ms)": f"{np.percentile(latencies - waiting - core, 50):.1f}",
    }


def _result_lines(result: Result) -> dict[str, str]:
    lines = {"prior": result.prior, "warnings": "; ".join(result.warnings)}
    if result.keyframes:
        lines["keyframes"] = str(result.keyframes)
    if result.outcomes:
        lines["frames"] = f"{result.outcomes[0].child_frame_id} in {result.outcomes[0].frame_id}"
    if result.attempt is not None and result.attempt.row.overlap is not None:
        lines["overlap"] = f"{result.attempt.row.overlap:.2f}"
        lines["quality"] = f"{result.attempt.row.quality or 0:.2f}"
    return lines


def _machine_lines(state: NodeState, counts: Counts) -> dict[str, str]:
    return {
        "stage": state.stage,
        "busy (s)": f"{state.busy_s:.2f}",
        "last error": counts.last_error,
        **{f"errors: {kind}": str(count) for kind, count in sorted(counts.errors.items())},
        **memory(state.device),
        "enabled": str(state.enabled),
        "unpaired messages": str(state.unpaired),
        "scale from": state.scale,
    }


def memory(device: str) -> dict[str, str]:
    """Return the resident memory of this process and, on a GPU, the memory that torch holds there, MB."""
    lines = {"device": device}
    try:
        pages = int(Path("/proc/self/statm").read_text(encoding="ascii").split()[1])
        lines["memory (MB)"] = f"{pages * os.sysconf('SC_PAGE_SIZE') / 1e6:.1f}"
    except OSError:
        lines["memory (MB)"] = "unknown on this system"
    if device.startswith("cuda"):
        lines["device memory (MB)"] = f"{torch.cuda.memory_allocated(device) / 1e6:.1f}"
    return lines


# --- the words ----------------------------------------------------------------------------------------------------


def _missing(state: NodeState) -> list[str]:
    """Say which inputs are missing and why; those of one kind in one clause."""
    clauses, never, silent = [], [], []
    for i in state.inputs:
        age = i.arrivals.age_s(state.now_s)
        where = f"{i.role} ({i.topic}, {i.publishers} publisher(s))"
        if i.warning:
            clauses.append(f"{where}: {i.warning}")
        elif age is None and not i.optional:
            never.append(where)
        elif age is not None and age > state.settings.input_timeout and not i.once:
            silent.append(f"{where} for {age:.1f} s")
    if never:
        only_depth = all("/depth (" in where for where in never)
        clauses.append(f"nothing received yet: {', '.join(never)}" + (f" ({WITHOUT_DEPTH})" if only_depth else ""))
    if silent:
        clauses.append(f"silent: {', '.join(silent)}")
    return clauses


def _loss(lossy: InputState) -> str:
    return (
        f"{lossy.role}: about {lossy.arrivals.missing():.0%} of the messages on {lossy.topic} ({lossy.qos}) "
        "seem lost on the way; "
        "large images need the profile config/fastdds_large_images.xml on both sides, or image_transport:=compressed"
    )
