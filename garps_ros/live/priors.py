# SPDX-License-Identifier: Apache-2.0
"""The poses given on the prior topic: the choice of the one for an image, and its checks."""

from __future__ import annotations

from collections import deque
from typing import Any

from garps_core.errors import InputError
from garps_core.types import Prior
from msg_adapters import MessageError, header_frame_id, pose_from_message, stamp_to_ns

KEPT = 500


class Priors:
    """Keeps PoseWithCovarianceStamped messages and finds the one for a time of acquisition.

    A message with a zero stamp stands for all times, until the next such message.
    """

    def __init__(self) -> None:
        self._timed: deque[tuple[int, Any]] = deque(maxlen=KEPT)
        self._standing: Any = None

    def add(self, message: Any) -> None:
        """Keep a message. Raises MessageError on one that no frame name would make right."""
        stamp_ns = stamp_to_ns(message.header.stamp)
        prior_from_message(message, header_frame_id(message))
        if stamp_ns == 0:
            self._standing = message
        else:
            self._timed.append((stamp_ns, message))

    def forget(self, standing: bool = False) -> None:
        """Drop the messages with a stamp; with `standing` also the one that stands for all times."""
        self._timed.clear()
        if standing:
            self._standing = None

    def near(self, stamp_ns: int, max_age_ns: int) -> Any:
        """Return the message nearest in time within `max_age_ns` (the latest of equals), else the standing one."""
        nearest = min(reversed(self._timed), key=lambda timed: abs(timed[0] - stamp_ns), default=None)
        if nearest is not None and abs(nearest[0] - stamp_ns) <= max_age_ns:
            return nearest[1]
        return self._standing


def prior_from_message(message: Any, target_frame: str) -> Prior:
    """Make a Prior of a PoseWithCovarianceStamped: the pose of the source camera in `target_frame`.

    Raises:
        MessageError: another frame, NaN, no unit quaternion, a covariance of zeros or otherwise none.
    """
    frame_id = header_frame_id(message)
    if frame_id and frame_id != target_frame:
        raise MessageError(
            f"prior is in frame {frame_id!r}: expected the pose of the source camera in {target_frame!r}, the target"
        )
    T, covariance = pose_from_message(message)
    if covariance is None:
        raise MessageError("prior has no covariance: expected PoseWithCovarianceStamped")
    try:
        return Prior(T, covariance, reason="from the prior topic")
    except InputError as error:
        raise MessageError(str(error)) from None
