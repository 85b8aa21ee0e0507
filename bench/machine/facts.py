# SPDX-License-Identifier: Apache-2.0
"""Facts about the machine and the code that a reader needs to judge numbers."""

from __future__ import annotations

import importlib.metadata
import os
import platform
import subprocess
from pathlib import Path
from typing import Any


def machine_facts() -> dict[str, Any]:
    """Processor, cores, load, versions and commit, by name."""
    names = (
        "numpy",
        "scipy",
        "numba",
        "torch",
        "opencv-python-headless",
        "open3d-cpu",
        "small_gicp",
        "poselib",
        "kiss_matcher",
    )
    cpuinfo = Path("/proc/cpuinfo")
    models = [line for line in cpuinfo.read_text().splitlines() if "model name" in line] if cpuinfo.is_file() else []
    facts = {"cpu": models[0].split(":")[1].strip() if models else platform.machine(), "cores": os.cpu_count() or ""}
    facts |= {"load": f"{os.getloadavg()[0]:.1f}", "python": platform.python_version(), "commit": _commit()}
    for name in names:
        try:
            facts[name] = importlib.metadata.version(name)
        except importlib.metadata.PackageNotFoundError:
            continue
    return facts


def _commit() -> str:
    try:
        described = ["git", "describe", "--always", "--dirty", "--abbrev=10", "--exclude=*"]
        return subprocess.run(described, cwd=Path(__file__).parent, capture_output=True, text=True).stdout.strip()
    except OSError:
        return ""
