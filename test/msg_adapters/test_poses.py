# SPDX-License-Identifier: Apache-2.0
"""Poses to messages and back: no scalar of the wrong type, no covariance that lies, the same on every library."""

from types import SimpleNamespace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from ros_messages import ROS2, message_class
from scipy.spatial.transform import Rotation

from msg_adapters import MessageError, PoseWriter, checked_covariance, ns_to_stamp, pose_from_message, stamp_to_ns
from msg_adapters.poses import LARGEST_VARIANCE, SMALLEST_VARIANCE
from msg_adapters.rotations import matrix_from_quaternion, quaternion_from_matrix

LIBRARIES = ("namespace", "rosbags", "rclpy")  # poses are read from ROS 1 bags but never written to them
STAMP = 1_600_000_000_123_456_789
COVARIANCE = np.diag([1e-4, 2e-4, 3e-4, 4e-5, 5e-5, 6e-5]) + 1e-5


def motion(rotvec=(0.1, -0.2, 0.3), t=(1.0, -2.0, 5.0)):
    T = np.eye(4)
    T[:3, :3] = Rotation.from_rotvec(rotvec).as_matrix()
    T[:3, 3] = t
    return T


T = motion()
ROTVECS = arrays(np.float64, 3, elements=st.floats(-np.pi, np.pi))
POSITIONS = arrays(np.float64, 3, elements=st.floats(-1e6, 1e6))


def write(library, kind, T=T, covariance=COVARIANCE, stamp_ns=STAMP, frame_id="target"):
    writer = PoseWriter(message_class(library))
    if kind == "pose_stamped":
        return writer.pose_stamped(T, stamp_ns, frame_id)
    if kind == "odometry":
        return writer.odometry(T, covariance, stamp_ns, frame_id, "source")
    return writer.pose_with_covariance_stamped(T, covariance, stamp_ns, frame_id)


KINDS = ("pose_stamped", "pose_with_covariance_stamped", "odometry")


@pytest.mark.parametrize("library", LIBRARIES)
@pytest.mark.parametrize("kind", KINDS)
def test_what_is_written_is_read_back(kind, library):
    message = write(library, kind)
    got, covariance = pose_from_message(message)
    np.testing.assert_allclose(got, T, atol=1e-15)
    if kind == "pose_stamped":
        assert covariance is None
    else:
        np.testing.assert_array_equal(covariance, COVARIANCE)
    assert stamp_to_ns(message.header.stamp) == STAMP and message.header.frame_id == "target"


def leaves(message, path=""):
    """Every scalar of a message with its path."""
    fields = message.get_fields_and_field_types() if hasattr(message, "get_fields_and_field_types") else vars(message)
    for name in fields:
        value = getattr(message, name)
        if hasattr(value, "__dict__") or hasattr(value, "get_fields_and_field_types"):
            yield from leaves(value, f"{path}.{name}")
        else:
            yield f"{path}.{name}", value


@pytest.mark.parametrize("library", LIBRARIES)
@pytest.mark.parametrize("kind", KINDS)
def test_every_scalar_has_exactly_the_python_type(kind, library):
    numpy_inputs = {"T": T.astype(np.float32), "stamp_ns": np.int64(STAMP), "frame_id": np.str_("target")}
    numpy_inputs["T"][:3, :3] = np.eye(3)
    for path, value in leaves(write(library, kind, **numpy_inputs)):
        if path.endswith("covariance"):
            assert isinstance(value, np.ndarray) and value.dtype == np.float64 and value.shape == (36,)
        else:
            expected = int if path.endswith("sec") else str if "frame_id" in path or "msgtype" in path else float
            assert type(value) is expected, path


@pytest.mark.parametrize("kind", KINDS)
def test_written_messages_survive_serialisation(kind):
    name = {"pose_stamped": "geometry_msgs/msg/PoseStamped", "odometry": "nav_msgs/msg/Odometry"}
    name = name.get(kind, "geometry_msgs/msg/PoseWithCovarianceStamped")
    raw = ROS2.serialize_cdr(write("rosbags", kind), name)
    got, covariance = pose_from_message(ROS2.deserialize_cdr(raw, name))
    np.testing.assert_allclose(got, T, atol=1e-15)
    assert (covariance is None) == (kind == "pose_stamped")


def test_what_rclpy_sends_is_what_rosbags_would_send():
    """Compared after decoding: the bytes that pad strings to a multiple of four are not defined."""
    serialization = pytest.importorskip("rclpy.serialization")
    sent = ROS2.deserialize_cdr(
        bytes(serialization.serialize_message(write("rclpy", "odometry"))), "nav_msgs/msg/Odometry"
    )
    for (path, ours), (_, theirs) in zip(leaves(write("rosbags", "odometry")), leaves(sent), strict=True):
        np.testing.assert_array_equal(ours, theirs, err_msg=path)


