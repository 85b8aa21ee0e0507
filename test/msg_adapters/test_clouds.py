# SPDX-License-Identifier: Apache-2.0
"""Point clouds: decoded by the fields they declare they hold what was given; what cannot be shown is refused."""

import array

import numpy as np
import pytest
from ros_messages import ROS2, message_class

from msg_adapters import CloudWriter, MessageError, stamp_to_ns
from msg_adapters.clouds import MAX_POINTS

LIBRARIES = ("namespace", "rosbags", "rclpy")
STAMP = 1_600_000_000_123_456_789
POINTS = np.array([[1.0, -2.0, 3.5], [0.0, 0.25, 1e4], [-7.5, 1e-3, 0.5]])
COLOURS = np.array([[255, 128, 1], [0, 0, 0], [3, 255, 200]], np.uint8)


def write(library, points=POINTS, colours=COLOURS, stamp_ns=STAMP, frame_id="target"):
    return CloudWriter(message_class(library)).point_cloud(points, colours, stamp_ns, frame_id)


def decoded(cloud):
    """Points Nx3 float32 and colours Nx3 uint8, read by nothing but the message's own description."""
    sizes = {7: np.dtype(">f4" if cloud.is_bigendian else "<f4")}
    layout = np.dtype(
        {
            "names": [field.name for field in cloud.fields],
            "formats": [sizes[field.datatype] for field in cloud.fields],
            "offsets": [field.offset for field in cloud.fields],
            "itemsize": cloud.point_step,
        }
    )
    records = np.frombuffer(cloud.data, layout)
    assert len(records) == cloud.width * cloud.height and cloud.row_step == cloud.point_step * cloud.width
    bits = np.ascontiguousarray(records["rgb"]).view(np.uint32)
    return np.stack([records[axis] for axis in "xyz"], axis=1), np.stack(
        [bits >> shift & 255 for shift in (16, 8, 0)], axis=1
    )


@pytest.mark.parametrize("library", LIBRARIES)
def test_what_is_written_is_read_back(library):
    cloud = write(library)
    points, colours = decoded(cloud)
    np.testing.assert_array_equal(points, POINTS.astype(np.float32))
    np.testing.assert_array_equal(colours, COLOURS)
    assert stamp_to_ns(cloud.header.stamp) == STAMP and cloud.header.frame_id == "target"
    assert cloud.height == 1 and cloud.is_dense is True and isinstance(cloud.data, array.array)


def test_the_highest_byte_of_a_colour_is_empty():
    """0x00RRGGBB: RViz shows the lower three bytes, PCL takes the highest as alpha of another type."""
    bits = np.frombuffer(write("namespace").data, np.uint32).reshape(-1, 4)[:, 3]
    assert [hex(value) for value in bits] == ["0xff8001", "0x0", "0x3ffc8"]


def test_ros_own_reader_of_constants_agrees():
    point_field = pytest.importorskip("sensor_msgs.msg").PointField
    assert {field.datatype for field in write("rclpy").fields} == {point_field.FLOAT32}
    assert [(field.name, field.offset, field.count) for field in write("rclpy").fields] == [
        *(("x", 0, 1), ("y", 4, 1), ("z", 8, 1), ("rgb", 12, 1)),
    ]


def test_it_survives_the_wire():
    serialization = pytest.importorskip("rclpy.serialization")
    sent = bytes(serialization.serialize_message(write("rclpy")))
    points, colours = decoded(ROS2.deserialize_cdr(sent, "sensor_msgs/msg/PointCloud2"))
    np.testing.assert_array_equal(points, POINTS.astype(np.float32))
    np.testing.assert_array_equal(colours, COLOURS)


def test_input_of_any_float_and_any_memory_order():
    rng = np.random.default_rng(0)
    points = rng.normal(size=(3, 50)).astype(np.float32).T
    colours = rng.integers(0, 256, (100, 6), dtype=np.uint8)[::2, ::-2]
    for library in ("namespace", "rclpy"):
        got = decoded(write(library, points, colours, np.int64(STAMP), np.str_("target")))
        np.testing.assert_array_equal(got[0], points)
        np.testing.assert_array_equal(got[1], colours)


@pytest.mark.parametrize("library", LIBRARIES)
def test_no_points_is_an_empty_cloud(library):
    cloud = write(library, np.empty((0, 3)), np.empty((0, 3), np.uint8))
    assert cloud.width == 0 and len(cloud.data) == 0 and len(cloud.fields) == 4


def with_value(value):
    return np.where(np.arange(9).reshape(3, 3) == 4, value, POINTS)


@pytest.mark.parametrize(
    ("change", "says"),
    [
        ({"points": POINTS[:, :2]}, "expected Nx3"),
        ({"points": POINTS.ravel()}, "expected Nx3"),
        ({"points": [["a", "b", "c"]]}, "no array of numbers"),
        ({"points": [[1, 2, 3], [4]]}, "no array of numbers"),
        ({"points": with_value(np.nan)}, "1 of 3 points hold NaN or infinity"),
        ({"points": with_value(-np.inf)}, "1 of 3 points"),
        ({"points": with_value(1e39)}, "1 of 3 points"),
        ({"colours": COLOURS[:2]}, r"expected \(3, 3\) of uint8"),
        ({"colours": COLOURS[:, :1]}, "one row a point"),
        ({"colours": COLOURS / 255}, "of float64: expected"),
        ({"colours": COLOURS.astype(np.int64)}, "of int64: expected"),
        ({"frame_id": ""}, "expected the name of a frame"),
        ({"frame_id": None}, "expected the name of a frame"),
        ({"stamp_ns": -1}, "stamp is -1 ns"),
        ({"stamp_ns": 1.5}, "expected integer nanoseconds"),
    ],
)
def test_what_cannot_be_sent_is_refused(change, says):
    with pytest.raises(MessageError, match=says):
        write("namespace", **change)


def test_there_is_a_largest_cloud():
    points, colours = np.zeros((MAX_POINTS + 1, 3), np.float32), np.zeros((MAX_POINTS + 1, 3), np.uint8)
    with pytest.raises(MessageError, match="expected at most"):
        write("namespace", points, colours)


def test_the_points_are_given_as_the_array_that_rclpy_takes_whole():
    """Any other type is walked byte by byte by the field checks of rclpy: seconds for a dense cloud."""
    given = []

    def recording(name):
        kind = message_class("rclpy")(name)

        def made(**fields):
            given.append((name, fields))
            return kind(**fields)

        return made

    CloudWriter(recording).point_cloud(POINTS, COLOURS, STAMP, "target")
    data = [fields["data"] for name, fields in given if name == "sensor_msgs/msg/PointCloud2"]
    assert [(type(part), part.typecode) for part in data] == [(array.array, "B")]
