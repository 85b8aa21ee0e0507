# SPDX-License-Identifier: Apache-2.0
"""MCAP files that were cut off: their whole records, presented as a file with a proper end.

A recorder that loses power leaves a file without index and footer, and a folder without metadata.yaml. The format is
made to be read anyway: records follow one another, each with its length (https://mcap.dev/spec).
"""

from __future__ import annotations

import io
import struct
from pathlib import Path
from typing import Any, BinaryIO

MAGIC = b"\x89MCAP0\r\n"
RECORD_HEAD = struct.Struct("<BQ")
FOOTER, DATA_END = 0x02, 0x0F
END = RECORD_HEAD.pack(FOOTER, 20) + bytes(20) + MAGIC
"""A footer without index, for which readers start at the first record."""


def salvageable(path: Path) -> Any:
    """Return a path or a `CutMcap` to open instead of a recording that cannot be opened, or None."""
    files = [path] if path.is_file() else sorted(path.glob("*.mcap"))
    if len(files) != 1 or files[0].suffix != ".mcap":
        return None
    end = _end_of_whole_records(files[0])
    if end is None:
        return files[0] if path.is_dir() else None
    return CutMcap(files[0], end)


def _end_of_whole_records(path: Path) -> int | None:
    """Return where the last whole data record ends, bytes; None when the file is not cut off or is no MCAP file."""
    size = path.stat().st_size
    with path.open("rb") as file:
        if file.read(len(MAGIC)) != MAGIC:
            return None
        end = file.tell()
        while len(head := file.read(RECORD_HEAD.size)) == RECORD_HEAD.size:
            kind, length = RECORD_HEAD.unpack(head)
            if kind in (FOOTER, DATA_END):
                return end if size < end + RECORD_HEAD.size + length or not _has_end(file, size) else None
            if end + RECORD_HEAD.size + length > size:
                break
            end = file.seek(length, io.SEEK_CUR)
    return end


def _has_end(file: BinaryIO, size: int) -> bool:
    file.seek(size - len(MAGIC))
    return file.read() == MAGIC


class CutMcap:
    """A path to the first `end` bytes of an MCAP file followed by a footer, with the methods that rosbags calls.

    Args:
        path: the file that was cut off.
        end: where its last whole record ends, bytes.
    """

    suffix = ".mcap"

    def __init__(self, path: Path, end: int) -> None:
        self._path, self._end = path, end
        self.stem = path.stem

    def __str__(self) -> str:
        return str(self._path)

    def exists(self) -> bool:
        """Return True: the file was there when it was opened."""
        return True

    def is_dir(self) -> bool:
        """Return False: it is a file."""
        return False

    def open(self, mode: str = "rb") -> BinaryIO:
        """Open for reading bytes. Raises ValueError on another mode."""
        if mode != "rb":
            raise ValueError(f"mode is {mode!r}: expected 'rb'")
        return io.BufferedReader(_WithEnd(self._path.open("rb"), self._end))


class _WithEnd(io.RawIOBase):
    """The first `length` bytes of a file, then END."""

    def __init__(self, file: BinaryIO, length: int) -> None:
        self._file, self._length, self._at = file, length, 0

    def readable(self) -> bool:
        return True

    def seekable(self) -> bool:
        return True

    def seek(self, offset: int, whence: int = io.SEEK_SET) -> int:
        start = {io.SEEK_SET: 0, io.SEEK_CUR: self._at, io.SEEK_END: self._length + len(END)}[whence]
        self._at = max(0, start + offset)
        return self._at

    def readinto(self, buffer: Any) -> int:
        if self._at < self._length:
            self._file.seek(self._at)
            data = self._file.read(min(len(buffer), self._length - self._at))
        else:
            data = END[self._at - self._length :][: len(buffer)]
        buffer[: len(data)] = data
        self._at += len(data)
        return len(data)

    def close(self) -> None:
        self._file.close()
        super().close()
