# SPDX-License-Identifier: Apache-2.0
"""From the messages of a recording to frames (image + depth + camera_info) and to pairs of frames of two cameras."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any

from garps_ros.bags import Bag
from garps_ros.cameras import CameraTopics, Frame
from garps_ros.pairing import Pairer
from msg_adapters import MessageError, header_stamp_ns

IMAGE, DEPTH = 0, 1

Refused = Callable[[str], None]
"""Called with the reason when a message cannot be used at all."""


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
        self._with_depth = [Pairer(slop_ns) for _ in cameras]
        self._between = Pairer(slop_ns)
        # Calibration that is recorded after the first image is still that image's calibration.
        self._infos = {camera.info: bag.first(camera.info) for camera in cameras}

    def singles(self) -> Iterator[Frame]:
        """The frames of the first camera."""
        for _, frame in self._frames():
            yield frame

    def pairs(self) -> Iterator[tuple[Frame, Frame]]:
        """Frames of both cameras whose stamps agree to the slop, as (first camera, second camera)."""
        for index, frame in self._frames():
            pairs = self._between.add(index, frame.stamp_ns, frame)
            yield from pairs or ()
        yield from self._between.finish()

    def unpaired(self) -> int:
        """Images without depth, depths without image and frames without partner so far."""
        return sum(sum(pairer.unpaired) for pairer in (*self._with_depth, self._between))

    def _frames(self) -> Iterator[tuple[int, Frame]]:
        roles: dict[str, list[tuple[int, int]]] = {}
        for index, camera in enumerate(self._cameras):
            roles.setdefault(camera.image, []).append((index, IMAGE))
            roles.setdefault(camera.depth, []).append((index, DEPTH))
        for topic, message in self._bag.messages({*roles, *self._infos}):
            if isinstance(message, MessageError):
                self._refused(f"{topic}: {message}")
            elif topic in self._infos:
                self._infos[topic] = message
            else:
                for index, role in roles[topic]:
                    yield from self._complete(index, self._added(index, role, topic, message))
        for index, pairer in enumerate(self._with_depth):
            yield from self._complete(index, pairer.finish())

    def _added(self, index: int, role: int, topic: str, message: Any) -> list[tuple[Any, Any]]:
        try:
            stamp_ns = header_stamp_ns(message)
        except MessageError as error:
            self._refused(f"{topic}: {error}")
            return []
        pairs = self._with_depth[index].add(role, stamp_ns, message)
        if pairs is None:
            self._refused(f"{topic}: header.stamp {stamp_ns} ns is not later than the one before: expected it to grow")
        return pairs or []

    def _complete(self, index: int, pairs: list[tuple[Any, Any]]) -> Iterator[tuple[int, Frame]]:
        camera = self._cameras[index]
        for image, depth in pairs:
            info = self._infos[camera.info]
            if info is None:
                self._refused(f"{camera.info}: no camera_info that can be decoded")
            else:
                yield index, Frame(camera, header_stamp_ns(image), image, depth, info)
