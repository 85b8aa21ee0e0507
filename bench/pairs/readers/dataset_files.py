# SPDX-License-Identifier: Apache-2.0
"""Files as all readers read them: bounded text, poses, images; missing files are listed, never guessed."""

from __future__ import annotations

import zipfile
import zlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from typing import Any, TypeVar

import cv2
import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import Rotation

from bench.pairs.pair import Pair, scene_points, spread
from garps_core.checks import Float32Array, Float64Array, checked_rigid
from garps_core.geometry import so3_log
from garps_core.types import View

Item = TypeVar("Item")
Rgb = npt.NDArray[np.uint8]
MAX_BYTES = 64 * 2**20
SHOWN = 3
SMALL_M = 0.3
SMALL_DEG = 15.0
ROUNDING = 1e-9


class MissingFiles(ValueError):
    """Files that are not there.

    Args:
        files: all of them; the message names the first few.
        layout: what was expected to be where, one line.
    """

    def __init__(self, files: Sequence[Path], layout: str) -> None:
        self.files = tuple(dict.fromkeys(files))
        more = f" and {len(self.files) - SHOWN} more" if len(self.files) > SHOWN else ""
        shown = ", ".join(map(str, self.files[:SHOWN]))
        super().__init__(f"{len(self.files)} missing: {shown}{more}; expected {layout}")


@dataclass(frozen=True, eq=False)
class Candidate:
    """A pair by name, the files it needs, and what reads them."""

    id: str
    files: tuple[Path, ...]
    make: Callable[[], Pair]


def gathered(candidates: list[Candidate], layout: str, limit: int | None, skipped: list[str] | None) -> list[Pair]:
    """Read the pairs, at most `limit`, spread evenly.

    Args:
        candidates: in the order of the data set.
        layout: what was expected, for errors.
        limit: None = all.
        skipped: None = every file must be there; a list = pairs with missing files are left out and named in it.
    Raises:
        MissingFiles: see `skipped`.
        ValueError: nothing to read, or a file that is not what it should be.
    """
    if not candidates:
        raise ValueError(f"no pairs found: expected {layout}")
    if skipped is None:
        candidates = spread(candidates, limit)
    absent = [[file for file in candidate.files if not file.is_file()] for candidate in candidates]
    if skipped is None and any(absent):
        raise MissingFiles([file for files in absent for file in files], layout)
    if skipped is not None:
        skipped += [f"{pair.id}: {gone[0]}" for pair, gone in zip(candidates, absent, strict=True) if gone]
    there = [candidate for candidate, gone in zip(candidates, absent, strict=True) if not gone]
    return [candidate.make() for candidate in spread(there, limit)]


def require(layout: str, *files: Path) -> None:
    """Raise MissingFiles unless all of them are there."""
    if absent := [file for file in files if not file.is_file()]:
        raise MissingFiles(absent, layout)


def pair_of(name: str, pair_id: str, source: View, target: View, T: Float64Array, scale: str = "metres") -> Pair:
    """The pair, its category and, where the source has depth, its points."""
    points = scene_points(source) if source.depth is not None else np.zeros((0, 3))
    return Pair(name, pair_id, category_of(T), source, target, T, points, scale)


def category_of(T: Float64Array) -> str:
    """ "small" for at most 0.3 (m, or the unit of the translation) and 15 deg, otherwise "large"."""
    degrees = float(np.degrees(np.linalg.norm(so3_log(T[:3, :3]))))
    near = float(np.linalg.norm(T[:3, 3])) <= SMALL_M + ROUNDING and degrees <= SMALL_DEG + ROUNDING
    return "small" if near else "large"


def chosen(items: Sequence[Item], count: int, rng: np.random.Generator) -> list[Item]:
    """At most `count` of them at random, in their own order."""
    picks = rng.permutation(len(items))[:count]
    return [items[k] for k in sorted(picks.tolist())]


def frame_gaps(lengths: dict[Item, int], gap: int) -> list[tuple[Item, int]]:
    """Every (sequence, first frame) that has a frame `gap` later, by the number of frames of each sequence."""
    if gap < 1:
        raise ValueError(f"gap is {gap}: expected at least 1 frame")
    return [(name, i) for name, length in lengths.items() for i in range(length - gap)]


def text_of(path: Path) -> str:
    """A text file, at most 64 MB."""
    bounded(path)
    try:
        return path.read_text(encoding="utf-8")
    except UnicodeDecodeError:
        raise ValueError(f"{path}: no UTF-8 text") from None


