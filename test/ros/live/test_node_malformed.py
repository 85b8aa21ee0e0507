# SPDX-License-Identifier: Apache-2.0
"""Malformed messages on a real graph: the node says why, publishes no pose for them, and goes on with the next pair."""

import array
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import cv2
import numpy as np
import pytest
import ros_messages
from graph import SECOND, SIZE, NodeProcess, Peer, Rig, private_domain, room_pair

PoseStamped = pytest.importorskip("geometry_msgs.msg").PoseStamped
PoseWithCovarianceStamped = pytest.importorskip("geometry_msgs.msg").PoseWithCovarianceStamped


class Trial:
    """A node that has answered a first pair, its cameras, and its diagnostics."""

    def __init__(self, node: NodeProcess, peer: Peer, **how: str) -> None:
        self.node, self.peer = node, peer
        self.rig = Rig(peer, room_pair(), **how)
        self.priors = peer.publisher(PoseWithCovarianceStamped, "/pose_node/prior")
        self.poses = peer.collect(PoseStamped, "/pose_node/pose")
        # Nothing is sent before: Fast DDS 2.14 can loop for ever in a reliable reader that joins large messages midway.
        peer.wait(lambda: str(self.values("inputs")).count("RELIABLE") == 3, what="subscriptions to be final")
        peer.matched(self.priors, *self.rig.source.publishers, *self.rig.target.publishers)
        self.rig.publish_until(lambda: self.poses, "a first pose")
        self.settle()

    def values(self, part: str) -> dict[str, str]:
        return self.peer.diagnostics().get(f"pose_node: {part}", (0, "", {}))[2]

    def settle(self) -> None:
        """Forget the poses of pairs that were still under way."""
        self.peer.spin(1.5)
        self.poses.clear()

    def complaints(self) -> dict[str, tuple[int, str]]:
        """Number of messages refused and of pairs rejected, each with its last reason."""
        inputs, estimates = self.values("inputs"), self.values("estimates")
        rejected = sum(int(count) for name, count in estimates.items() if name.startswith("rejected: "))
        return {
            "refused": (int(inputs["messages refused"]), inputs["last refused"]),
            "rejected": (rejected, estimates["last rejected"]),
        }

    def send(self, source, target) -> None:
        """Publish a pair; the calibration a little earlier: messages of different topics may overtake each other."""
        for camera, shot in ((self.rig.source, source), (self.rig.target, target)):
            camera.camera_info.publish(shot.camera_info)
        self.peer.spin(0.1)
        for camera, shot in ((self.rig.source, source), (self.rig.target, target)):
            camera.image.publish(shot.image)
            camera.depth.publish(shot.depth)

    def pair(self):
        """Messages of a good pair with a new stamp."""
        stamp_ns = self.rig.next_stamp(SECOND)
        return self.rig.source.shot(stamp_ns), self.rig.target.shot(stamp_ns)

    def complains(self, kind: str, before: int, reason: str) -> None:
        def said() -> bool:
            count, text = self.complaints()[kind]
            return count > before and reason in text

        self.peer.wait(said, 6, f"{kind}: {reason!r}")

    def answers(self) -> None:
        """The next good pair gets its pose, and it is the only pose since the last look."""
        source, target = self.pair()
        self.send(source, target)
        self.peer.wait(lambda: self.poses, 15, "the pose of a good pair")
        assert [pose.header.stamp for _, pose in self.poses] == [source.image.header.stamp]
        self.poses.clear()


@contextmanager
def trial(folder: Path, settings: list[str], **how: str) -> Iterator[Trial]:
    arguments = ["--ros-args", "-p", "lifting.stride:=4", *settings]
    with (
        private_domain(folder) as domain,
        NodeProcess(arguments, domain.environment, folder / "node.log") as node,
        Peer(domain) as peer,
    ):
        yield Trial(node, peer, **how)


@pytest.fixture(scope="module")
def raw(tmp_path_factory):
    with trial(tmp_path_factory.mktemp("raw"), []) as node:
        yield node


@pytest.fixture(scope="module")
def compressed(tmp_path_factory):
    settings = ["-p", "image_transport:=compressed", "-p", "depth_transport:=compressedDepth"]
    with trial(tmp_path_factory.mktemp("compressed"), settings, colour="jpeg", depth="compressedDepth") as node:
        yield node


def octets(data: bytes) -> array.array:
    return array.array("B", data)


def head_of(message) -> dict:
    return {"stamp_ns": message.header.stamp.sec * SECOND + message.header.stamp.nanosec, "frame_id": "source_optical"}


