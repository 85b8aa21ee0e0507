# SPDX-License-Identifier: Apache-2.0
"""Safe reader of weights files: tensors from a file that is not trusted. No other module of the packages opens one.

A torch file is a pickle, which can run any code when it is opened carelessly. Here nothing but tensors and plain values
is ever built from it (`weights_only=True`), there is no other way to fall back to, and sizes are bounded beforehand.
"""

from __future__ import annotations

import argparse
import hashlib
import os
import re
import stat
import tempfile
import zipfile
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from safetensors import safe_open
from safetensors.torch import save_file

from garps_core.errors import WeightsError
from garps_core.weights.manifest import NEEDS_NAMESPACE
from garps_core.weights.store import CHECKSUMS, recorded, weights_folder

MAX_BYTES = 8 * 2**30
"""Default bound of a file in bytes, above the largest known network."""
MAX_HEADER = 32 * 2**20
MAX_ENTRIES = 200_000
MAX_PICKLE = 64 * 2**20
_CHUNK = 2**22
_SAFE_TORCH = (2, 6)  # before, weights_only=True could be led to run code (CVE-2025-32434)
_ZIP = b"PK\x03\x04"
_WRAPPERS = ("model", "state_dict", "model_state_dict")
_METADATA = re.compile(r"(_metadata|args|config|epoch|iteration|meta|optimi[sz]er\w*|scaler|scheduler|step|version)")


@dataclass(frozen=True)
class Tensors:
    """Content of a weights file.

    Attributes:
        tensors: on the CPU, as stored; they may share memory with the file: copy before changing one.
        metadata: text beside them: of a safetensors file its own, of a torch file its plain values and `wrapper`.
        sha256: of the file, 64 hexadecimal digits.
    """

    tensors: dict[str, torch.Tensor]
    metadata: dict[str, str]
    sha256: str


def read_tensors(
    path: Path,
    *,
    folder: Path | None = None,
    max_bytes: int = MAX_BYTES,
    sha256: str | None = None,
    kind: str | None = None,
) -> Tensors:
    """Read a torch (zip) or safetensors file; which one its content says, not its name.

    Args:
        path: a regular file. If it lies in the weights folder, so must what a symbolic link there leads to, and a
            checksum recorded there is checked.
        folder: the weights folder; None = the usual one.
        max_bytes: larger files are refused unread.
        sha256: the expected hash; None = the recorded one, if any.
        kind: the network (`manifest.Weights.kind`): says whether an argparse.Namespace is to be expected.
    Raises:
        WeightsError: missing, not a regular file, too large, another hash, damaged, or holding anything but tensors.
    """
    folder = weights_folder() if folder is None else folder
    real = regular_file(path, folder)
    before = real.stat()
    if before.st_size > max_bytes:
        raise WeightsError(
            f"{path} has {before.st_size} bytes: expected at most {max_bytes}. Is it the file that was meant?"
        )
    found = hash_of(real)
    known = recorded(path, folder)
    expected = sha256 or (known.sha256 if known else None)
    if expected is not None and found != expected:
        raise WeightsError(
            f"{path} has sha256 {found}: expected {expected}; it is damaged or another file: fetch it again, or, if "
            f"you replaced it on purpose, remove its entry from {folder / CHECKSUMS}"
        )
    tensors, metadata = _parsed(path, real, kind)
    for key, tensor in tensors.items():
        _check_tensor(path, key, tensor)
    if sum(tensor.nbytes for tensor in tensors.values()) > 2 * before.st_size:
        raise WeightsError(
            f"{path} claims more data than it has: expected tensors with their values; not to be trusted"
        )
    after = real.stat()
    if (before.st_ino, before.st_size, before.st_mtime_ns) != (after.st_ino, after.st_size, after.st_mtime_ns):
        raise WeightsError(f"{path} changed while it was read: expected a finished file. Try again")
    return Tensors(tensors, metadata, found)


