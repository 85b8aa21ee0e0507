# SPDX-License-Identifier: Apache-2.0
"""Two-view adapters as an installed package has them: one with the maps of a file, and those that go wrong.

Light to import, since the node does: it finds them by the metadata that `installed_package` writes.
"""

from dataclasses import fields
from pathlib import Path
from typing import Any

import numpy as np

from garps_core.errors import ModelError, WeightsError
from garps_core.models.mast3r import digest
from garps_core.point_maps import Framing, PairMaps, Picture, PointMap

RECORDED = "recorded"
"""Adapter whose weights are a file by `write_maps`."""
CALLS: list[str] = []
"""One entry for every time that any adapter was asked."""


def installed_package(folder: Path, name: str, entries: dict[str, str]) -> Path:
    """Write what `pip install` of a package leaves: its metadata, with two-view adapters NAME = package.module:load."""
    place = folder / f"{name}-1.0.dist-info"
    place.mkdir(parents=True)
    (place / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {name}\nVersion: 1.0\n", encoding="utf-8")
    lines = ["[garps_core.two_view]", *(f"{key} = {value}" for key, value in entries.items()), ""]
    (place / "entry_points.txt").write_text("\n".join(lines), encoding="utf-8")
    return folder


def installed_here(folder: Path) -> Path:
    """The adapters of this module, all of them."""
    names = [RECORDED, *FAULTS, "without_weights", "without_memory"]
    entries = {name: f"{__name__}:{name}" for name in names}
    missing = {"not_there": "no_such_package.two_view:load", "misspelt": f"{__name__}:laod"}
    return installed_package(folder, "made_adapters", entries | missing)


def write_maps(path: Path, *known: tuple[Picture, Picture, PairMaps]) -> Path:
    """Write the answers of `recorded` about pairs of pictures, source and target."""
    held: dict[str, Any] = {}
    for source, target, maps in known:
        key = (digest(source) + digest(target)).hex()
        held[f"{key}.framings"] = [[*f.scale, *f.offset, *f.size] for f in maps.framings]
        for i, one in enumerate((*maps.source_first, *maps.target_first)):
            held |= {f"{key}.{i}.points": one.points, f"{key}.{i}.confidence": one.confidence}
    np.savez(path, **held)
    return path


class Recorded:
    """Knows the pairs of a file."""

    def __init__(self, path: str) -> None:
        with np.load(path) as held:
            self._held = dict(held)

    def __call__(self, source: Picture, target: Picture) -> PairMaps:
        CALLS.append(RECORDED)
        key = (digest(source) + digest(target)).hex()
        if f"{key}.framings" not in self._held:
            raise LookupError("two pictures it has never seen")
        one, two, three, four = (
            PointMap(*(self._held[f"{key}.{i}.{field.name}"] for field in fields(PointMap)[:2])) for i in range(4)
        )
        a, b = (
            Framing((w[0], w[1]), (w[2], w[3]), (int(w[4]), int(w[5]))) for w in self._held[f"{key}.framings"].tolist()
        )
        return PairMaps((one, two), (three, four), (a, b), metric=True, origin=RECORDED)


def recorded(weights: str, device: str) -> Recorded:
    """Load the adapter `recorded`."""
    return Recorded(weights)


def _points(rows: int = 32, columns: int = 48, dtype: Any = np.float32) -> PointMap:
    return PointMap(np.ones((rows, columns, 3), dtype), np.full((rows, columns), 10, dtype))


def _maps(*sizes: int) -> PairMaps:
    one, framing = _points(*sizes), Framing((0.3, 0.3), (0, 0), (32, 48))
    return PairMaps((one, one), (one, one), (framing, framing), True, "made")


def _raises() -> None:
    raise RuntimeError("the battery is empty")


FAULTS = {
    "raising": (_raises, "(RuntimeError: the battery is empty)"),
    "out_of_memory": (lambda: (_ for _ in ()).throw(ModelError("out of memory")), "(out of memory)"),
    "misshapen": (lambda: PointMap(np.ones((32, 48), np.float32), np.ones((32, 48), np.float32)), "of 32x48 float32"),
    "two_sizes": (lambda: _maps(32, 40), "expected [(32, 48), (32, 48)], its framings'"),
    "doubles": (lambda: _points(dtype=np.float64), "of 32x48x3 float64, 32x48 float64: expected points hxwx3"),
    "tensors": (lambda: _tensors(), "expected points hxwx3, confidence hxw, of one size, numpy float32"),
    "unsure_of_all": (lambda: PointMap(_points().points, np.full((32, 48), np.nan, np.float32)), "is not finite"),
    "forgetful": (lambda: None, "returned an object of class NoneType: expected PairMaps"),
    "pair_of_points": (lambda: (_points(), _points()), "returned an object of class tuple: expected PairMaps"),
}
"""Adapters that fail when they are asked -> how, and what is said of it."""


def _tensors() -> Any:
    import torch

    return PointMap(torch.ones(32, 48, 3), torch.ones(32, 48))  # type: ignore[arg-type]


def _failing(name: str) -> Any:
    def answer(source: Picture, target: Picture) -> Any:
        CALLS.append(name)
        return FAULTS[name][0]()

    return lambda weights, device: answer


globals().update({name: _failing(name) for name in FAULTS})


def without_weights(weights: str, device: str) -> None:
    """Raise an error of GARPS."""
    raise WeightsError(f"no weights in {weights}: expected my.pth")


def without_memory(weights: str, device: str) -> None:
    """Fails as a library does."""
    raise RuntimeError("CUDA error: out of memory")
