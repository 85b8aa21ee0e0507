# SPDX-License-Identifier: Apache-2.0
"""Read the weights that settings name: by the name of `garps weights list`, by a file, or the first installed ones."""

from __future__ import annotations

import logging
from pathlib import Path

from garps_core.errors import WeightsError
from garps_core.weights.manifest import BY_NAME, PERMISSIVE, licence_of, named
from garps_core.weights.reader import Tensors, read_tensors
from garps_core.weights.store import default, installed

LOG = logging.getLogger("garps_core")


def load_weights(weights: str, kind: str, variant: str = "") -> tuple[Path, Tensors]:
    """Return path and content of weights; a licence that does not permit everything is logged as a warning.

    Args:
        weights: a name of the manifest or a file; "" = the first that is installed.
        kind: the network, as in `Weights.kind`.
        variant: as in `Weights.variant`; used where `weights` is empty.
    Raises:
        WeightsError: not installed, unreadable, not trustworthy, or weights of another network.
    """
    path, found = _read(weights, kind, variant)
    licence = licence_of(path.name, found.metadata, kind)
    if licence not in PERMISSIVE:
        LOG.warning("licence of the weights %s: %s", path.name, licence)
    return path, found


def _read(weights: str, kind: str, variant: str) -> tuple[Path, Tensors]:
    name = weights or default(kind, variant).name
    if name not in BY_NAME:
        path = Path(weights).expanduser()
        if path.suffix not in (".pth", ".pt", ".safetensors"):
            named(name)  # raises, with the nearest names
        return path, read_tensors(path, kind=kind)
    entry, there = named(name), installed(name)
    if entry.kind != kind:
        raise WeightsError(f"{name} are weights of {entry.kind}: expected some of {kind}. See `garps weights list`")
    if there is None:
        raise WeightsError(f"{name} is not installed: run `garps weights fetch {name}`, or name another file")
    return there, read_tensors(there, max_bytes=entry.bytes or entry.bytes_bound, sha256=entry.sha256, kind=kind)
