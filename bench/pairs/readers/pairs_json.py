# SPDX-License-Identifier: Apache-2.0
"""Recorded RGB-D pairs: a folder with a `pairs.json`.

The sets lie beside the repository (`../shared/data`) and are never part of it.
"""

from __future__ import annotations

import json
import zlib
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from bench.pairs.pair import Pair, evenly, scene_points
from garps_core.checks import Float32Array, Float64Array, checked_rigid
from garps_core.types import View

DATA = Path(__file__).resolve().parents[4] / "shared" / "data"
HALVES = ("all", "dev", "held-out")
"""Parameters are chosen on the first half, figures reported on the other."""
RGBD_SETS = ("hololens_lounge", "tum_fr1_rpy")
TRUTH_REACH = {
    ("hololens_lounge", "small"): (0.010, 0.3),
    ("hololens_lounge", "large"): (0.025, 0.4),
    ("tum_fr1_rpy", "small"): (0.017, 0.7),
    ("tum_fr1_rpy", "large"): (0.017, 0.7),
}
"""Accuracy of each set's own truth, m and deg (from the sets' README); generated pairs are exact."""


def truth_covariance(pair: Pair) -> Float64Array:
    """6x6 covariance (ROS meaning) of the truth itself, its reach spread evenly over the axes; zero when exact."""
    metres, degrees = TRUTH_REACH.get((pair.set, pair.category), (0.0, 0.0))
    return np.diag([metres**2 / 3] * 3 + [np.radians(degrees) ** 2 / 3] * 3)


def available(data: Path = DATA) -> list[str]:
    """The RGB-D sets that are there."""
    return [name for name in RGBD_SETS if (data / "dev" / name / "pairs.json").is_file()]


def load_pairs(name: str, data: Path = DATA, limit: int | None = None, half: str = "all") -> list[Pair]:
    """Read one set, or its half, at most `limit` pairs spread evenly over it.

    Raises:
        FileNotFoundError: the set is not there.
        ValueError: no such half.
    """
    return read_pairs(name, data / "dev" / name, limit, half)


def read_pairs(name: str, folder: Path, limit: int | None = None, half: str = "all") -> list[Pair]:
    """The pairs of a folder with a `pairs.json`. Raises as `load_pairs`."""
    records = json.loads((folder / "pairs.json").read_text())["pairs"]
    chosen = ids_of_half([record["id"] for record in records], half)
    records = evenly([record for record in records if record["id"] in chosen], limit)
    return [_pair(name, folder, record) for record in records]


def ids_of_half(ids: Iterable[str], half: str) -> set[str]:
    """Ids of the pairs of a half of `HALVES`, by the ids alone: sorted by CRC-32, they alternate."""
    if half not in HALVES:
        raise ValueError(f"half is {half!r}: expected one of {', '.join(HALVES)}")
    mixed = sorted(ids, key=lambda name: (zlib.crc32(name.encode()), name))
    return set({"dev": mixed[::2], "held-out": mixed[1::2], "all": mixed}[half])


def _pair(name: str, folder: Path, record: dict[str, Any]) -> Pair:
    source, target = (_view(folder, record, i) for i in (0, 1))
    T = checked_rigid("T_1_0", record["T_1_0"])
    points = scene_points(source) if source.depth is not None else np.zeros((0, 3))
    return Pair(name, record["id"], record["category"], source, target, T, points)


def _view(folder: Path, record: dict[str, Any], index: int) -> View:
    depth_file = record.get(f"depth{index}")
    depth = None if depth_file is None else read_depth(folder / depth_file)
    image = cv2.imread(str(folder / record[f"image{index}"]), cv2.IMREAD_COLOR)
    if image is None:
        raise FileNotFoundError(folder / record[f"image{index}"])
    return View(cv2.cvtColor(image, cv2.COLOR_BGR2RGB), np.array(record[f"K{index}"], float), depth)


def read_depth(path: Path) -> Float32Array:
    """A 16-bit PNG in millimetres, 0 = no reading -> HxW float32 metres, NaN = no reading."""
    millimetres = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
    if millimetres is None or millimetres.dtype != np.uint16:
        raise FileNotFoundError(f"{path} is no 16-bit depth image")
    return np.where(millimetres > 0, millimetres * np.float32(1e-3), np.float32("nan")).astype(np.float32)
