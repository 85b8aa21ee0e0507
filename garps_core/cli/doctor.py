# SPDX-License-Identifier: Apache-2.0
"""The state of this machine for a bug report: versions, devices, memory, and one tiny alignment."""

from __future__ import annotations

import importlib.metadata
import importlib.util
import os
import platform
import time

import numpy as np
import torch

from garps_core.align import align_mixtures
from garps_core.checks import Float64Array
from garps_core.geometry import se3_exp, se3_inverse, se3_log, transform
from garps_core.models import depth_networks
from garps_core.start import methods
from garps_core.types import Mixture, Prior
from garps_core.weights.manifest import ALL
from garps_core.weights.store import installed, weights_folder

REQUIRED = ("numpy", "scipy", "torch", "cv2", "poselib", "typer", "safetensors")
OPTIONAL = {
    "rclpy": "ROS 2 nodes; comes with ROS",
    "rosbags": "garps-replay",
    "matplotlib": "--figure",
    "numba": "speed: compiled loops",
    "huggingface_hub": "garps weights fetch",
}
DISTRIBUTIONS = {"cv2": ("opencv-python-headless", "opencv-python", "opencv-contrib-python")}


def examine() -> tuple[list[tuple[str, str]], bool]:
    """Return rows (name, result) for people, and whether everything that is needed works."""
    rows = [("python", f"{platform.python_version()} on {platform.platform()}"), ("garps", version_of("garps_ros"))]
    missing = [name for name in REQUIRED if importlib.util.find_spec(name) is None]
    rows += [(name, "MISSING: install it" if name in missing else version_of(name)) for name in REQUIRED]
    for name, purpose in OPTIONAL.items():
        found = importlib.util.find_spec(name) is not None
        rows.append((name, version_of(name) if found else f"not installed ({purpose})"))
    rows += [
        ("weights", weights()),
        *depth_networks.listed(),
        *((f"start {name}", text) for name, text in methods.listed()),
        ("devices", devices()),
        ("threads", f"{torch.get_num_threads()} of {os.cpu_count()}"),
        ("memory", memory()),
    ]
    works, text = self_test()
    return [*rows, ("self-test", text)], works and not missing


def version_of(module: str) -> str:
    """The installed version of a module's distribution."""
    for name in DISTRIBUTIONS.get(module, (module,)):
        try:
            return importlib.metadata.version(name)
        except importlib.metadata.PackageNotFoundError:
            continue
    return "present, version unknown"


def weights() -> str:
    """Names of the weights that are installed, and their folder."""
    names = [entry.name for entry in ALL if installed(entry.name)]
    return f"{', '.join(names) or 'none'}, in {weights_folder()}"


def devices() -> str:
    """The CPU, and every CUDA device with its memory."""
    found = ["cpu"]
    if torch.cuda.is_available():
        for i in range(torch.cuda.device_count()):
            properties = torch.cuda.get_device_properties(i)
            found.append(f"cuda:{i} ({properties.name}, {properties.total_memory / 2**30:.0f} GiB)")
    return ", ".join(found)


def memory() -> str:
    """Free and total main memory."""
    try:
        page = os.sysconf("SC_PAGE_SIZE") / 2**30
        return f"{os.sysconf('SC_AVPHYS_PAGES') * page:.1f} GiB free of {os.sysconf('SC_PHYS_PAGES') * page:.1f}"
    except (AttributeError, OSError, ValueError):
        return "unknown on this system"


def self_test() -> tuple[bool, str]:
    """Align two samples of one room corner from 8 cm and 3 degrees off; success within 5 mm."""
    truth = se3_exp(np.array([0.10, -0.05, 0.08, 0.02, 0.06, -0.03]))
    start = se3_exp(np.array([0.05, 0.04, -0.05, 0.03, -0.03, 0.03])) @ truth
    prior = Prior(start, np.diag([0.1**2] * 3 + [0.05**2] * 3))
    begin = time.perf_counter()
    estimate = align_mixtures(_corner(1, se3_inverse(truth)), _corner(2, np.eye(4)), prior)
    spent = time.perf_counter() - begin
    if estimate.T_target_source is None:
        return False, f"FAILED: {estimate.status.value}, {estimate.reason}"
    off = float(np.linalg.norm(se3_log(estimate.T_target_source @ se3_inverse(truth))[:3]))
    verdict = "ok" if off < 0.005 else "FAILED"
    return off < 0.005, f"{verdict}: a generated corner aligned to {1000 * off:.2f} mm in {spent:.2f} s"


def _corner(seed: int, T: Float64Array) -> Mixture:
    """Floor, back wall and side wall as flat components of 3 cm, 3 m deep, moved by T."""
    rng = np.random.default_rng(seed)
    n = 700
    a, b = rng.uniform(-1, 1, (2, n))
    walls = (
        np.stack([1.5 * a, np.full(n, 1.2), 2.5 + b], 1),
        np.stack([1.5 * a, 1.2 * b, np.full(n, 3.5)], 1),
        np.stack([np.full(n, -1.5), 1.2 * b, 2.5 + a], 1),
    )
    thin = [np.diag([1.0 if i != axis else 0.01 for i in range(3)]) * 0.03**2 for axis in (1, 2, 0)]
    covariances = np.repeat(T[:3, :3] @ np.array(thin) @ T[:3, :3].T, n, axis=0)
    return Mixture(transform(T, np.concatenate(walls)), covariances, np.ones(3 * n), np.full((3 * n, 3), 0.5))
