# SPDX-License-Identifier: Apache-2.0
"""The cost of a call: seconds and memory."""

from __future__ import annotations

import resource
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any


def seconds_of(action: Callable[[], Any]) -> tuple[float, float]:
    """Wall and CPU seconds, the latter of all threads."""
    wall, cpu = time.perf_counter(), time.process_time()
    action()
    return time.perf_counter() - wall, time.process_time() - cpu


def peak_mib() -> float:
    """Peak resident memory of this process so far.

    Linux hands the parent's peak on to a forked child's ru_maxrss; VmHWM begins anew with each program.
    """
    status = Path("/proc/self/status")
    if status.is_file():
        peaks = [line for line in status.read_text().splitlines() if line.startswith("VmHWM")]
        if peaks:
            return round(int(peaks[0].split()[1]) / 1024, 1)
    unit = 2**20 if sys.platform == "darwin" else 2**10
    return round(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / unit, 1)
