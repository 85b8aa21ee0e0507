# SPDX-License-Identifier: Apache-2.0
"""The choice of a camera's topics in a recording: as asked for, or guessed from types, names and first messages."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace

from garps_ros.frames.frame import CameraTopics
from garps_ros.recording.bags import Bag, BagError

IMAGE_TYPES = ("sensor_msgs/msg/Image", "sensor_msgs/msg/CompressedImage")
INFO_TYPES = ("sensor_msgs/msg/CameraInfo",)
TRANSPORTS = ("compressed", "compressedDepth")
REGISTERED = ("aligned", "registered", "depth_to_rgb", "depth_to_color")


WITHOUT_DEPTH = (
    "or let a network do without: --reconstruction depth_anything_v2, whose weights "
    "`garps weights fetch depth-anything-v2-indoor-small` installs"
)


def choose_cameras(
    bag: Bag, source: CameraTopics, target: CameraTopics, pairing: str, depth: bool = True
) -> list[CameraTopics]:
    """Return the cameras to use: [source, target], or [source] when one camera is followed against its keyframes.

    Args:
        bag: an open recording.
        source: topics that were asked for; empty ones are guessed.
        target: topics of the second camera; empty ones are guessed.
        pairing: "cameras", "keyframe" or "auto" (two cameras when there are two).
        depth: whether every camera needs a depth topic; if not, none is used.
    Raises:
        BagError: a topic that is missing or of another type, no depth, or no one guess; lists what is there.
    """
    _check_given(bag, source, target)
    if not depth and (source.depth or target.depth):
        raise BagError(
            f"depth topic {source.depth or target.depth} is given, and --reconstruction names a network that does "
            "without: expected one of both"
        )
    if pairing == "keyframe" and target != CameraTopics():
        raise BagError("--pairing keyframe follows one camera: expected --source-... topics only")
    if pairing == "auto":
        pairing = _pairing(source, target, _cameras(bag, depth))
    if pairing == "keyframe":
        return [_completed(bag, source, "source", CameraTopics(), depth, alone=True)]
    # Without names the alphabetically first camera (left, cam0, ...) is the reference: the target.
    target = _completed(bag, target, "target", source, depth)
    source = _completed(bag, source, "source", target, depth)
    if source.image == target.image:
        raise BagError(f"source and target are both {source.image}: expected two cameras, or --pairing keyframe")
    return [source, target]


def _check_given(bag: Bag, *cameras: CameraTopics) -> None:
    for camera in cameras:
        for topic, kinds in ((camera.image, IMAGE_TYPES), (camera.info, INFO_TYPES), (camera.depth, IMAGE_TYPES)):
            if topic and topic not in bag.types:
                raise BagError(f"topic {topic} is not in the recording: expected one of {bag.listing()}")
            if topic and bag.types[topic] not in kinds:
                raise BagError(f"topic {topic} is {bag.types[topic]}: expected {' or '.join(kinds)}")


def _pairing(source: CameraTopics, target: CameraTopics, cameras: list[CameraTopics]) -> str:
    if target != CameraTopics():
        return "cameras"
    return "keyframe" if source.image or len(cameras) == 1 else "cameras"


def _completed(
    bag: Bag, given: CameraTopics, name: str, other: CameraTopics, depth: bool, alone: bool = False
) -> CameraTopics:
    """Fill in what was not asked for, from the guessed cameras that the other side does not use."""
    camera = given
    if not given.image:
        found = _only_camera(bag, name, other, depth, alone)
        camera = replace(found, **{k: v for k, v in vars(given).items() if v})
    infos = [topic for topic, kind in bag.types.items() if kind in INFO_TYPES]
    camera = replace(camera, info=camera.info or _info_of(camera.image, infos))
    if depth and not camera.depth:
        free = [topic for topic in _depths(bag) if topic != other.depth]
        camera = replace(camera, depth=_depth_of(camera.image, free))
    if not camera.info:
        raise BagError(f"no camera_info found for {camera.image}: give --{name}-info; topics: {bag.listing()}")
    if depth and not camera.depth:
        raise BagError(
            f"no depth found for {camera.image}: expected depth of every camera, registered to its image. "
            f"Give --{name}-depth, {WITHOUT_DEPTH}; topics: {bag.listing()}"
        )
    return camera


def _only_camera(bag: Bag, name: str, other: CameraTopics, depth: bool, alone: bool) -> CameraTopics:
    free = [camera for camera in _cameras(bag, depth) if camera.image != other.image]
    wanted = 1 if alone or other.image else 2
    if len(free) == wanted:
        return free[0]
    found = "; ".join(camera.image for camera in free) or "none"
    raise BagError(
        f"expected {wanted} camera(s) to choose from, found {len(free)} ({found}): give --{name}-image; "
        f"topics: {bag.listing()}"
    )


def _cameras(bag: Bag, depth: bool) -> list[CameraTopics]:
    """Return the colour cameras, one per namespace, sorted; if any have camera_info and wanted depth, only those."""
    infos = [topic for topic, kind in bag.types.items() if kind in INFO_TYPES]
    depths = _depths(bag)
    best: dict[str, str] = {}
    for topic in sorted(set(_images(bag)) - set(depths), key=_preference):
        best.setdefault(_stem(topic).rpartition("/")[0], topic)
    cameras = [CameraTopics(topic, _info_of(topic, infos), "") for topic in sorted(best.values())]
    cameras = [camera for camera in cameras if camera.info] or cameras
    if not depth:
        return cameras
    # The closest names choose first, and every depth is used once.
    free = list(depths)
    for camera in sorted(cameras, key=lambda c: (-max((_shared(c.image, d) for d in depths), default=0), c.image)):
        own = _depth_of(camera.image, free)
        cameras[cameras.index(camera)] = replace(camera, depth=own)
        free = [topic for topic in free if topic != own]
    return [camera for camera in cameras if camera.depth] or cameras


def _images(bag: Bag) -> list[str]:
    return sorted(topic for topic, kind in bag.types.items() if kind in IMAGE_TYPES)


def _depths(bag: Bag) -> list[str]:
    return [topic for topic in _images(bag) if _is_depth(bag, topic)]


def _is_depth(bag: Bag, topic: str) -> bool:
    """Tell from the first message; the name decides for mono16, bare png and messages that cannot be decoded."""
    message = bag.first(topic)
    told = str(getattr(message, "encoding", None) or getattr(message, "format", ""))
    if told.startswith(("16UC1", "32FC1")) or "compressedDepth" in told:
        return True
    return (not told or told.startswith(("mono16", "png"))) and "depth" in topic.lower()


def _preference(topic: str) -> tuple[bool, bool, str]:
    """Sort key: raw before compressed transport, rectified before not, then by name."""
    return topic != _stem(topic), "rect" not in topic, topic


def _stem(topic: str) -> str:
    """Return the topic without the suffix of an image transport."""
    head, _, tail = topic.rpartition("/")
    return head if tail in TRANSPORTS else topic


def _info_of(image: str, infos: Iterable[str]) -> str:
    stem = _stem(image)
    for candidate in (f"{stem.rpartition('/')[0]}/camera_info", f"{stem}/camera_info"):
        if candidate in infos:
            return candidate
    return ""


def _depth_of(image: str, depths: list[str]) -> str:
    """Return the depth whose name shares most with the image's, registered ones first; "" if there is none."""
    registered = [topic for topic in depths if any(word in topic for word in REGISTERED)]
    ranked = sorted(
        depths, key=lambda topic: (-_shared(image, topic), topic not in registered, topic != _stem(topic), topic)
    )
    return ranked[0] if ranked else ""


def _shared(a: str, b: str) -> int:
    """Count the leading parts that two topic names share."""
    parts = list(zip(a.split("/"), b.split("/"), strict=False))
    return next((i for i, (x, y) in enumerate(parts) if x != y), len(parts))
