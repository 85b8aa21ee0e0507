# SPDX-License-Identifier: Apache-2.0
"""Rigid motions with covariance to PoseStamped, PoseWithCovarianceStamped and Odometry, and back.

`frame_id` is the target optical frame and the pose is that of the source camera in it: p_target = R p_source + t.
`stamp` is that of the source image. Covariances are 6x6 in the ROS order and meaning: x, y, z in m, then small
rotations about the fixed X, Y, Z axes in rad. Every scalar passes float(), int() or str(): Jazzy does not check
types, and publishes garbage for a numpy float32 or an int.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import numpy.typing as npt

from msg_adapters.errors import MessageError
from msg_adapters.fields import checked_name, field, make_header, numbers
from msg_adapters.rotations import matrix_from_quaternion, quaternion_from_matrix

Float64Array = npt.NDArray[np.float64]

SMALLEST_VARIANCE = 1e-12
"""A micrometre or a microradian: no camera is that certain, so less is a zero in disguise. (robot_localization
raises anything below 1e-9 to 1e-9.)"""
LARGEST_VARIANCE = 1e3
"""More is "extremely large" to robot_localization; it is also what Odometry says here for a twist nobody measured."""
SMALLEST_CORRELATION_EIGENVALUE = 1e-12


class PoseWriter:
    """Builds pose messages of one message library.

    Args:
        message_class: from a full name ("geometry_msgs/msg/Pose") to the class. With rosbags that is
            `typestore.types.__getitem__`, with rclpy an import. Classes are called with all fields by keyword,
            which is the one way that both understand.
    """

    def __init__(self, message_class: Callable[[str], Callable[..., Any]]) -> None:
        self._class = message_class

    def pose_stamped(self, T: npt.ArrayLike, stamp_ns: int, frame_id: str) -> Any:
        """A PoseStamped of the 4x4 motion T_target_source. Raises MessageError on a value that cannot be sent."""
        return self._make(
            "geometry_msgs/msg/PoseStamped", header=make_header(self._class, stamp_ns, frame_id), pose=self._pose(T)
        )

    def pose_with_covariance_stamped(
        self, T: npt.ArrayLike, covariance: npt.ArrayLike, stamp_ns: int, frame_id: str
    ) -> Any:
        """A PoseWithCovarianceStamped of T_target_source and its 6x6. Raises MessageError as `checked_covariance`."""
        return self._make(
            "geometry_msgs/msg/PoseWithCovarianceStamped",
            header=make_header(self._class, stamp_ns, frame_id),
            pose=self._pose_with_covariance(T, covariance),
        )

    def odometry(
        self, T: npt.ArrayLike, covariance: npt.ArrayLike, stamp_ns: int, frame_id: str, child_frame_id: str
    ) -> Any:
        """An Odometry of T_target_source, child_frame_id = source; its twist is 0 with variance 1e3: not measured."""
        nothing = self._make("geometry_msgs/msg/Vector3", x=0.0, y=0.0, z=0.0)
        return self._make(
            "nav_msgs/msg/Odometry",
            header=make_header(self._class, stamp_ns, frame_id),
            child_frame_id=checked_name("child_frame_id", child_frame_id),
            pose=self._pose_with_covariance(T, covariance),
            twist=self._make(
                "geometry_msgs/msg/TwistWithCovariance",
                twist=self._make("geometry_msgs/msg/Twist", linear=nothing, angular=nothing),
                covariance=np.diag([LARGEST_VARIANCE] * 6).ravel(),
            ),
        )

    def transform_stamped(self, T: npt.ArrayLike, stamp_ns: int, frame_id: str, child_frame_id: str) -> Any:
        """A TransformStamped of T_target_source, parent = target. Raises MessageError as `pose_stamped`."""
        pose = self._pose(T)
        at = {axis: getattr(pose.position, axis) for axis in "xyz"}
        return self._make(
            "geometry_msgs/msg/TransformStamped",
            header=make_header(self._class, stamp_ns, frame_id),
            child_frame_id=checked_name("child_frame_id", child_frame_id),
            transform=self._make(
                "geometry_msgs/msg/Transform",
                translation=self._make("geometry_msgs/msg/Vector3", **at),
                rotation=pose.orientation,
            ),
        )

    def _make(self, name: str, **fields: Any) -> Any:
        return self._class(name)(**fields)

    def _pose(self, T: npt.ArrayLike) -> Any:
        motion = _checked_motion(T)
        position = dict(zip("xyz", map(float, motion[:3, 3]), strict=True))
        orientation = dict(zip("xyzw", map(float, quaternion_from_matrix(motion[:3, :3])), strict=True))
        return self._make(
            "geometry_msgs/msg/Pose",
            position=self._make("geometry_msgs/msg/Point", **position),
            orientation=self._make("geometry_msgs/msg/Quaternion", **orientation),
        )

    def _pose_with_covariance(self, T: npt.ArrayLike, covariance: npt.ArrayLike) -> Any:
        flat = checked_covariance(covariance).ravel()
        return self._make("geometry_msgs/msg/PoseWithCovariance", pose=self._pose(T), covariance=flat)


def pose_from_message(message: Any) -> tuple[Float64Array, Float64Array | None]:
    """Read PoseStamped, PoseWithCovarianceStamped or Odometry as 4x4 motion and 6x6 covariance (None: has none).

    Raises:
        MessageError: NaN, a quaternion whose norm is not 1 (to 1e-3), a covariance `checked_covariance` refuses.
    """
    pose, covariance = field(message, "pose"), None
    if hasattr(pose, "covariance"):
        covariance = checked_covariance(numbers(pose, "covariance", count=36).reshape(6, 6))
        pose = field(pose, "pose")
    T = np.eye(4)
    T[:3, :3] = matrix_from_quaternion(_components(pose, "orientation", "xyzw"))
    T[:3, 3] = _components(pose, "position", "xyz")
    return T, covariance


def checked_covariance(covariance: npt.ArrayLike) -> Float64Array:
    """Return a 6x6 covariance as exactly symmetric float64, fit to be published.

    Raises:
        MessageError: not 6x6, not finite, not symmetric, a variance outside 1e-12..1e3 (zeros do not mean unknown:
            consumers read them as certainty), or not positive definite.
    """
    C = _as_floats("covariance", covariance, (6, 6))
    if np.abs(C - C.T).max() > 1e-6 * np.abs(C).max():
        raise MessageError(f"covariance is not symmetric: largest difference {np.abs(C - C.T).max():.3g}")
    variances = np.diag(C)
    if variances.min() < SMALLEST_VARIANCE or variances.max() > LARGEST_VARIANCE:
        raise MessageError(
            f"covariance has variances {variances.min():.3g}..{variances.max():.3g}: expected "
            f"{SMALLEST_VARIANCE:g}..{LARGEST_VARIANCE:g} m^2 or rad^2; zeros do not mean unknown"
        )
    C = 0.5 * (C + C.T)
    smallest = float(np.linalg.eigvalsh(C / np.sqrt(np.outer(variances, variances)))[0])
    if smallest < SMALLEST_CORRELATION_EIGENVALUE:
        raise MessageError(
            f"covariance is not positive definite: smallest eigenvalue of its correlations {smallest:.3g}"
        )
    return C


def _checked_motion(T: npt.ArrayLike) -> Float64Array:
    motion = _as_floats("pose", T, (4, 4))
    R = motion[:3, :3]
    if np.abs(R.T @ R - np.eye(3)).max() > 1e-6 or np.linalg.det(R) < 0 or (motion[3] != (0, 0, 0, 1)).any():
        raise MessageError("pose is no rigid motion: expected a right-handed rotation and last row 0, 0, 0, 1")
    return motion


def _as_floats(name: str, value: npt.ArrayLike, shape: tuple[int, int]) -> Float64Array:
    array = np.asarray(value, dtype=np.float64)
    if array.shape != shape:
        raise MessageError(f"{name} has shape {array.shape}: expected {shape[0]}x{shape[1]}")
    if not np.isfinite(array).all():
        raise MessageError(f"{name} holds NaN or infinity: expected finite numbers")
    return array


def _components(pose: Any, part: str, names: str) -> Float64Array:
    values = [field(field(pose, part), name) for name in names]
    try:
        array = np.array([float(value) for value in values])
    except (TypeError, ValueError):
        raise MessageError(f"{part} is {values}: expected numbers") from None
    if not np.isfinite(array).all():
        raise MessageError(f"{part} is {array.tolist()}: expected finite numbers")
    return array
