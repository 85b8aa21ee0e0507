# SPDX-License-Identifier: Apache-2.0
"""The writing and counting of a replay's outcomes, and its end on a signal."""

from __future__ import annotations

import signal
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from types import FrameType

import numpy as np

from garps_ros.estimates.outcomes import Origin, Outcome
from garps_ros.recording.outputs import Outputs
from garps_ros.recording.summary import Summary
from msg_adapters import MessageError

NOT_PUBLISHABLE = "not_publishable"


def record(
    outcomes: Iterable[Origin | Outcome],
    outputs: Outputs,
    summary: Summary,
    stopped: Callable[[], bool],
    limit: int | None = None,
) -> None:
    """Write outcomes until they end, `stopped` returns True, or `limit` pairs are done."""
    for outcome in outcomes:
        if isinstance(outcome, Origin):
            outputs.begin_trajectory(outcome.segment, outcome.frame_id, outcome.child_frame_id)
            if outcome.stamp_ns is not None:
                outputs.write_trajectory(outcome.segment, outcome.stamp_ns, np.eye(4))
        else:
            _write(outcome, outputs, summary)
        if stopped() or (limit is not None and summary.pairs >= limit):
            return


def _write(outcome: Outcome, outputs: Outputs, summary: Summary) -> None:
    row, published = outcome.row, False
    if outcome.T is not None and outcome.covariance is not None:
        try:
            stamp_ns, names = row.source_stamp_ns, (outcome.frame_id, outcome.child_frame_id)
            outputs.publish(outcome.T, outcome.covariance, stamp_ns, *names)
            outputs.write_trajectory(row.segment, stamp_ns, outcome.T)
            published = True
        except MessageError as error:
            row = replace(row, status=NOT_PUBLISHABLE, reason=str(error))
    outputs.write_row(row)
    summary.count(row.status, published, outcome.seconds)


@contextmanager
def stop_on_signals() -> Iterator[Callable[[], bool]]:
    """Make SIGINT and SIGTERM only set the value of the function that is given, so that no row is left half written.

    A second signal has its default effect, so that a user can end the process without waiting for the current pair.
    """
    received: list[int] = []
    before = {number: signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)}

    def note(number: int, _: FrameType | None) -> None:
        received.append(number)
        for number_, default in ((signal.SIGINT, signal.default_int_handler), (signal.SIGTERM, signal.SIG_DFL)):
            signal.signal(number_, default)

    for number in before:
        signal.signal(number, note)
    try:
        yield lambda: bool(received)
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