def bounded(path: Path) -> None:
    """Raise ValueError if a file is over 64 MB."""
    if (size := path.stat().st_size) > MAX_BYTES:
        raise ValueError(f"{path}: {size / 2**20:.0f} MB, expected at most {MAX_BYTES // 2**20}")


def rows(path: Path, header: int = 0) -> list[tuple[str, list[str]]]:
    """The words of each line and where it is, "file:line"; without the header, blank lines and comments (#)."""
    lines = enumerate(text_of(path).splitlines()[header:], 1 + header)
    words = [(f"{path}:{number}", line.split()) for number, line in lines]
    return [(where, line) for where, line in words if line and not line[0].startswith("#")]


def floats(where: str, words: Sequence[str], columns: str) -> Float64Array:
    """Finite numbers, as many as `columns` has words."""
    if len(words) != len(columns.split()):
        raise ValueError(f"{where}: {len(words)} columns, expected {len(columns.split())}: {columns}")
    try:
        values = np.array([float(word) for word in words])
    except ValueError as error:
        raise ValueError(f"{where}: {error}; expected numbers: {columns}") from None
    if not np.isfinite(values).all():
        raise ValueError(f"{where}: NaN or infinity, expected finite numbers: {columns}")
    return values


def matrix(path: Path) -> Float64Array:
    """A text file with four rows of four numbers."""
    lines = rows(path)
    if len(lines) != 4:
        raise ValueError(f"{path}: {len(lines)} rows, expected a 4x4 matrix")
    return np.stack([floats(where, words, "m0 m1 m2 m3") for where, words in lines])


def rigid(where: object, T: Any) -> Float64Array:
    """4x4 rigid motion; the error names the place."""
    try:
        return checked_rigid("pose", T)
    except ValueError as error:
        raise ValueError(f"{where}: {error}") from None


def quaternion_pose(where: str, xyzw: Float64Array, t: Float64Array) -> Float64Array:
    """4x4 from a quaternion (x, y, z, w) of about unit length and a translation."""
    length = float(np.linalg.norm(xyzw))
    if abs(length - 1) > 0.01:
        raise ValueError(f"{where}: quaternion of length {length:.3g}, expected 1; zeros stand for a withheld truth")
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = Rotation.from_quat(xyzw).as_matrix(), t
    return T


def pinhole(fx: float, fy: float, cx: float, cy: float) -> Float64Array:
    """3x3 K, pixels."""
    return np.array([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]])


def inside(folder: Path, relative: str, where: str) -> Path:
    """A file below the folder. Raises ValueError for a path that leads out of it."""
    path = PurePosixPath(relative)
    if path.is_absolute() or ".." in path.parts or "\0" in relative or not path.parts:
        raise ValueError(f"{where}: path {relative!r}, expected one below the data set's folder")
    return folder / path


def image(path: Path) -> Rgb:
    """HxWx3 uint8, red first."""
    bgr = cv2.imread(str(path), cv2.IMREAD_COLOR)
    if bgr is None:
        raise ValueError(f"{path}: no image that can be read")
    return np.asarray(cv2.cvtColor(bgr, cv2.COLOR_BGR2RGB), np.uint8)


def depth_map(path: Path, units_per_metre: float = 1000.0, none: int = 0) -> Float32Array:
    """A 16-bit PNG -> HxW float32 metres; 0 and `none` = no reading, NaN."""
    stored = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
    if stored is None or stored.dtype != np.uint16 or stored.ndim != 2:
        raise ValueError(f"{path}: expected a 16-bit image of one channel")
    known = (stored > 0) & (stored != none)
    return np.where(known, stored / np.float32(units_per_metre), np.float32("nan")).astype(np.float32)


def view(path: Path, rgb: Rgb, K: Float64Array, depth: Float32Array | None = None) -> View:
    """A view; the error names the image."""
    try:
        return View(rgb, K, depth)
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from None


def arrays(path: Path) -> dict[str, npt.NDArray[Any]]:
    """The arrays of an .npz file, unpacked at most 64 MB, without pickled objects."""
    bounded(path)
    try:
        with zipfile.ZipFile(path) as archive:
            if sum(member.file_size for member in archive.infolist()) > MAX_BYTES:
                raise ValueError(f"more than {MAX_BYTES // 2**20} MB unpacked")
        with np.load(path, allow_pickle=False) as stored:
            return {name: stored[name] for name in stored.files}
    except (ValueError, EOFError, MemoryError, RuntimeError, zlib.error, zipfile.BadZipFile) as error:
        raise ValueError(f"{path}: {error}; expected an .npz file of plain arrays") from None
