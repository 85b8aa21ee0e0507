# SPDX-License-Identifier: Apache-2.0
"""Coloured points to sensor_msgs/PointCloud2, laid out as RViz reads them without asking.

Sixteen bytes a point, little endian: x, y, z as float32 in m, then `rgb`, a float32 whose bits are 0x00RRGGBB (a custom
of PCL that RViz follows). Unordered: height 1.
"""

from __future__ import annotations

import array
from collections.abc import Callable
from typing import Any

import numpy as np
import numpy.typing as npt

from msg_adapters.errors import MessageError
from msg_adapters.fields import make_header

MAX_POINTS = 2_000_000
"""32 MB, every pixel of a 1600x1200 image; a viewer needs far fewer."""
FLOAT32 = 7
"""sensor_msgs/PointField.FLOAT32; not read from the class, which look-alike libraries leave without constants."""
POINT = np.dtype([("xyz", "<f4", 3), ("rgb", "<u4")])
OFFSETS = {"x": 0, "y": 4, "z": 8, "rgb": 12}


class CloudWriter:
    """Builds point clouds of one message library.

    Args:
        message_class: from a full name ("sensor_msgs/msg/PointCloud2") to the class, as for `PoseWriter`.
    """

    def __init__(self, message_class: Callable[[str], Callable[..., Any]]) -> None:
        self._class = message_class

    def point_cloud(self, points: npt.ArrayLike, colours: npt.ArrayLike, stamp_ns: int, frame_id: str) -> Any:
        """A PointCloud2 of N coloured points; N may be 0, which clears a display.

        Args:
            points: Nx3 floats, m, in the frame `frame_id`. NaN and infinity are refused, not dropped: the cloud says
                it is dense, and whoever made a point that is not finite has a fault to find.
            colours: Nx3 uint8, RGB.
            stamp_ns: time of the image the points were seen in, ns.
            frame_id: name of the frame.
        Raises:
            MessageError: other shapes or types, more than 2,000,000 points, NaN or infinity (also: too large for
                float32), no frame, a stamp that is no time.
        """
        packed = _packed(points, colours)
        data = array.array("B")
        data.frombytes(packed.tobytes())  # anything but an array("B") is walked byte by byte by the checks of rclpy
        return self._make(
            "sensor_msgs/msg/PointCloud2",
            header=make_header(self._class, stamp_ns, frame_id),
            height=1,
            width=len(packed),
            fields=[self._field(name, offset) for name, offset in OFFSETS.items()],
            is_bigendian=False,
            point_step=POINT.itemsize,
            row_step=packed.nbytes,
            data=data,
            is_dense=True,
        )

    def _make(self, kind: str, **fields: Any) -> Any:
        return self._class(kind)(**fields)

    def _field(self, name: str, offset: int) -> Any:
        return self._make("sensor_msgs/msg/PointField", name=name, offset=offset, datatype=FLOAT32, count=1)


def _packed(points: npt.ArrayLike, colours: npt.ArrayLike) -> npt.NDArray[np.void]:
    """One record of POINT for every point."""
    positions, rgb = _as_floats(points), np.asarray(colours)
    if rgb.dtype != np.uint8 or rgb.shape != positions.shape:
        raise MessageError(
            f"colours have shape {rgb.shape} of {rgb.dtype}: expected {positions.shape} of uint8, one row a point"
        )
    packed = np.empty(len(positions), POINT)
    packed["xyz"] = positions
    red, green, blue = rgb.T.astype(np.uint32)
    packed["rgb"] = red << 16 | green << 8 | blue
    return packed


def _as_floats(points: npt.ArrayLike) -> npt.NDArray[np.float32]:
    try:
        given = np.asarray(points)
        with np.errstate(over="ignore"):  # what float32 cannot hold becomes infinity and is refused as such
            positions = given.astype(np.float32)
    except (TypeError, ValueError):
        raise MessageError("points are no array of numbers: expected Nx3 floats, m") from None
    if positions.ndim != 2 or positions.shape[1] != 3:
        raise MessageError(f"points have shape {positions.shape}: expected Nx3, m")
    if len(positions) > MAX_POINTS:
        raise MessageError(f"{len(positions)} points: expected at most {MAX_POINTS}; publish fewer of them")
    unusable = int((~np.isfinite(positions).all(axis=1)).sum())
    if unusable:
        raise MessageError(f"{unusable} of {len(positions)} points hold NaN or infinity: expected finite metres")
    return positions
