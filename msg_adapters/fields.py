# SPDX-License-Identifier: Apache-2.0
"""Checked reading of single message fields; every other module of this package reads through these functions."""

from __future__ import annotations

import operator
from collections.abc import Callable
from typing import Any

import numpy as np
import numpy.typing as npt

from msg_adapters.errors import MessageError

NANOSECONDS = 1_000_000_000
MAX_SECONDS = 2**31 - 1


def field(message: Any, *names: str) -> Any:
    """The first of `names` that the message has (ROS 1 says D where ROS 2 says d). Raises MessageError if none."""
    for name in names:
        value = getattr(message, name, None)
        if value is not None:
            return value
    raise MessageError(f"{_kind(message)} has no field {names[0]!r}: expected one; is the topic of another type?")


def integer(message: Any, name: str, low: int, high: int) -> int:
    """An integer field within low..high as int. Raises MessageError otherwise."""
    value = field(message, name)
    try:
        number = operator.index(value)
    except TypeError:
        raise MessageError(f"{name} is {value!r}: expected an integer in {low}..{high}") from None
    if not low <= number <= high:
        raise MessageError(f"{name} is {number}: expected {low}..{high}")
    return number


def text(message: Any, name: str) -> str:
    """A string field as str. Raises MessageError otherwise."""
    value = field(message, name)
    if not isinstance(value, str):
        raise MessageError(f"{name} is {type(value).__name__}: expected text")
    return value


def numbers(message: Any, *names: str, count: int | None = None) -> npt.NDArray[np.float64]:
    """A sequence field as a float64 array of `count` finite numbers (None = any). Raises MessageError otherwise."""
    value = field(message, *names)
    try:
        array = np.array(value, dtype=np.float64)
    except (TypeError, ValueError):
        raise MessageError(f"{names[0]} is no sequence of numbers: expected {count or 'some'} numbers") from None
    if array.ndim != 1 or (count is not None and array.size != count):
        raise MessageError(f"{names[0]} has shape {array.shape}: expected {count or 'a flat list of'} numbers")
    if not np.isfinite(array).all():
        raise MessageError(f"{names[0]} holds NaN or infinity: expected finite numbers")
    return array


def octets(message: Any) -> npt.NDArray[np.uint8]:
    """The `data` field as a flat uint8 view, not copied: never write to it. Raises MessageError if it is no bytes."""
    value = field(message, "data")
    try:
        view = memoryview(value)
    except TypeError:
        raise MessageError(f"data is {type(value).__name__}: expected bytes, array('B') or a uint8 array") from None
    if view.format != "B" or view.ndim != 1 or not view.contiguous:
        raise MessageError(f"data is {view.ndim}-dimensional of format {view.format!r}: expected flat bytes")
    return np.frombuffer(view, np.uint8) if view.nbytes else np.empty(0, np.uint8)


def stamp_to_ns(stamp: Any) -> int:
    """A builtin_interfaces/Time as nanoseconds. Raises MessageError unless 0 <= nanosec < 1e9 and sec fits int32."""
    return integer(stamp, "sec", 0, MAX_SECONDS) * NANOSECONDS + integer(stamp, "nanosec", 0, NANOSECONDS - 1)


def ns_to_stamp(stamp_ns: int) -> tuple[int, int]:
    """Nanoseconds as (sec, nanosec). Raises MessageError unless the seconds fit an int32 and are not negative."""
    try:
        sec, nanosec = divmod(operator.index(stamp_ns), NANOSECONDS)
    except TypeError:
        raise MessageError(f"stamp is {stamp_ns!r}: expected integer nanoseconds") from None
    if not 0 <= sec <= MAX_SECONDS:
        raise MessageError(f"stamp is {stamp_ns} ns: expected 0..{MAX_SECONDS} s; is it in another unit?")
    return sec, nanosec


def header_stamp_ns(message: Any) -> int:
    """Time of acquisition from the header, ns. Raises MessageError on a malformed stamp, and on zero: not set."""
    stamp_ns = stamp_to_ns(field(field(message, "header"), "stamp"))
    if stamp_ns == 0:
        raise MessageError("header.stamp is zero: expected the time of acquisition; the driver does not set it")
    return stamp_ns


def header_frame_id(message: Any) -> str:
    """Name of the frame from the header; may be empty. Raises MessageError if it is no text."""
    return text(field(message, "header"), "frame_id")


def make_header(message_class: Callable[[str], Callable[..., Any]], stamp_ns: int, frame_id: str) -> Any:
    """A std_msgs/Header of a message library. Raises MessageError on a stamp that is no time, or no frame."""
    sec, nanosec = ns_to_stamp(stamp_ns)
    stamp = message_class("builtin_interfaces/msg/Time")(sec=int(sec), nanosec=int(nanosec))
    return message_class("std_msgs/msg/Header")(stamp=stamp, frame_id=checked_name("frame_id", frame_id))


def checked_name(name: str, value: str) -> str:
    """The name of a frame. Raises MessageError if it is empty or no text."""
    if not isinstance(value, str) or not value:
        raise MessageError(f"{name} is {value!r}: expected the name of a frame")
    return str(value)


def _kind(message: Any) -> str:
    return str(getattr(message, "__msgtype__", type(message).__name__))
