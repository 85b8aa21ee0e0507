# SPDX-License-Identifier: Apache-2.0
"""Verification of a weights file: its hash, content and network against its name; a new hash is recorded."""

from __future__ import annotations

from pathlib import Path

from garps_core.errors import WeightsError
from garps_core.weights.manifest import Weights, named
from garps_core.weights.reader import Tensors, read_tensors
from garps_core.weights.state_dict import kind_of, recognised
from garps_core.weights.store import Record, installed, record, recorded, weights_folder


def verify(name: str) -> str:
    """Check an installed file, record its hash if there is none yet, and describe the file in words.

    Raises:
        WeightsError: not installed, changed since it was recorded, damaged, or another network than its name says.
    """
    weights, folder = named(name), weights_folder()
    path = installed(name)
    if path is None:
        raise WeightsError(f"{name} is not installed: expected {folder / weights.local}")
    known = recorded(path, folder)
    found = examined(path, weights, folder)
    if known is not None:
        return f"sha256 {found.sha256[:12]}... as recorded ({known.source})"
    record(folder, path.name, Record(found.sha256, path.stat().st_size, "first verification"))
    return f"sha256 {found.sha256[:12]}... recorded now: from here on it must stay the same"


def examined(path: Path, weights: Weights, folder: Path) -> Tensors:
    """Read a file as these weights: size, hash and the network that its names tell of must be theirs."""
    limit = weights.bytes if weights.bytes is not None else weights.bytes_bound
    found = read_tensors(path, folder=folder, max_bytes=limit, sha256=weights.sha256, kind=weights.kind)
    kind = kind_of(found.tensors)
    if kind != weights.kind and not (kind == "" and weights.kind.startswith("ade20k") and _is_head(found)):
        raise WeightsError(
            f"{path} holds {recognised(found.tensors)}: expected {weights.kind}, as {weights.name} is. Fetch it again"
        )
    return found


def _is_head(found: Tensors) -> bool:
    return "decode_head.conv_seg.weight" in found.tensors
