# SPDX-License-Identifier: Apache-2.0
"""The results of a replay: trajectory.tum and poses.csv, written row by row, and a rosbag2, valid once closed.

Nothing in them depends on the time or place of the run: the same recording and settings give the same bytes.
"""

from __future__ import annotations

import csv
import shutil
from contextlib import ExitStack
from pathlib import Path
from typing import IO, Final

from rosbags.rosbag2 import StoragePlugin, Writer
from rosbags.typesys import Stores, get_typestore

from garps_core.checks import Float64Array
from garps_ros.estimates.outcomes import Row
from garps_ros.recording.bags import BagError
from msg_adapters import PoseWriter, ns_to_stamp

BAG_FOLDER, CSV_FILE = "poses", "poses.csv"
BAG_VERSION: Final = 9
TOPICS = {"/garps/pose": "geometry_msgs/msg/PoseStamped", "/garps/odometry": "nav_msgs/msg/Odometry"}
UPPER = [(i, j) for i in range(6) for j in range(i, 6)]
POSE_COLUMNS = ["tx", "ty", "tz", "qx", "qy", "qz", "qw"]
COLUMNS = [
    *("pair", "segment", "source_stamp_ns", "target_stamp_ns", "source_frame", "target_frame", "status", "reason"),
    *("overlap", "quality", *POSE_COLUMNS, *(f"c{i}{j}" for i, j in UPPER)),
]
TUM_HEADER = "# timestamp tx ty tz qx qy qz qw (s, m, unit quaternion)\n"


class Outputs:
    """Opens the three outputs in a folder; use it as a context manager.

    Args:
        folder: is made; may exist when it is empty, or when `overwrite` allows to replace the outputs in it.
        overwrite: remove what an earlier replay left in the folder (and nothing else).
    Raises:
        BagError: the folder is in use or cannot be written.
    """

    def __init__(self, folder: Path, overwrite: bool = False) -> None:
        self.folder = folder
        store = get_typestore(Stores.ROS2_JAZZY)
        self._serialize = store.serialize_cdr
        self._messages = PoseWriter(store.types.__getitem__)
        self._stack = ExitStack()
        self._trajectories: dict[int, IO[str]] = {}
        self._rows = 0
        try:
            self._prepare(overwrite)
            self._csv_file = self._stack.enter_context((folder / CSV_FILE).open("w", newline="", encoding="utf-8"))
            writer = Writer(folder / BAG_FOLDER, version=BAG_VERSION, storage_plugin=StoragePlugin.MCAP)
            self._bag = self._stack.enter_context(writer)
        except OSError as error:
            self._stack.close()
            raise BagError(f"cannot write to {folder}: {error.strerror or error}. Give another --out") from None
        self._connections = {
            topic: self._bag.add_connection(topic, kind, typestore=store) for topic, kind in TOPICS.items()
        }
        self._csv = csv.writer(self._csv_file, lineterminator="\n")
        self._csv.writerow(COLUMNS)

    def __enter__(self) -> Outputs:
        return self

    def __exit__(self, *_: object) -> None:
        self._stack.close()

    def write_row(self, row: Row) -> None:
        """Append a pair to poses.csv."""
        pose = ["" for _ in POSE_COLUMNS] if row.T_target_source is None else self._pose_text(row.T_target_source)
        C = row.covariance
        upper = ["" if C is None else f"{C[i, j]:.9e}" for i, j in UPPER]
        merits = ["" if merit is None else f"{merit:.6f}" for merit in (row.overlap, row.quality)]
        stamps = (row.source_stamp_ns, row.target_stamp_ns, row.source_frame, row.target_frame)
        self._csv.writerow([self._rows, row.segment, *stamps, row.status, row.reason, *merits, *pose, *upper])
        self._rows += 1
        self._csv_file.flush()

    def begin_trajectory(self, segment: int, frame_id: str, child_frame_id: str) -> None:
        """Begin the trajectory of a segment: trajectory.tum for 0 and 1, trajectory_2.tum and so on after."""
        name = "trajectory.tum" if segment <= 1 else f"trajectory_{segment}.tum"
        file = self._stack.enter_context((self.folder / name).open("w", encoding="utf-8"))
        file.write(f"# pose of camera {child_frame_id} in {frame_id}; optical frames: x right, y down, z forward\n")
        file.write(TUM_HEADER)
        file.flush()
        self._trajectories[segment] = file

    def write_trajectory(self, segment: int, stamp_ns: int, T: Float64Array) -> None:
        """Append a pose (4x4) to the trajectory of a segment."""
        sec, nanosec = ns_to_stamp(stamp_ns)
        file = self._trajectories[segment]
        file.write(f"{sec}.{nanosec:09d} {' '.join(self._pose_text(T))}\n")
        file.flush()

    def publish(
        self, T: Float64Array, covariance: Float64Array, stamp_ns: int, frame_id: str, child_frame_id: str
    ) -> None:
        """Append the pose to the bag, stamped with the source image's time.

        Raises:
            MessageError: a covariance or pose that must not be published; nothing is written then.
        """
        odometry = self._messages.odometry(T, covariance, stamp_ns, frame_id, child_frame_id)
        pose = self._messages.pose_stamped(T, stamp_ns, frame_id)
        for topic, message in (("/garps/pose", pose), ("/garps/odometry", odometry)):
            self._bag.write(self._connections[topic], stamp_ns, self._serialize(message, TOPICS[topic]))

    def _pose_text(self, T: Float64Array) -> list[str]:
        pose = self._messages.pose_stamped(T, 1, "any").pose
        q, p = pose.orientation, pose.position
        return [f"{value:.9f}" for value in (p.x, p.y, p.z, q.x, q.y, q.z, q.w)]

    def _prepare(self, overwrite: bool) -> None:
        if self.folder.exists() and (not self.folder.is_dir() or any(self.folder.iterdir())) and not overwrite:
            raise BagError(f"{self.folder} exists and is not empty: expected a new folder. Give another or --overwrite")
        self.folder.mkdir(parents=True, exist_ok=True)
        for old in (*self.folder.glob("trajectory*.tum"), self.folder / CSV_FILE):
            old.unlink(missing_ok=True)
        bag = self.folder / BAG_FOLDER
        if bag.exists():
            if not {path.name for path in bag.iterdir()} <= {"metadata.yaml", f"{BAG_FOLDER}.mcap"}:
                raise BagError(f"{bag} holds files that no replay has written: move it away or give another --out")
            shutil.rmtree(bag)