def regular_file(path: Path, folder: Path) -> Path:
    """Resolve a path to a regular file, which must lie inside the folder for a path in the folder."""
    try:
        real = path.resolve(strict=True)
        mode = real.stat().st_mode  # does not open it: opening a FIFO would wait for ever
    except (OSError, RuntimeError) as error:
        reason = getattr(error, "strerror", None) or error
        raise WeightsError(
            f"cannot read {path} ({reason}): expected a weights file. See `garps weights list`"
        ) from None
    if not stat.S_ISREG(mode):
        what = {stat.S_IFDIR: "a folder", stat.S_IFIFO: "a FIFO", stat.S_IFSOCK: "a socket"}
        found = what.get(stat.S_IFMT(mode), "a device")
        raise WeightsError(f"{path} is {found}: expected a regular file of weights")
    inside = path.absolute().is_relative_to(folder.absolute())
    if inside and not real.is_relative_to(folder.resolve()):
        raise WeightsError(f"{path} leads out of the weights folder, to {real}: expected a file in it. Copy it there")
    return real


def hash_of(path: Path) -> str:
    """SHA-256 of a regular file, 64 hexadecimal digits. WeightsError if it cannot be read."""
    digest = hashlib.sha256()
    try:
        with os.fdopen(os.open(path, os.O_RDONLY | os.O_CLOEXEC | os.O_NOFOLLOW | os.O_NONBLOCK), "rb") as stream:
            while chunk := stream.read(_CHUNK):
                digest.update(chunk)
    except OSError as error:
        raise WeightsError(f"cannot read {path} ({error.strerror}): expected a file that this user may read") from None
    return digest.hexdigest()


def write_tensors(path: Path, tensors: Mapping[str, torch.Tensor], metadata: Mapping[str, str]) -> None:
    """Write a safetensors file, whole or not at all; an existing one is replaced. WeightsError if that fails."""
    try:
        with tempfile.TemporaryDirectory(dir=path.absolute().parent, prefix=".garps-") as place:
            written = Path(place) / "new.safetensors"
            save_file({key: tensor.contiguous() for key, tensor in tensors.items()}, written, dict(metadata))
            written.replace(path)
    except OSError as error:
        raise WeightsError(f"cannot write {path} ({error.strerror or error}): expected a folder that can be") from None


def _parsed(path: Path, real: Path, kind: str | None) -> tuple[dict[str, torch.Tensor], dict[str, str]]:
    with real.open("rb") as stream:
        start = stream.read(8)
    if start[:4] == _ZIP:
        return _of_torch_file(path, real, kind)
    if start[:1] == b"\x80" and start[1:2] <= b"\x05":
        raise WeightsError(
            f"{path} is a bare pickle, as torch wrote before 1.6: not opened, since it can run code; expected a torch "
            "zip or safetensors file from the authors"
        )
    return _of_safetensors(path, real, int.from_bytes(start, "little") if len(start) == 8 else 0)


def _of_safetensors(path: Path, real: Path, header: int) -> tuple[dict[str, torch.Tensor], dict[str, str]]:
    room = min(MAX_HEADER, real.stat().st_size - 8)
    with real.open("rb") as stream:
        stream.seek(8)
        begins_well = stream.read(1) == b"{"
    if not (2 <= header <= room and begins_well):
        raise WeightsError(
            f"{path} is neither a torch zip file nor safetensors (header of {header} bytes, expected 2 to {room}): "
            "truncated or another kind of file. Fetch it again"
        )
    try:
        with safe_open(real, framework="pt", device="cpu") as opened:
            metadata = dict(opened.metadata() or {})
            return {key: opened.get_tensor(key) for key in opened.keys()}, metadata  # noqa: SIM118 (not a mapping)
    except Exception as error:  # its own class of error, and whatever else a hostile file provokes
        raise WeightsError(f"{path} is no sound safetensors file ({error}): damaged. Fetch it again") from None


def _of_torch_file(path: Path, real: Path, kind: str | None) -> tuple[dict[str, torch.Tensor], dict[str, str]]:
    version = tuple(int(number) for number in re.findall(r"\d+", torch.__version__)[:2])
    if version < _SAFE_TORCH:
        raise WeightsError(
            f"{path} is a torch file, which torch {torch.__version__} may not open safely (CVE-2025-32434): expected "
            "torch 2.6 or newer; or convert it elsewhere with `garps weights convert`"
        )
    _check_zip(path, real)
    try:
        with real.open("rb") as stream, torch.serialization.safe_globals(_allowed(kind)):
            misnamed = real.suffix == ".safetensors"  # newer torch believes the name of a path, and maps paths only
            given = stream if misnamed else real
            content = torch.load(given, map_location="cpu", weights_only=True, mmap=not misnamed)
    except Exception as error:  # whatever a hostile file provokes
        raise WeightsError(f"{path} {_why(error)}") from None
    return _unwrapped(path, content)


