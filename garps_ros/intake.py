# SPDX-License-Identifier: Apache-2.0
"""Messages of one or two live cameras, as they arrive, to frames that belong together; notices when time jumps back."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

from garps_ros.cameras import CameraTopics, Frame
from garps_ros.pairing import Pairer
from msg_adapters import MessageError, header_stamp_ns

IMAGE, DEPTH = 0, 1
JUMP_BACK_NS = 1_000_000_000
"""A stamp this much older than the newest of its stream is no late message: the recording began again."""
STUBBORN = 10
"""So many older stamps on one stream with no newer one between mean the same: a recording shorter than the jump."""


class Intake:
    """Puts image and depth of each camera together, then the cameras, with the rules of the offline replay.

    Args:
        cameras: [source, target], or [source] alone.
        slop_ns: largest difference of stamps that belong together, ns; may be changed at any time.
        refused: called with topic and reason for every message that cannot be used.
        jumped: called when time has jumped back; whatever was held has been forgotten.
    """

    def __init__(
        self,
        cameras: Sequence[CameraTopics],
        slop_ns: int,
        refused: Callable[[str, str], None],
        jumped: Callable[[str], None],
    ) -> None:
        self._cameras, self._refused, self._jumped = list(cameras), refused, jumped
        self._infos: list[Any] = [None] * len(cameras)
        self._unpaired_before = 0
        self.slop_ns = slop_ns
        self.forget()

    def forget(self) -> None:
        """Drop what waits for a partner; calibrations stay."""
        self._unpaired_before = self.unpaired if hasattr(self, "_between") else 0
        self._with_depth = [Pairer(self.slop_ns) for _ in self._cameras]
        self._between = Pairer(self.slop_ns)
        self._without_info: list[tuple[Any, Any] | None] = [None] * len(self._cameras)
        self._older = {(index, role): 0 for index in range(len(self._cameras)) for role in (IMAGE, DEPTH)}

    @property
    def unpaired(self) -> int:
        """Images without depth, depths without image and frames without partner since the beginning."""
        pairers = (*self._with_depth, self._between)
        return self._unpaired_before + sum(sum(pairer.unpaired) for pairer in pairers)

    def gaps_s(self) -> dict[str, float]:
        """How far the newest stamps of streams that belong together lie apart, s; for the diagnosis of no pairs."""
        gaps = {}
        for camera, pairer in zip(self._cameras, self._with_depth, strict=True):
            if min(pairer.latest) > 0:
                gaps[f"{camera.image} and {camera.depth}"] = (pairer.latest[0] - pairer.latest[1]) * 1e-9
        if min(self._between.latest) > 0:
            a, b = self._cameras
            gaps[f"{a.image} and {b.image}"] = (self._between.latest[0] - self._between.latest[1]) * 1e-9
        return gaps

    def add_info(self, index: int, message: Any) -> list[tuple[Frame, ...]]:
        """Keep the newest calibration of a camera; returns what became complete, as `add`.

        An image that came before the first calibration has waited for it.
        """
        self._infos[index] = message
        waiting, self._without_info[index] = self._without_info[index], None
        return self._framed(index, *waiting) if waiting else []

    def add(self, index: int, role: int, message: Any) -> list[tuple[Frame, ...]]:
        """Take an image or depth of a camera; returns what became complete: (source, target), or (source,) alone."""
        camera = self._cameras[index]
        topic = (camera.image, camera.depth)[role]
        try:
            stamp_ns = header_stamp_ns(message)
        except MessageError as error:
            self._refused(topic, str(error))
            return []
        pairs = self._paired(index, role, stamp_ns, message, topic)
        complete: list[tuple[Frame, ...]] = []
        for image, depth in pairs:
            complete += self._framed(index, image, depth)
        return complete

    def _paired(self, index: int, role: int, stamp_ns: int, message: Any, topic: str) -> list[tuple[Any, Any]]:
        pairer = self._with_depth[index]
        behind_ns = pairer.latest[role] - stamp_ns
        if behind_ns:  # the end of a short recording that began again is the newest stamp once more
            self._older[index, role] = self._older[index, role] + 1 if behind_ns > 0 else 0
        if behind_ns >= JUMP_BACK_NS or self._older[index, role] >= STUBBORN:
            self.forget()
            self._jumped(f"{topic}: time went back by {behind_ns * 1e-9:.3f} s")
            pairer = self._with_depth[index]
        pairer.slop_ns = self._between.slop_ns = self.slop_ns
        pairs = pairer.add(role, stamp_ns, message)
        if pairs is None:
            self._refused(topic, f"header.stamp {stamp_ns} ns is not later than the one before: expected it to grow")
        return pairs or []

    def _framed(self, index: int, image: Any, depth: Any) -> list[tuple[Frame, ...]]:
        camera, info = self._cameras[index], self._infos[index]
        if info is None:
            if self._without_info[index] is not None:
                reason = f"no camera_info yet for {camera.image}: its images are left out until it comes"
                self._refused(camera.info, reason)
            self._without_info[index] = image, depth
            return []
        frame = Frame(camera, header_stamp_ns(image), image, depth, info)
        if len(self._cameras) == 1:
            return [(frame,)]
        return list(self._between.add(index, frame.stamp_ns, frame) or [])
