# SPDX-License-Identifier: Apache-2.0
"""Readers of data sets: a name and a folder become pairs with the true pose.

To add a data set, write one file here, `read(folder, *, limit=None, skipped=None) -> list[Pair]`, and add one line to
`READERS`. `python -m bench.run --data NAME=FOLDER` then takes its name. `dataset_files` has what readers share.
Each reader's docstring gives the layout of its folder. Nothing is downloaded. Missing files are listed.
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from bench.pairs.pair import Pair
from bench.pairs.readers import mapfree, pair_list, realestate10k, scannet1500, seven_scenes, tum
from bench.pairs.readers.dataset_files import MissingFiles

__all__ = ["READERS", "MissingFiles", "load"]

READERS: Mapping[str, Callable[..., list[Pair]]] = {
    "mapfree": mapfree.read,
    "pair-list": pair_list.read,
    "realestate10k": realestate10k.read,
    "realestate10k-validation": functools.partial(realestate10k.read, split="validation"),
    "scannet1500": scannet1500.read,
    "seven_scenes": seven_scenes.read,
    "tum": tum.read,
}
"""Every reader takes a folder and, by name, `limit`, `skipped` and options of its own."""


def load(
    name: str, folder: Path, limit: int | None = None, skipped: list[str] | None = None, **options: Any
) -> list[Pair]:
    """The pairs of a data set.

    Args:
        name: of `READERS`.
        folder: where it lies, in the layout that the reader's module describes.
        limit: largest number of pairs, spread evenly; None = all.
        skipped: None = every file must be there; a list = pairs with missing files are left out and named in it.
        options: of the reader.
    Raises:
        MissingFiles: names the first few and how many, and the layout.
        ValueError: no such reader or folder, or a file that is not what it should be, with file and line.
    """
    if name not in READERS:
        raise ValueError(f"no reader {name!r}: expected one of {', '.join(READERS)}")
    if not folder.is_dir():
        raise ValueError(f"{folder} is no folder: expected one with the data set {name}")
    return READERS[name](folder, limit=limit, skipped=skipped, **options)