def _allowed(kind: str | None) -> list[Any]:
    return [argparse.Namespace] if kind in NEEDS_NAMESPACE else []


_ODD = re.compile(r"(?:GLOBAL|class) ([\w.]+)")


def _why(error: Exception) -> str:
    """The reason why torch stopped, in a few words; never its advice to load the file without protection."""
    odd = _ODD.search(str(error))
    if odd is None:
        return f"is no sound torch file ({type(error).__name__}): truncated or damaged; fetch it again"
    return (
        f"holds an object of class {odd[1]}: expected tensors only, so nothing of it was loaded; take the authors' "
        "file, best as safetensors"
    )


def _check_zip(path: Path, real: Path) -> None:
    """A torch file stores its entries uncompressed, so that none can be larger than the file."""
    size = real.stat().st_size
    if _directory_bytes(real) > MAX_HEADER:
        raise WeightsError(f"{path} has a directory of over {MAX_HEADER} bytes: not a file that torch wrote")
    try:
        with zipfile.ZipFile(real) as archive:
            entries = archive.infolist()
    except Exception as error:  # BadZipFile, and what else a damaged directory provokes
        raise WeightsError(f"{path} is no sound torch file ({error}): truncated or damaged. Fetch it again") from None
    unpacked = sum(entry.file_size for entry in entries)
    packed = any(entry.compress_type != zipfile.ZIP_STORED for entry in entries)
    if packed or unpacked > size or len(entries) > MAX_ENTRIES:
        raise WeightsError(
            f"{path} is a zip file of {size} bytes that unpacks to {unpacked} in {len(entries)} parts: expected at "
            f"most {MAX_ENTRIES}, none compressed, as torch.save writes; TorchScript and the like are not opened"
        )
    pickles = [entry.file_size for entry in entries if entry.filename.endswith(".pkl")]
    if max(pickles, default=0) > MAX_PICKLE:
        raise WeightsError(
            f"{path} has an index of {max(pickles)} bytes: expected at most {MAX_PICKLE}; not to be trusted"
        )


def _directory_bytes(real: Path) -> int:
    """Size of a zip file's directory as its last bytes say; `zipfile` reads it whole, however large."""
    with real.open("rb") as stream:
        stream.seek(-min(real.stat().st_size, 2**16 + 22 + 76), os.SEEK_END)  # comment, end, and end of a 64-bit one
        tail = stream.read()
    end = tail.rfind(b"PK\x05\x06")
    if end >= 76 and tail[end - 20 : end - 16] == b"PK\x06\x07":
        return int.from_bytes(tail[end - 36 : end - 28], "little")
    return int.from_bytes(tail[end + 12 : end + 16], "little") if end >= 0 else 0


def _unwrapped(path: Path, content: Any) -> tuple[dict[str, torch.Tensor], dict[str, str]]:
    metadata: dict[str, str] = {}
    if isinstance(content, Mapping):
        for wrapper in _WRAPPERS:
            if isinstance(content.get(wrapper), Mapping):
                metadata = {str(k): str(v) for k, v in content.items() if isinstance(v, (str, int, float))}
                metadata["wrapper"] = wrapper
                content = content[wrapper]
                break
    if not isinstance(content, Mapping) or not content:
        raise WeightsError(f"{path} holds {_described(content)}: expected tensors by name (a state dict)")
    tensors = {}
    for key, value in content.items():
        if isinstance(key, str) and isinstance(value, torch.Tensor):
            tensors[key] = value.detach()
        elif not (isinstance(key, str) and _METADATA.fullmatch(key)):
            raise WeightsError(f"{path} holds {_described(value)} under {key!r:.100}: expected tensors by name")
    return tensors, metadata


def _described(value: object) -> str:
    if isinstance(value, Mapping):
        return "nothing" if not value else f"a mapping of {', '.join(str(key) for key in list(value)[:3])} ..."
    return f"an object of class {type(value).__name__}"


def _check_tensor(path: Path, key: str, tensor: torch.Tensor) -> None:
    plain = tensor.layout == torch.strided and tensor.device.type == "cpu" and not tensor.is_quantized
    if not plain:
        raise WeightsError(
            f"{path} holds {key!r:.100} as {tensor.dtype}, {tensor.layout}, on {tensor.device}: expected a plain tensor"
        )
    if tensor.nbytes > tensor.untyped_storage().nbytes():
        raise WeightsError(f"{path} holds {key!r:.100} with more values than data: not to be trusted")
