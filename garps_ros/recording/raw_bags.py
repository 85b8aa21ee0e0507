# SPDX-License-Identifier: Apache-2.0
"""The messages of a recording as they are sent by ROS 2, serialised (CDR)."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterator
from typing import Any

from rosbags.interfaces import ConnectionExtRosbag1, QosDurability
from rosbags.typesys import Stores, get_typestore

from garps_ros.recording.bags import Bag
from msg_adapters import MessageError

HEADER = "std_msgs/msg/Header"


class RawBag(Bag):
    """An open recording that hands out serialised messages; see `Bag`."""

    def __enter__(self) -> RawBag:
        super().__enter__()
        return self

    def raw_messages(self, topics: Collection[str]) -> Iterator[tuple[str, int, bytes | MessageError]]:
        """Yield all messages of some topics in order of recording as (topic, recording time ns, CDR).

        A ROS 1 message that cannot be rewritten comes as the MessageError that says why. When the file breaks off, the
        iteration ends and `broken_end` says why.
        """
        to_cdr = bytes_of if self._reader.is2 else self._rewriter()
        for connection, recorded_ns, raw in self._records(topics):
            yield connection.topic, recorded_ns, to_cdr(raw, connection.msgtype)

    @property
    def end_ns(self) -> int:
        """Recording time of the last message, ns; 0 when a damaged file does not tell."""
        return int(self._reader.end_time or 0)

    def latched(self, topic: str) -> int:
        """Return the number of messages of a topic that its recorded publisher kept for late subscribers."""
        count = 0
        for connection in self._reader.connections:
            if connection.topic != topic:
                continue
            if isinstance(connection.ext, ConnectionExtRosbag1):
                count += bool(connection.ext.latching)
            else:
                offered = connection.ext.offered_qos_profiles
                count += sum(max(1, q.depth) for q in offered if q.durability is QosDurability.TRANSIENT_LOCAL)
        return count

    def _rewriter(self) -> Callable[[Any, str], bytes | MessageError]:
        """Return a function from ROS 1's serialisation to CDR; with ROS 2's header rosbags leaves out `seq`."""
        store = get_typestore(Stores.EMPTY)
        header = get_typestore(Stores.ROS2_JAZZY).fielddefs[HEADER]
        store.register({**self._reader.typestore.fielddefs, HEADER: header})

        def rewritten(raw: Any, kind: str) -> bytes | MessageError:
            try:
                return bytes(store.ros1_to_cdr(raw, kind))
            except Exception as error:  # a damaged message makes the decoders raise nearly anything
                return MessageError(f"message cannot be rewritten as {kind}: {' '.join(str(error).split())[:200]}")

        return rewritten


def bytes_of(raw: Any, _: str) -> bytes:
    """Copy a buffer: rclpy publishes bytes, but no view of them."""
    return bytes(raw)