def test_field_checks_of_rclpy_are_on():
    """What the suite relies on: without them a wrong scalar type would pass unseen."""
    pytest.importorskip("rclpy")
    with pytest.raises(AssertionError, match="must be of type 'float'"):
        message_class("rclpy")("geometry_msgs/msg/Point")(x=1)


def test_pose_is_that_of_the_source_camera_in_the_target_frame():
    """A camera 2 m to the right of the target camera has position x = +2 and maps its own origin there."""
    pose = write("namespace", "pose_stamped", T=motion((0, 0, 0), (2, 0, 0))).pose
    assert (pose.position.x, pose.position.y, pose.position.z) == (2.0, 0.0, 0.0)
    turned = write("namespace", "pose_stamped", T=motion((0, 0, np.pi / 2), (0, 0, 0))).pose.orientation
    np.testing.assert_allclose((turned.x, turned.y, turned.z, turned.w), (0, 0, np.sqrt(0.5), np.sqrt(0.5)))


def test_odometry_names_the_child_and_does_not_claim_a_velocity():
    message = write("rosbags", "odometry")
    assert message.child_frame_id == "source"
    assert message.twist.twist.linear.x == message.twist.twist.angular.z == 0.0
    np.testing.assert_array_equal(message.twist.covariance.reshape(6, 6), np.diag([LARGEST_VARIANCE] * 6))


@given(ROTVECS, POSITIONS)
def test_any_motion_survives_the_round_trip(rotvec, t):
    wanted = motion(rotvec, t)
    message = write("namespace", "pose_stamped", T=wanted)
    q = message.pose.orientation
    assert abs(np.linalg.norm([q.x, q.y, q.z, q.w]) - 1) < 1e-12 and q.w >= 0
    np.testing.assert_allclose(pose_from_message(message)[0], wanted, atol=1e-12)


@given(ROTVECS)
def test_quaternions_agree_with_scipy(rotvec):
    rotation = Rotation.from_rotvec(rotvec)
    ours, theirs = quaternion_from_matrix(rotation.as_matrix()), rotation.as_quat()
    assert abs(abs(ours @ theirs) - 1) < 1e-12
    np.testing.assert_allclose(matrix_from_quaternion(theirs), rotation.as_matrix(), atol=1e-12)


@pytest.mark.parametrize("axis", np.vstack([np.eye(3), -np.eye(3), [[0.6, -0.8, 0], [-0.6, 0, 0.8]]]))
def test_half_turns_have_one_quaternion(axis):
    """At w = 0 both signs are right; the first part that is not zero decides, so that q and -q never alternate."""
    q = quaternion_from_matrix(2 * np.outer(axis, axis) - np.eye(3))
    assert q[3] == 0 and q[np.abs(q) > 0][0] > 0 and not np.signbit(q[q == 0]).any()
    np.testing.assert_allclose(np.abs(q[:3]), np.abs(axis), atol=1e-12)


@given(st.integers(0, (2**31 - 1) * 10**9 + 10**9 - 1))
def test_stamps_survive_the_round_trip(stamp_ns):
    sec, nanosec = ns_to_stamp(stamp_ns)
    assert stamp_to_ns(SimpleNamespace(sec=sec, nanosec=nanosec)) == stamp_ns


@given(arrays(np.float64, (6, 6), elements=st.floats(-1, 1)), arrays(np.float64, 6, elements=st.floats(1e-3, 1)))
def test_any_well_conditioned_covariance_passes_unchanged(A, scale):
    C = (A @ A.T + 0.1 * np.eye(6)) * np.outer(scale, scale)
    got = checked_covariance(C)
    np.testing.assert_allclose(got, C, rtol=1e-12, atol=1e-18)
    assert (got == got.T).all()


@given(arrays(np.float64, 36, elements=st.floats(allow_nan=True, allow_infinity=True)))
def test_a_covariance_is_refused_or_honest(values):
    try:
        C = checked_covariance(values.reshape(6, 6))
    except MessageError:
        return
    assert np.isfinite(C).all() and np.linalg.eigvalsh(C).min() > 0 and np.diag(C).min() >= SMALLEST_VARIANCE


def spoilt(**changes):
    """COVARIANCE with entries replaced: c01 = value."""
    C = COVARIANCE.copy()
    for name, value in changes.items():
        C[int(name[1]), int(name[2])] = value
    return C


BAD_COVARIANCES = {
    "zeros": (np.zeros((6, 6)), r"variances 0\.\.0: expected 1e-12\.\.1000 .*zeros do not mean unknown"),
    "one zero": (np.diag([1e-4, 1e-4, 0, 1e-5, 1e-5, 1e-5]), r"variances 0\.\.0\.0001"),
    "identity marker -1": (np.diag([-1.0, 1, 1, 1, 1, 1]), r"variances -1\.\.1"),
    "too certain": (np.diag([1e-13] + [1e-4] * 5), r"variances 1e-13"),
    "too large": (np.diag([1e4] + [1e-4] * 5), r"\.\.1e\+04"),
    "as if unknown": (np.diag([1e308] * 6), "1e308|1e\\+308"),
    "NaN": (spoilt(c01=np.nan), "covariance holds NaN or infinity"),
    "infinite": (spoilt(c22=np.inf), "covariance holds NaN or infinity"),
    "not symmetric": (spoilt(c01=5e-5), "not symmetric: largest difference 4e-05"),
    "indefinite": (spoilt(c01=1e-3, c10=1e-3), "not positive definite"),
    "rank one": (np.full((6, 6), 1e-4), "not positive definite"),
    "flat": (np.eye(6).ravel(), "shape .36,.: expected 6x6"),
}