def of_image(**fields):
    """A change of the source image's fields; functions are given the old value."""
    return lambda shot: change(shot.image, fields)


def of_depth(**fields):
    return lambda shot: change(shot.depth, fields)


def of_info(**fields):
    return lambda shot: change(shot.camera_info, fields)


def of_stamp(part, **fields):
    return lambda shot: change(getattr(shot, part).header.stamp, fields)


def change(message, fields):
    for name, value in fields.items():
        setattr(message, name, value(getattr(message, name)) if callable(value) else value)


def depth(pixels, encoding="32FC1"):
    """The source depth replaced by other pixels."""

    def replace(shot):
        shot.depth = ros_messages.image(pixels, encoding, "rclpy", **head_of(shot.depth))

    return replace


def metres(value):
    return np.full(SIZE[::-1], value, np.float32)


def in_millimetres(shot):
    mm = np.frombuffer(shot.depth.data, np.uint16).reshape(SIZE[::-1])
    depth(mm.astype(np.float32))(shot)


def swapped(shot):
    shot.image, shot.depth = shot.depth, shot.image


def tiny(shot):
    """Image, depth and calibration all of 8x8."""
    head = head_of(shot.image)
    shot.image = ros_messages.image(np.full((8, 8, 3), 90, np.uint8), "rgb8", "rclpy", **head)
    shot.depth = ros_messages.image(np.full((8, 8), 2000, np.uint16), "16UC1", "rclpy", **head)
    K = [[8.0, 0, 3.5], [0, 8.0, 3.5], [0, 0, 1]]
    shot.camera_info = ros_messages.camera_info("rclpy", (8, 8), K=K, D=[0.0] * 5, model="plumb_bob", **head)


