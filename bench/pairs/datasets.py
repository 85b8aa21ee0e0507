# SPDX-License-Identifier: Apache-2.0
"""Image pairs with known relative pose, and disturbed starts for them.

The sets are folders with a `pairs.json`; they lie beside the repository (`../shared/data`) and are never part of it.
All depth is in metres along z, all poses are `T_target_source` (image 0 = source, image 1 = target).
"""

from __future__ import annotations

import dataclasses
import json
import zlib
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar

import cv2
import numpy as np
from scipy.spatial.transform import Rotation

from garps_core.checks import Float32Array, Float64Array, IntArray, checked_rigid
from garps_core.geometry import pixel_rays, skew, transform
from garps_core.types import Prior, View

Item = TypeVar("Item")
DATA = Path(__file__).resolve().parents[3] / "shared" / "data"
HALVES = ("all", "dev", "held-out")
"""Parameters are chosen on the first half, figures reported on the other."""
RGBD_SETS = ("hololens_lounge", "tum_fr1_rpy")
TRUTH_REACH = {
    ("hololens_lounge", "small"): (0.010, 0.3),
    ("hololens_lounge", "large"): (0.025, 0.4),
    ("tum_fr1_rpy", "small"): (0.017, 0.7),
    ("tum_fr1_rpy", "large"): (0.017, 0.7),
}
"""How far each set's own truth can be trusted, m and deg (the sets' README); generated pairs are exact."""
DISTURBANCE_M = 0.12
DISTURBANCE_DEG = 1.0
NOMINAL_RANGE_M = 3.0
"""Where the centre of a scene is taken to lie on the optical axis when nothing is known of its points."""


@dataclass(frozen=True, eq=False)
class Pair:
    """Two views and the truth.

    Args:
        set: name of the data set.
        id: name of the pair within it.
        category: "small" (at most 0.3 m and 15 deg) or "large".
        source, target: the two views.
        T_target_source: 4x4, m.
        points: Nx3 m, true scene points in the source frame; they stay true when the views' depth is spoilt.
        scale: where the unit of the translation comes from: "metres" (measured), "raw" (the set's own arbitrary unit)
            or "sfm-depth x1.234" (that unit times a factor found from a network's depth).
        points_from: whose points those are: "truth", or the network's whose depth gave them.
        labels: HxW class of every pixel of source and target, where the truth has them.
    """

    set: str
    id: str
    category: str
    source: View
    target: View
    T_target_source: Float64Array
    points: Float64Array
    scale: str = "metres"
    points_from: str = "truth"
    labels: tuple[IntArray, IntArray] | None = None


def truth_covariance(pair: Pair) -> Float64Array:
    """6x6 covariance (ROS meaning) of the truth itself, its reach spread evenly over the axes; zero when exact."""
    metres, degrees = TRUTH_REACH.get((pair.set, pair.category), (0.0, 0.0))
    return np.diag([metres**2 / 3] * 3 + [np.radians(degrees) ** 2 / 3] * 3)


def rng_of(name: str, seed: int = 0) -> np.random.Generator:
    """A generator that depends on nothing but a name and a seed (Python's own hash changes from run to run)."""
    return np.random.default_rng([zlib.crc32(name.encode()), seed])


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
    records = spread([record for record in records if record["id"] in chosen], limit)
    return [_pair(name, folder, record) for record in records]


def ids_of_half(ids: Iterable[str], half: str) -> set[str]:
    """Which pairs belong to a half of `HALVES`, by their ids alone: sorted by CRC-32, they alternate."""
    if half not in HALVES:
        raise ValueError(f"half is {half!r}: expected one of {', '.join(HALVES)}")
    mixed = sorted(ids, key=lambda name: (zlib.crc32(name.encode()), name))
    return set({"dev": mixed[::2], "held-out": mixed[1::2], "all": mixed}[half])


def spread(items: list[Item], limit: int | None) -> list[Item]:
    """At most `limit` of them, spread evenly."""
    if limit is None or limit >= len(items):
        return items
    return [items[i] for i in np.linspace(0, len(items) - 1, limit).round().astype(int)]


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


def scene_points(view: View, stride: int = 4) -> Float64Array:
    """Every stride-th pixel that has depth, as Nx3 m in the view's frame."""
    if view.depth is None:
        raise ValueError("the view has no depth: expected an RGB-D view")
    z = view.depth[::stride, ::stride].astype(np.float64)
    v, u = np.mgrid[: view.depth.shape[0] : stride, : view.depth.shape[1] : stride].astype(np.float64)
    return (pixel_rays(view.K, u, v) * z[..., None])[np.isfinite(z)]


def disturbed(T: Float64Array, scene_points: Float64Array, rng: np.random.Generator) -> Float64Array:
    """The pose turned by exactly 1 deg about the centre of the scene and then moved by 0.12 m, in random directions.

    Turning about the scene keeps it in view, as the errors of real initialisers do: points move by about 0.12 m.

    Args:
        T: 4x4 T_target_source.
        scene_points: Nx3 m, source frame.
        rng: seed it with the pair's name, `rng_of(pair.id)`.
    """
    centre = transform(T, scene_points).mean(0)
    axis, direction = rng.normal(size=(2, 3))
    turn = Rotation.from_rotvec(axis / np.linalg.norm(axis) * np.radians(DISTURBANCE_DEG)).as_matrix()
    D = np.eye(4)
    D[:3, :3] = turn
    D[:3, 3] = centre - turn @ centre + direction / np.linalg.norm(direction) * DISTURBANCE_M
    return np.asarray(D @ T)


def disturbed_prior(pair: Pair, seed: int = 0) -> Prior:
    """`disturbed` truth with the covariance of disturbances of that size, in ROS order and meaning.

    A turn w about the scene centre c and a move v shift the source origin t (target frame) by v + w x (t - c).
    """
    points = pair.points if len(pair.points) else np.array([[0.0, 0.0, NOMINAL_RANGE_M]])
    start = disturbed(pair.T_target_source, points, rng_of(pair.id, seed))
    lever = start[:3, 3] - transform(start, points).mean(0)
    J = np.eye(6)
    J[:3, 3:] = -skew(lever)
    variances = np.repeat([DISTURBANCE_M**2 / 3, np.radians(DISTURBANCE_DEG) ** 2 / 3], 3)
    return Prior(start, J @ np.diag(variances) @ J.T, "given", "disturbed truth")


def with_monocular_depth(pair: Pair, seed: int = 0) -> Pair:
    """The pair with depth spoilt as a metric monocular network would, each view on its own; `points` stay true."""
    from bench.rooms import monocular_depth

    def spoilt(view: View, which: str) -> View:
        return dataclasses.replace(view, depth=monocular_depth(view.depth, rng_of(pair.id + which, seed)))

    return dataclasses.replace(pair, source=spoilt(pair.source, "/source"), target=spoilt(pair.target, "/target"))
