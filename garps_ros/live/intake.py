# SPDX-License-Identifier: Apache-2.0
"""The intake of live messages: an assembly that begins anew when time jumps back."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

from garps_ros.frames.assembly import DEPTH, IMAGE, Assembly, Complete
from garps_ros.frames.frame import CameraTopics
from msg_adapters import MessageError, header_stamp_ns

JUMP_BACK_NS = 1_000_000_000
"""Age of a message against the newest stamp of its stream, ns, that means a jump back in time."""
STUBBORN = 10
"""Number of older stamps in a row that also mean a jump back, for recordings shorter than `JUMP_BACK_NS`."""


class Intake:
    """Joins messages by the rules of the offline replay (`Assembly`), and begins anew when time jumps back.

    Args:
        cameras: [source, target], or [source] alone.
        slop_ns: largest difference of stamps that belong together, ns.
        refused: called with topic and reason for every message that cannot be used.
        jumped: called with a text when time has jumped back; whatever was held has been forgotten.
    """

    def __init__(
        self,
        cameras: Sequence[CameraTopics],
        slop_ns: int,
        refused: Callable[[str, str], None],
        jumped: Callable[[str], None],
    ) -> None:
        self._cameras, self._refused, self._jumped = list(cameras), refused, jumped
        self._slop_ns, self._unpaired_before = slop_ns, 0
        self._came = False
        self._begin()

    def _begin(self) -> None:
        self._assembly = Assembly(self._cameras, self._slop_ns, self._refused, live=True)
        self._older = {(index, role): 0 for index in range(len(self._cameras)) for role in (IMAGE, DEPTH)}

    @property
    def slop_ns(self) -> int:
        """Largest difference of stamps that belong together, ns; may be changed at any time."""
        return self._slop_ns

    @slop_ns.setter
    def slop_ns(self, slop_ns: int) -> None:
        self._slop_ns = slop_ns
        self._assembly.change_slop(slop_ns)

    def forget(self) -> None:
        """Drop the messages that wait for a partner; calibrations stay."""
        self._unpaired_before += self._assembly.unpaired
        calibrations = self._assembly.calibrations()
        self._begin()
        for index, info in enumerate(calibrations):
            if info is not None:
                self._assembly.add_info(index, info)

    @property
    def unpaired(self) -> int:
        """Images without depth, depths without image and frames without partner since the start."""
        return self._unpaired_before + self._assembly.unpaired

    def gaps_s(self) -> dict[str, float]:
        """Return the distances between the newest stamps of streams that belong together, s, by their topics."""
        return self._assembly.gaps_s()

    def add_info(self, index: int, message: Any) -> Complete:
        """Keep the newest calibration of a camera; return what became complete."""
        return self._assembly.add_info(index, message)

    def add(self, index: int, role: int, message: Any) -> Complete:
        """Take an image or depth of a camera; return what became complete."""
        self._came = True
        self._watch(index, role, message)
        return self._assembly.add(index, role, message)

    def settle(self) -> Complete:
        """Return the pairs that wait for a better partner if nothing has come since the last call."""
        came, self._came = self._came, False
        return [] if came else self._assembly.settle()

    def _watch(self, index: int, role: int, message: Any) -> None:
        """Begin anew if the stamp shows that time has jumped back."""
        try:
            behind_ns = self._assembly.newest_ns(index, role) - header_stamp_ns(message)
        except MessageError:
            return  # the assembly refuses it
        if behind_ns:  # the end of a short recording that began again is the newest stamp once more
            self._older[index, role] = self._older[index, role] + 1 if behind_ns > 0 else 0
        if behind_ns >= JUMP_BACK_NS or self._older[index, role] >= STUBBORN:
            camera = self._cameras[index]
            self.forget()
            self._jumped(f"{(camera.image, camera.depth)[role]}: time went back by {behind_ns * 1e-9:.3f} s")
