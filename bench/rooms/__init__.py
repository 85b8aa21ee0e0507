# SPDX-License-Identifier: Apache-2.0
"""Seeded indoor rooms with exact truth, for the demo, the tests and the benchmarks."""

from bench.rooms.depth import monocular_depth, sensor_depth
from bench.rooms.layout import make_room
from bench.rooms.mesh import LABELS
from bench.rooms.render import Rendering, Room
from bench.rooms.room_pair import LEVELS, RoomPair, look_at, make_pair, mutual_overlap

__all__ = [
    "LABELS", "LEVELS", "Rendering", "Room", "RoomPair", "look_at", "make_pair", "make_room", "monocular_depth",
    "mutual_overlap", "sensor_depth",
]  # fmt: skip
