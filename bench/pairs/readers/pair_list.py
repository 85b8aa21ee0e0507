# SPDX-License-Identifier: Apache-2.0
"""The pair-list file: which two frames of which clip, with everything a benchmark needs to know about them.

One JSON object per line, with the fields of `Record`. Once written, the list and nothing else is evaluated, so that
two runs are about the same pairs. Images are named relative to the folder of the data set.
"""

from __future__ import annotations

import functools
import json
import math
from collections.abc import Iterable
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from typing import Any

import numpy as np

from bench.pairs.pair import Pair
from bench.pairs.readers.dataset_files import (
    Candidate,
    category_of,
    gathered,
    image,
    inside,
    pair_of,
    require,
    text_of,
    view,
)
from garps_core.checks import Float64Array, checked_intrinsics, checked_rigid
from garps_core.types import View

RAW = "raw"
LIST_FILE = "pairs.jsonl"


@dataclass(frozen=True, eq=False)
class Record:
    """One line of the list.

    Args:
        clip: name of the clip.
        i, j: numbers of the two frames in it, from 0.
        image0, image1: files of source and target, relative to the data set's folder.
        size0, size1: width and height of the images that K0 and K1 hold for.
        K0, K1: 3x3 px, pixel centres at integers.
        T_1_0: 4x4, source camera to target camera, translation in the clip's own unit.
        scale: the translation times this is the truth.
        scale_source: where that factor comes from: "raw" (it is 1), or for instance "sfm-depth".
        category: "small" or "large", of the scaled translation.
        seed: what the choice was made with.
    Raises:
        ValueError: a field that cannot be what it claims to be.
    """

    clip: str
    i: int
    j: int
    image0: str
    image1: str
    size0: tuple[int, int]
    size1: tuple[int, int]
    K0: Float64Array
    K1: Float64Array
    T_1_0: Float64Array
    scale: float
    scale_source: str
    category: str
    seed: int

    def __post_init__(self) -> None:
        for name in ("clip", "image0", "image1", "scale_source"):
            _expect(name, getattr(self, name), "text", lambda value: isinstance(value, str) and value != "")
        for name in ("i", "j", "seed"):
            _expect(name, getattr(self, name), "a number from 0", _is_count)
        for name in ("size0", "size1"):
            _expect(name, getattr(self, name), "[width, height]", _is_size)
            object.__setattr__(self, name, tuple(getattr(self, name)))
        for name in ("image0", "image1"):
            inside(Path(), getattr(self, name), name)
        object.__setattr__(self, "K0", checked_intrinsics(self.K0))
        object.__setattr__(self, "K1", checked_intrinsics(self.K1))
        object.__setattr__(self, "T_1_0", checked_rigid("T_1_0", self.T_1_0))
        _expect("scale", self.scale, "a positive number, 1 for raw", self._is_scale)
        _expect("category", self.category, repr(category_of(self.T_target_source)), category_of(self.T_target_source))

    def _is_scale(self, value: Any) -> bool:
        number = isinstance(value, (int, float)) and not isinstance(value, bool)
        return number and math.isfinite(value) and value > 0 and (value == 1 or self.scale_source != RAW)

    @property
    def id(self) -> str:
        """Name of the pair."""
        return f"{self.clip}/{self.i}-{self.j}"

    @property
    def T_target_source(self) -> Float64Array:
        """4x4, the truth: T_1_0 with its translation scaled."""
        T = self.T_1_0.copy()
        T[:3, 3] *= self.scale
        return T

    @property
    def scale_text(self) -> str:
        """The text for `Pair.scale`: "raw", or "sfm-depth x1.234"."""
        return self.scale_source if self.scale_source == RAW else f"{self.scale_source} x{self.scale:.4g}"


def _is_count(value: Any) -> bool:
    return isinstance(value, int) and not isinstance(value, bool) and value >= 0


def _is_size(value: Any) -> bool:
    return isinstance(value, (list, tuple)) and len(value) == 2 and all(_is_count(side) and side > 0 for side in value)


def _expect(name: str, value: Any, expected: str, allowed: Any) -> None:
    """Raise ValueError unless `allowed` is the value, or says yes to it."""
    if not (allowed(value) if callable(allowed) else value == allowed):
        raise ValueError(f"{name} is {str(value)[:60]!r}: expected {expected}")


def write(path: Path, records: Iterable[Record]) -> None:
    """Write the list. Raises ValueError if there is one already: it may have been evaluated."""
    if path.exists():
        raise ValueError(f"{path} exists: a list is written once; remove it to choose anew")
    lines = [json.dumps(asdict(record), default=np.ndarray.tolist) for record in records]
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")


def read_list(path: Path) -> list[Record]:
    """Read the list. Raises ValueError, one line with file and line number."""
    found: dict[str, Record] = {}
    for number, line in enumerate(text_of(path).splitlines(), 1):
        if not line.strip():
            continue
        try:
            record = _record(json.loads(line))
            if record.id in found:
                raise ValueError(f"{record.id} is there twice")
        except (ValueError, OverflowError, RecursionError) as error:
            raise ValueError(f"{path}:{number}: {error}") from None
        found[record.id] = record
    return list(found.values())


def _record(stored: Any) -> Record:
    names = [field.name for field in fields(Record)]
    if not isinstance(stored, dict) or set(stored) != set(names):
        given = sorted(set(stored) ^ set(names)) if isinstance(stored, dict) else type(stored).__name__
        raise ValueError(f"expected an object with {', '.join(names)}; differs in {given}")
    return Record(**stored)


def read(
    folder: Path,
    *,
    limit: int | None = None,
    skipped: list[str] | None = None,
    list_file: str = LIST_FILE,
    name: str = "pair-list",
) -> list[Pair]:
    """The pairs of a list.

    Args:
        folder: of the data set.
        limit: largest number of pairs, spread evenly; None = all.
        skipped: a list to name pairs with missing images in, instead of raising.
        list_file: the list, relative to the folder.
        name: of the set.
    Raises:
        MissingFiles: the list, or images.
        ValueError: a damaged list, or images that are not of its size.
    """
    layout = f"{list_file} and the images it names"
    require(layout, folder / list_file)
    view_of = functools.cache(_view)

    def made(record: Record) -> Pair:
        source = view_of(folder / record.image0, record.size0, tuple(record.K0.ravel()))
        target = view_of(folder / record.image1, record.size1, tuple(record.K1.ravel()))
        return pair_of(name, record.id, source, target, record.T_target_source, record.scale_text)

    candidates = [
        Candidate(record.id, (folder / record.image0, folder / record.image1), functools.partial(made, record))
        for record in read_list(folder / list_file)
    ]
    return gathered(candidates, layout, limit, skipped)


def _view(path: Path, size: tuple[int, int], k: tuple[float, ...]) -> View:
    rgb = image(path)
    if rgb.shape[1::-1] != size:
        raise ValueError(f"{path}: {rgb.shape[1]}x{rgb.shape[0]}, but the pair list was made for {size[0]}x{size[1]}")
    return view(path, rgb, np.array(k).reshape(3, 3))
