# SPDX-License-Identifier: Apache-2.0
"""Reading a recording: rosbag2 (sqlite3, MCAP) and ROS 1 .bag, without ROS, tolerant of a damaged end."""

from __future__ import annotations

from collections.abc import Collection, Iterator
from contextlib import ExitStack
from pathlib import Path
from types import TracebackType
from typing import Any

from rosbags.highlevel import AnyReader
from rosbags.typesys import Stores, get_typestore

from garps_ros.recording.cut_mcap import salvageable
from msg_adapters import MessageError


class BagError(Exception):
    """A recording that cannot be used: missing, corrupt, empty, or without the topics that are needed."""


class Bag:
    """An open recording; use it as a context manager.

    Args:
        path: a rosbag2 folder, a single .mcap or .db3 file, or a ROS 1 .bag file.
    Raises:
        BagError: on entering, when the recording cannot be read or holds no message.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self.types: dict[str, str] = {}
        """Message type by topic, e.g. "sensor_msgs/msg/Image", of the topics that hold messages."""
        self.counts: dict[str, int] = {}
        self.broken_end = ""
        """Reason why reading stopped before the end; "" when it did not."""
        self._stack = ExitStack()
        self._first: dict[str, Any] = {}

    def __enter__(self) -> Bag:
        if not self.path.exists():
            raise BagError(f"{self.path} does not exist: expected a rosbag2 folder, an .mcap, .db3 or ROS 1 .bag file")
        try:
            self._open(self.path)
        except BagError as error:
            rest = salvageable(self.path)
            if rest is None:
                raise
            try:
                self._open(rest)
            except BagError:
                raise error from None
            self.broken_end = "" if isinstance(rest, Path) else "the end of the file is missing"
        topics = self._reader.topics
        self.counts = {name: info.msgcount for name, info in topics.items() if info.msgcount}
        self.types = {name: topics[name].msgtype or "several types" for name in self.counts}
        if not self.types:
            self._stack.close()
            raise BagError(f"{self.path} holds no messages: expected images, camera_info and depth")
        return self

    def _open(self, path: Any) -> None:
        try:
            # Older rosbag2 files carry no message definitions; the ones that matter here never changed.
            reader = AnyReader([path], default_typestore=get_typestore(Stores.ROS2_JAZZY))
            self._reader = self._stack.enter_context(reader)
        except Exception as error:  # a damaged file makes the reader and its decoders raise nearly anything
            raise BagError(f"{self.path} cannot be read as a recording: {_one_line(error)}{self._hint()}") from None

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._stack.close()

    def first(self, topic: str) -> Any:
        """Return the first message of a topic that can be decoded, or None."""
        if topic not in self._first:
            decoded = (message for _, message in self.messages([topic]) if not isinstance(message, MessageError))
            self._first[topic] = next(decoded, None)
        return self._first[topic]

    def messages(self, topics: Collection[str]) -> Iterator[tuple[str, Any]]:
        """Yield all messages of some topics in order of recording as (topic, message).

        A message that cannot be decoded comes as the MessageError that says why. When the file breaks off, the
        iteration ends and `broken_end` says why.
        """
        for connection, _, raw in self._records(topics):
            yield connection.topic, self._decoded(raw, connection.msgtype)

    def _records(self, topics: Collection[str]) -> Iterator[tuple[Any, int, Any]]:
        """Yield (connection, recording time ns, raw message) of some topics, as far as the file is whole."""
        connections = [connection for connection in self._reader.connections if connection.topic in topics]
        records = self._reader.messages(connections=connections) if connections else iter(())
        while True:
            try:
                record = next(records)
            except StopIteration:
                return
            except Exception as error:  # see __enter__
                self.broken_end = _one_line(error)
                return
            yield record

    def listing(self) -> str:
        """Return the topics with their types, for error texts."""
        return "; ".join(f"{name} ({kind}, {self.counts[name]})" for name, kind in sorted(self.types.items()))

    def _decoded(self, raw: bytes, kind: str) -> Any:
        try:
            return self._reader.deserialize(raw, kind)
        except Exception as error:  # see __enter__
            return MessageError(f"message cannot be decoded as {kind}: {_one_line(error)}")

    def _hint(self) -> str:
        if self.path.is_dir() and not (self.path / "metadata.yaml").exists():
            return "; without metadata.yaml give the .mcap or .db3 file inside, or run `ros2 bag reindex`"
        return "; if it was cut off, `ros2 bag reindex` or `rosbag reindex` may repair it"


def _one_line(error: Exception) -> str:
    text = " ".join(str(error).split())
    return f"{text[:200]} ({type(error).__name__})" if text else type(error).__name__
