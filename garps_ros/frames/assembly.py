# SPDX-License-Identifier: Apache-2.0
"""Image, depth and calibration -> frames; frames of two cameras -> pairs. The rules are the same offline and live."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

from garps_ros.frames.frame import CameraTopics, Frame
from garps_ros.frames.stamps import Pairer
from msg_adapters import MessageError, header_stamp_ns

IMAGE, DEPTH = 0, 1

Complete = list[tuple[Frame, ...]]
"""Frames that belong together: (source, target), or (source,) where there is one camera."""


class Assembly:
    """Joins messages to frames and pairs; topics may come in any order, each topic in order of time.

    Args:
        cameras: [source, target], or [source] alone; one without a depth topic gives frames without depth.
        slop_ns: largest difference of stamps that belong together, ns.
        refused: called with topic and reason for every message that cannot be used.
        live: see `Pairer`.
    """

    def __init__(
        self, cameras: Sequence[CameraTopics], slop_ns: int, refused: Callable[[str, str], None], live: bool = False
    ) -> None:
        self._cameras, self._refused = list(cameras), refused
        self._with_depth = [Pairer(slop_ns, live) for _ in cameras]
        self._between = Pairer(slop_ns, live)
        self._infos: list[Any] = [None] * len(cameras)
        self._without_info: list[tuple[Any, Any] | None] = [None] * len(cameras)

    def add_info(self, index: int, message: Any) -> Complete:
        """Keep the newest calibration of a camera; return what became complete with an image that waited for it."""
        self._infos[index] = message
        waiting, self._without_info[index] = self._without_info[index], None
        return self._framed(index, *waiting) if waiting else []

    def add(self, index: int, role: int, message: Any) -> Complete:
        """Take an image or depth of a camera; return what became complete."""
        camera = self._cameras[index]
        topic = (camera.image, camera.depth)[role]
        try:
            stamp_ns = header_stamp_ns(message)
        except MessageError as error:
            self._refused(topic, str(error))
            return []
        pairs = self._with_depth[index].add(role, stamp_ns, message)
        if pairs is None:
            self._refused(topic, f"header.stamp {stamp_ns} ns is not later than the one before: expected it to grow")
        elif not camera.depth:  # then nothing belongs to the image, at the same time
            pairs = self._with_depth[index].add(DEPTH, stamp_ns, None)
        return self._all_framed(index, pairs or [])

    def settle(self) -> Complete:
        """Return the pairs that wait for a better partner when nothing has arrived for a while."""
        complete = [c for i, pairer in enumerate(self._with_depth) for c in self._all_framed(i, pairer.settle())]
        return complete + list(self._between.settle())

    def finish(self) -> Complete:
        """Return the pairs that wait for a better partner, and drop the rest, at the end of the messages."""
        complete = [c for i, pairer in enumerate(self._with_depth) for c in self._all_framed(i, pairer.finish())]
        for index, waiting in enumerate(self._without_info):
            if waiting is not None:
                self._refuse_without_info(index)
        return complete + list(self._between.finish())

    def change_slop(self, slop_ns: int) -> None:
        """Change the largest difference of stamps that belong together, ns."""
        for pairer in self._pairers:
            pairer.slop_ns = slop_ns

    def calibrations(self) -> list[Any]:
        """Return the newest CameraInfo of each camera, None before the first."""
        return list(self._infos)

    def newest_ns(self, index: int, role: int) -> int:
        """Return the newest stamp of a stream, ns; -1 before the first."""
        return self._with_depth[index].latest[role]

    @property
    def unpaired(self) -> int:
        """Images without depth, depths without image and frames without partner so far."""
        return sum(sum(pairer.unpaired) for pairer in self._pairers)

    def gaps_s(self) -> dict[str, float]:
        """Return the distances between the newest stamps of streams that belong together, s, by their topics."""
        names = [(camera.image, camera.depth) for camera in self._cameras]
        if len(self._cameras) == 2:
            names.append((self._cameras[0].image, self._cameras[1].image))
        return {
            f"{a} and {b}": (pairer.latest[0] - pairer.latest[1]) * 1e-9
            for (a, b), pairer in zip(names, self._pairers, strict=False)
            if b and min(pairer.latest) > 0
        }

    @property
    def _pairers(self) -> tuple[Pairer, ...]:
        return *self._with_depth, self._between

    def _all_framed(self, index: int, pairs: list[tuple[Any, Any]]) -> Complete:
        return [complete for image, depth in pairs for complete in self._framed(index, image, depth)]

    def _framed(self, index: int, image: Any, depth: Any) -> Complete:
        camera, info = self._cameras[index], self._infos[index]
        if info is None:
            if self._without_info[index] is not None:
                self._refuse_without_info(index)
            self._without_info[index] = image, depth
            return []
        frame = Frame(camera, header_stamp_ns(image), image, depth, info)
        if len(self._cameras) == 1:
            return [(frame,)]
        return list(self._between.add(index, frame.stamp_ns, frame) or [])

    def _refuse_without_info(self, index: int) -> None:
        camera = self._cameras[index]
        self._refused(camera.info, f"no camera_info yet for {camera.image}: its images are left out until it comes")