@pytest.mark.parametrize("name", BAD_COVARIANCES)
@pytest.mark.parametrize("kind", KINDS[1:])
def test_a_covariance_that_lies_is_not_written(name, kind):
    covariance, expected = BAD_COVARIANCES[name]
    with pytest.raises(MessageError, match=expected):
        write("rosbags", kind, covariance=covariance)


BAD_WRITES = {
    "NaN position": ({"T": motion(t=(np.nan, 0, 0))}, "pose holds NaN or infinity"),
    "infinite position": ({"T": motion(t=(np.inf, 0, 0))}, "pose holds NaN or infinity"),
    "scaled rotation": ({"T": np.diag([2.0, 2, 2, 1])}, "pose is no rigid motion"),
    "mirrored": ({"T": np.diag([1.0, 1, -1, 1])}, "pose is no rigid motion"),
    "last row": ({"T": np.vstack([T[:3], [0, 0, 0, 2]])}, "pose is no rigid motion"),
    "three rows": ({"T": T[:3]}, r"pose has shape \(3, 4\): expected 4x4"),
    "stamp negative": ({"stamp_ns": -1}, "stamp is -1 ns: expected"),
    "stamp float": ({"stamp_ns": 1.6e18}, "stamp is 1.6e[+]18: expected integer nanoseconds"),
    "stamp beyond int32": ({"stamp_ns": 2**31 * 10**9}, "is it in another unit"),
    "frame empty": ({"frame_id": ""}, "frame_id is '': expected the name of a frame"),
    "frame none": ({"frame_id": None}, "frame_id is None"),
}


@pytest.mark.parametrize("name", BAD_WRITES)
def test_what_cannot_be_a_pose_is_not_written(name):
    fields, expected = BAD_WRITES[name]
    with pytest.raises(MessageError, match=expected):
        write("rosbags", "pose_stamped", **fields)


def test_odometry_needs_a_child_frame():
    with pytest.raises(MessageError, match="child_frame_id is ''"):
        PoseWriter(message_class("rosbags")).odometry(T, COVARIANCE, STAMP, "target", "")


def read(position=(1.0, 2.0, 3.0), orientation=(0.0, 0.0, 0.0, 1.0), covariance=None):
    pose = SimpleNamespace(
        position=SimpleNamespace(**dict(zip("xyz", position, strict=True))),
        orientation=SimpleNamespace(**dict(zip("xyzw", orientation, strict=True))),
    )
    return SimpleNamespace(pose=pose if covariance is None else SimpleNamespace(pose=pose, covariance=covariance))


BAD_READS = {
    "quaternion never set": (read(orientation=(0.0,) * 4), "orientation has norm 0: .*was it ever set"),
    "quaternion too long": (read(orientation=(0.0, 0.0, 0.0, 1.01)), "orientation has norm 1.01"),
    "quaternion NaN": (read(orientation=(0.0, 0.0, 0.0, np.nan)), "orientation is .*expected finite"),
    "quaternion text": (read(orientation=("a", 0.0, 0.0, 1.0)), "orientation is .*expected numbers"),
    "position infinite": (read(position=(np.inf, 0.0, 0.0)), "position is .*expected finite"),
    "position list": (read(position=([1.0], 0.0, 0.0)), "position is .*expected numbers"),
    "covariance short": (read(covariance=[0.1] * 35), "covariance has shape .35,.: expected 36"),
    "covariance zeros": (read(covariance=[0.0] * 36), "zeros do not mean unknown"),
    "covariance NaN": (read(covariance=[np.nan] * 36), "covariance holds NaN"),
    "no pose": (SimpleNamespace(), "has no field 'pose'"),
    "no orientation": (SimpleNamespace(pose=SimpleNamespace(position=1)), "has no field 'orientation'"),
}


@pytest.mark.parametrize("name", BAD_READS)
def test_malformed_poses_are_refused_by_name(name):
    message, expected = BAD_READS[name]
    with pytest.raises(MessageError, match=expected):
        pose_from_message(message)


def test_a_slightly_rounded_quaternion_is_normalised():
    got, _ = pose_from_message(read(orientation=(0.0, 0.0, 0.70711, 0.70711)))
    np.testing.assert_allclose(got[:3, :3].T @ got[:3, :3], np.eye(3), atol=1e-15)