def earlier(shot):
    """Half a second before the pair before."""
    for message in (shot.image, shot.depth):
        message.header = ros_messages.header("rclpy", head_of(message)["stamp_ns"] - 3 * SECOND // 2, "source_optical")


def with_K(change_K):
    def spoiled(k):
        K = np.array(k)
        change_K(K)
        return K

    return of_info(k=spoiled)


def put(index, value):
    return lambda array_: array_.__setitem__(index, value)


def coefficients(*values):
    return array.array("d", values)


REFUSED = {
    "image stamp zero": (of_stamp("image", sec=0, nanosec=0), "/source/image: header.stamp is zero"),
    "depth stamp zero": (of_stamp("depth", sec=0, nanosec=0), "/source/depth: header.stamp is zero"),
    "nanoseconds of two seconds": (of_stamp("image", nanosec=2_000_000_000), "nanosec is 2000000000"),
    "nanoseconds of a wrapped -1": (of_stamp("depth", nanosec=2**32 - 1), "nanosec is 4294967295"),
    "seconds before 1970": (of_stamp("image", sec=-5), "/source/image: sec is -5: expected 0.."),
    "stamps half a second back": (earlier, "is not later than the one before"),
}
REJECTED = {
    "step shorter than a row": (of_image(step=100), "malformed_message: step is 100: expected at least 960"),
    "step zero": (of_image(step=0), "malformed_message: step is 0"),
    "step of pixels, not bytes": (of_depth(step=SIZE[0]), "malformed_message: step is 320: expected at least 640"),
    "one byte short": (of_image(data=lambda data: data[:-1]), "malformed_message: data has 230399 bytes"),
    "one byte too many": (of_image(data=lambda data: data + octets(b"x")), "malformed_message: data has 230401"),
    "no data": (of_image(data=octets(b"")), "malformed_message: data has 0 bytes"),
    "depth cut short": (of_depth(data=lambda data: data[:1000]), "malformed_message: data has 1000 bytes"),
    "unknown encoding": (of_image(encoding="yuv_of_mine"), "malformed_message: encoding is 'yuv_of_mine'"),
    "no encoding": (of_image(encoding=""), "malformed_message: encoding is ''"),
    "endianness seven": (of_depth(is_bigendian=7), "malformed_message: is_bigendian is 7"),
    "width zero": (of_image(width=0), "malformed_message: width is 0"),
    "height of four billion": (of_image(height=2**32 - 1), "malformed_message: height is 4294967295"),
    "image and depth swapped": (swapped, "malformed_message: encoding is '16UC1': expected a colour encoding"),
    "eight by eight pixels": (tiny, "invalid_input: "),
    "depth of another size": (
        depth(np.full((120, 160), 2.0, np.float32)),
        "malformed_message: depth is 160x120: expected 320x240",
    ),
    "depth as colour": (depth(np.zeros((*SIZE[::-1], 3), np.uint8), "rgb8"), "encoding is 'rgb8': expected a depth"),
    "depth in millimetres as 32FC1": (in_millimetres, "this looks like millimetres; expected metres"),
    "depth all NaN": (depth(metres(np.nan)), "no_mixture: "),
    "depth all zero": (depth(np.zeros(SIZE[::-1], np.uint16), "16UC1"), "no_mixture: "),
    "depth all infinite": (depth(metres(np.inf)), "no_mixture: "),
    "depth of the other byte order": (of_depth(is_bigendian=1), "no_mixture: the view has"),
    "depth negative": (depth(metres(-2.0)), "invalid_input: "),
    "camera_info of another size": (of_info(width=640, height=480), "camera_info describes 640x480"),
    "camera_info of another shape": (of_info(width=640), "this is another camera or a cropped image"),
    "camera_info without size": (of_info(width=0, height=0), "malformed_message: camera_info is 0x0"),
    "NaN in k": (with_K(put(0, np.nan)), "malformed_message: k holds NaN"),
    "k all zero": (of_info(k=np.zeros(9)), "malformed_message: k[0] is 0"),
    "k negative": (with_K(put(4, -280.0)), "malformed_message: k has focal lengths"),
    "k transposed": (of_info(k=lambda k: k.reshape(3, 3).T.ravel()), "is it transposed?"),
    "three coefficients": (of_info(d=coefficients(0.1, 0, 0)), "malformed_message: d has 3 coefficients"),
    "NaN coefficient": (of_info(d=coefficients(np.nan, 0, 0, 0, 0)), "malformed_message: d holds NaN"),
    "unknown distortion model": (
        of_info(distortion_model="banana", d=coefficients(0.1)),
        "malformed_message: distortion_model is 'banana'",
    ),
    "coefficients beyond any lens": (of_info(d=coefficients(-1e6, 1e9, 0, 0, 0)), "no_mixture: the view has"),
    "binning of a thousand": (of_info(binning_x=1000), "malformed_message: binning_x is 1000"),
    "window outside": (
        lambda shot: change(shot.camera_info.roi, {"x_offset": 300, "width": 100, "height": 100}),
        "malformed_message: roi is 100x100 at (300, 0)",
    ),
}


@pytest.mark.parametrize("name", REFUSED)
def test_a_message_without_a_usable_time_is_refused(raw, name):
    spoil, reason = REFUSED[name]
    check(raw, "refused", spoil, reason)


@pytest.mark.parametrize("name", REJECTED)
def test_a_pair_that_is_no_pair_of_views_is_rejected(raw, name):
    spoil, reason = REJECTED[name]
    check(raw, "rejected", spoil, reason)


def check(trial: Trial, kind: str, spoil, reason: str) -> None:
    """One spoiled source shot: the reason is on /diagnostics, no pose, no traceback, and the next pair is answered."""
    before, _ = trial.complaints()[kind]
    source, target = trial.pair()
    spoil(source)
    trial.send(source, target)
    trial.peer.spin(0.05)
    trial.answers()
    trial.complains(kind, before, reason)
    assert trial.poses == []
    assert trial.node.process.poll() is None
    assert "Traceback" not in trial.node.log()


def jpeg(pixels) -> array.array:
    return octets(cv2.imencode(".jpg", pixels)[1].tobytes())


def png(pixels) -> array.array:
    return octets(cv2.imencode(".png", pixels)[1].tobytes())


def bomb() -> array.array:
    """A png that says 30000x30000."""
    data = bytearray(png(np.zeros((8, 8, 3), np.uint8)))
    data[16:24] = (30000).to_bytes(4, "big") * 2
    return octets(bytes(data))


COMPRESSED = {
    "jpeg cut in half": (of_image(data=lambda data: data[: len(data) // 2]), "malformed_message: "),
    "no data": (of_image(data=octets(b"")), "malformed_message: data starts with nothing"),
    "gif": (of_image(data=octets(b"GIF89a" + bytes(100))), "malformed_message: data starts with 47494638"),
    "noise behind a jpeg's first bytes": (of_image(data=octets(b"\xff\xd8\xff" + bytes(1000))), "malformed_message: "),
    "another size than camera_info": (
        of_image(data=jpeg(np.zeros((120, 160, 3), np.uint8))),
        "image is 160x120 but camera_info describes 320x240",
    ),
    "30000x30000 by its header": (of_image(data=bomb()), "malformed_message: "),
    "depth on the image topic": (of_image(format="16UC1; compressedDepth png"), "expected colour as jpeg or png"),
    "depth cut in its header": (of_depth(data=octets(bytes(7))), "malformed_message: data has 7 bytes"),
    "depth of 8 bit": (
        of_depth(data=octets(bytes(12)) + png(np.zeros(SIZE[::-1], np.uint8))),
        "malformed_message: data holds 8 bit or colour samples",
    ),
    "depth with a header of zeros": (of_depth(format="32FC1; compressedDepth png"), "header has parameters 0, 0"),
    "depth as rvl": (of_depth(format="16UC1; compressedDepth rvl"), "format is '16UC1; compressedDepth rvl'"),
}


@pytest.mark.parametrize("name", COMPRESSED)
def test_a_compressed_image_that_is_broken_is_rejected(compressed, name):
    spoil, reason = COMPRESSED[name]
    check(compressed, "rejected", spoil, reason)


def prior(stamp_ns, frame_id="target_optical", quaternion=(0.0, 0.0, 0.0, 1.0), x=0.0, covariance=None):
    message = PoseWithCovarianceStamped(header=ros_messages.header("rclpy", stamp_ns, frame_id))
    pose = message.pose.pose
    pose.position.x = x
    pose.orientation.x, pose.orientation.y, pose.orientation.z, pose.orientation.w = quaternion
    message.pose.covariance = (np.diag([0.04] * 3 + [0.04] * 3) if covariance is None else covariance).ravel()
    return message


PRIORS = {
    "no covariance": ({"covariance": np.zeros((6, 6))}, "zeros do not mean unknown"),
    "negative variance": ({"covariance": -np.eye(6)}, "covariance has variances -1"),
    "not positive definite": ({"covariance": np.ones((6, 6))}, "covariance is not positive definite"),
    "NaN position": ({"x": float("nan")}, "position is [nan, 0.0, 0.0]: expected finite"),
    "NaN covariance": ({"covariance": np.full((6, 6), np.nan)}, "covariance holds NaN"),
    "quaternion of length two": ({"quaternion": (0.0, 0.0, 0.0, 2.0)}, "quaternion"),
    "quaternion of zeros": ({"quaternion": (0.0, 0.0, 0.0, 0.0)}, "quaternion"),
}


@pytest.mark.parametrize("name", PRIORS)
def test_a_prior_that_cannot_be_used_is_refused_and_the_pair_answered_without(raw, name):
    fields, reason = PRIORS[name]
    before, _ = raw.complaints()["refused"]
    raw.priors.publish(prior(raw.rig.stamp_ns + SECOND, **fields))
    raw.answers()
    raw.complains("refused", before, reason)
    assert raw.values("estimates")["prior"] == "none"


def test_a_prior_in_another_frame_is_not_used(raw):
    raw.priors.publish(prior(raw.rig.stamp_ns + SECOND, frame_id="base_link"))
    raw.answers()
    raw.peer.wait(lambda: "prior is in frame 'base_link'" in raw.values("estimates")["prior"], what="the reason")


def test_a_good_prior_is_used_after_all_those(raw):
    raw.priors.publish(prior(raw.rig.stamp_ns + SECOND))
    raw.answers()
    raw.peer.wait(lambda: raw.values("estimates")["prior"] == "used", what="the prior to be used")


def test_a_prior_before_1970_is_refused_on_arrival(raw):
    before, _ = raw.complaints()["refused"]
    message = prior(raw.rig.stamp_ns)
    message.header.stamp.sec = -1
    raw.priors.publish(message)
    raw.complains("refused", before, "prior: sec is -1")


def test_images_without_frame_ids_are_named_after_their_topics(raw):
    source, target = raw.pair()
    for shot in (source, target):
        for message in (shot.image, shot.depth, shot.camera_info):
            message.header.frame_id = ""
    raw.send(source, target)
    raw.peer.wait(lambda: raw.poses, what="a pose")
    assert raw.poses[0][1].header.frame_id == "target_image"
    raw.poses.clear()
    raw.answers()


@pytest.mark.parametrize("hours", [-1, 1000], ids=["back", "forth"])
def test_one_stamp_of_another_time_costs_at_most_a_pair(raw, hours):
    source, target = raw.pair()
    source.image.header.stamp.sec += 3600 * hours
    raw.send(source, target)
    raw.peer.spin(0.5)
    assert raw.poses == []
    raw.send(*raw.pair())
    raw.settle()
    raw.answers()
