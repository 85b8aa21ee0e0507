# SPDX-License-Identifier: Apache-2.0
"""Messages of a recording -> frames (image, depth, camera_info) -> pairs of frames of two cameras."""

from __future__ import annotations

from collections.abc import Callable, Iterator

from garps_ros.frames.assembly import DEPTH, IMAGE, Assembly
from garps_ros.frames.frame import CameraTopics, Frame
from garps_ros.recording.bags import Bag
from msg_adapters import MessageError

INFO = 2

Refused = Callable[[str], None]
"""A function called with the reason when a message cannot be used at all."""


class Frames:
    """Frames of one or two cameras, in order of recording.

    Args:
        bag: an open recording.
        cameras: one camera, or two.
        slop_ns: largest difference of the stamps of an image and its depth, and of the frames of a pair, ns.
        refused: called with the reason for every message that is malformed or out of order.
    """

    def __init__(self, bag: Bag, cameras: list[CameraTopics], slop_ns: int, refused: Refused) -> None:
        self._bag, self._cameras, self._refused = bag, cameras, refused
        self._assembly = Assembly(cameras, slop_ns, lambda topic, reason: refused(f"{topic}: {reason}"))

    def singles(self) -> Iterator[Frame]:
        """Yield the frames of the only camera."""
        for (frame,) in self._complete():
            yield frame

    def pairs(self) -> Iterator[tuple[Frame, Frame]]:
        """Yield the frames of both cameras whose stamps agree to the slop, as (first camera, second camera)."""
        yield from ((first, second) for first, second in self._complete())

    def unpaired(self) -> int:
        """Images without depth, depths without image and frames without partner so far."""
        return self._assembly.unpaired

    def _complete(self) -> Iterator[tuple[Frame, ...]]:
        roles: dict[str, list[tuple[int, int]]] = {}
        for index, camera in enumerate(self._cameras):
            for topic, role in ((camera.image, IMAGE), (camera.depth, DEPTH), (camera.info, INFO)):
                if topic:
                    roles.setdefault(topic, []).append((index, role))
            # Calibration that is recorded after the first image is still that image's calibration.
            if (info := self._bag.first(camera.info)) is not None:
                self._assembly.add_info(index, info)
        for topic, message in self._bag.messages(roles):
            if isinstance(message, MessageError):
                self._refused(f"{topic}: {message}")
                continue
            for index, role in roles[topic]:
                if role == INFO:
                    yield from self._assembly.add_info(index, message)
                else:
                    yield from self._assembly.add(index, role, message)
        yield from self._assembly.finish()
