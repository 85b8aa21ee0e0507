# SPDX-License-Identifier: Apache-2.0
"""The folder of the weights files, and the checksums recorded in it on first use."""

from __future__ import annotations

import json
import os
import re
import tempfile
from dataclasses import asdict, dataclass
from pathlib import Path

from garps_core.errors import WeightsError
from garps_core.weights.manifest import ALL, Weights, named

CHECKSUMS = "checksums.json"
_MAX_BYTES = 2**20  # of that file


@dataclass(frozen=True)
class Record:
    """State of a file at its first use: hash (64 hex digits), size in bytes, and origin."""

    sha256: str
    bytes: int
    source: str


def weights_folder() -> Path:
    """`$GARPS_WEIGHTS`, else `garps/weights` below `$XDG_DATA_HOME` (~/.local/share); it need not exist."""
    chosen = os.environ.get("GARPS_WEIGHTS")
    if chosen:
        return Path(chosen).expanduser().absolute()
    data = os.environ.get("XDG_DATA_HOME", "")
    # The XDG specification: a relative path there is invalid and ignored.
    base = Path(data) if Path(data).is_absolute() else Path.home() / ".local" / "share"
    return base / "garps" / "weights"


def installed(name: str) -> Path | None:
    """Path of the file of that name in the weights folder, None = not there. WeightsError for a name nobody knows."""
    path = weights_folder() / named(name).local
    return path if path.exists() else None


def default(kind: str, variant: str = "") -> Weights:
    """The first installed weights of that kind (and variant, where given), the freest licence and smallest first.

    Raises:
        WeightsError: none is installed; the text says how to get one.
    """
    known = [weights for weights in ALL if weights.kind == kind and variant in ("", weights.variant)]
    if not known:
        raise WeightsError(f"no weights are of kind {kind!r} {variant}: expected one of {', '.join(sorted(kinds()))}")
    for weights in known:
        if installed(weights.name) is not None:
            return weights
    first = known[0]
    how = f"run `garps weights fetch {first.name}`" if first.repo else f"download it from {first.url}"
    raise WeightsError(f"no {kind} weights in {weights_folder()}: expected e.g. {first.local}; {how}")


def kinds() -> set[str]:
    """Every kind of network that has weights."""
    return {weights.kind for weights in ALL}


def recorded(path: Path, folder: Path) -> Record | None:
    """Return the record of a file of the weights folder; None for one that is new, or elsewhere."""
    if path.absolute().parent != folder.absolute():
        return None
    return _records(folder).get(path.name)


def record(folder: Path, file: str, entry: Record) -> None:
    """Add or replace the record of one file, leaving the others. WeightsError if the folder cannot be written."""
    entries = {**_records(folder), file: entry}
    text = json.dumps({name: asdict(entries[name]) for name in sorted(entries)}, indent=1)
    try:
        handle, temporary = tempfile.mkstemp(dir=folder, prefix=".checksums-")
    except OSError as error:
        raise WeightsError(
            f"cannot write {folder / CHECKSUMS} ({error.strerror}): expected a folder that this user may write. "
            "Verify as the user it belongs to"
        ) from None
    try:
        with os.fdopen(handle, "w", encoding="utf-8") as stream:
            stream.write(text + "\n")
        Path(temporary).replace(folder / CHECKSUMS)
    except BaseException:
        Path(temporary).unlink(missing_ok=True)
        raise


def _records(folder: Path) -> dict[str, Record]:
    path = folder / CHECKSUMS
    try:
        if path.stat().st_size > _MAX_BYTES:
            raise WeightsError(f"{path} is larger than {_MAX_BYTES} bytes: expected a few checksums. Remove it")
        content = json.loads(path.read_text(encoding="utf-8"))
        found = {name: Record(**entry) for name, entry in content.items()}
    except FileNotFoundError:
        return {}
    except (OSError, ValueError, TypeError, AttributeError, RecursionError) as error:
        raise WeightsError(f"cannot read {path} ({error}): expected recorded checksums. Repair or remove it") from None
    for name, entry in found.items():
        if not (isinstance(entry.sha256, str) and re.fullmatch("[0-9a-f]{64}", entry.sha256)):
            raise WeightsError(f"{path} has no sha256 for {name}: expected 64 hexadecimal digits. Repair or remove it")
    return found
