# SPDX-License-Identifier: Apache-2.0
"""sensor_msgs/CameraInfo to the pinhole camera of the image that was delivered (REP 104), and its undistortion.

K belongs to the raw image and P to the rectified one, but nothing in the message says which of the two the image is:
the topic's name does, or the caller. The rectifying rotation R is never applied to a raw image: the pose that follows
is that of the physical optical frame. A rectified image of a stereo pair looks along rotated axes; `decision` says so.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from msg_adapters.errors import MessageError
from msg_adapters.fields import field, integer, numbers, text
from msg_adapters.images import MAX_SIDE_PX, Depth, Rgb
from msg_adapters.undistort import undistorted_pair

Float64Array = npt.NDArray[np.float64]

RECTIFIED_CHOICES = ("auto", "true", "false")
COEFFICIENT_COUNTS = {"plumb_bob": (4, 5), "rational_polynomial": (8, 12, 14), "equidistant": (4,)}
MODEL_ALIASES = {"fisheye": "equidistant", "kannala_brandt": "equidistant"}
TRANSPORTS = ("compressed", "compressedDepth")
MAX_BINNING = 64


@dataclass(frozen=True, eq=False)
class Camera:
    """The pinhole camera of one delivered image.

    Args:
        K: 3x3 float64, pixels of the delivered image, after binning, region of interest and resizing.
        width: of the delivered image, pixels.
        height: of the delivered image, pixels.
        distortion_model: "plumb_bob", "rational_polynomial", "equidistant", or "" when there is nothing to undo.
        coefficients: in OpenCV's order; empty when there is nothing to undo.
        decision: what was used and why, for the log.
    """

    K: Float64Array
    width: int
    height: int
    distortion_model: str
    coefficients: tuple[float, ...]
    decision: str

    def rectify(self, rgb: Rgb, depth: Depth | None = None) -> tuple[Rgb, Depth | None]:
        """Undo the distortion; K stays valid for the result and the optical frame does not turn.

        Args:
            rgb: HxWx3 uint8; interpolated linearly, black where the lens saw nothing.
            depth: HxW float32 m registered to rgb, with the same distortion; nearest neighbour, NaN outside.
        Returns:
            The same arrays when there is nothing to undo, else new ones.
        Raises:
            MessageError: an array that is not of this camera's size.
        """
        for name, image in (("image", rgb), ("depth", depth)):
            if image is not None and image.shape[:2] != (self.height, self.width):
                raise MessageError(
                    f"{name} is {image.shape[1]}x{image.shape[0]}: expected {self.width}x{self.height}, the camera's "
                    "size; publish depth registered to the colour image"
                )
        if not self.distortion_model:
            return rgb, depth
        return undistorted_pair(self.K, self.distortion_model, self.coefficients, rgb, depth)


def camera_from_info(
    info: Any,
    image_size: tuple[int, int] | None = None,
    *,
    topic: str = "",
    rectified: str = "auto",
    allow_resized: bool = False,
) -> Camera:
    """Turn a CameraInfo into the camera of one image.

    Args:
        info: anything with the fields of sensor_msgs/CameraInfo, in ROS 2 (k, d, p) or ROS 1 (K, D, P) spelling.
        image_size: (width, height) of the delivered image in pixels; None trusts the CameraInfo.
        topic: the image's topic; in "auto" a last part with a word that starts with "rect" means rectified.
        rectified: "auto", "true" (use P, no distortion) or "false" (use K and D).
        allow_resized: accept an image that was scaled evenly, and scale K with it.
    Raises:
        MessageError: uncalibrated, malformed, an unknown distortion model, or another size than the image's.
    """
    if rectified not in RECTIFIED_CHOICES:
        raise MessageError(f"rectified is {rectified!r}: expected one of {', '.join(RECTIFIED_CHOICES)}")
    is_rectified = rectified == "true" or (rectified == "auto" and says_rectified(topic))
    why = f"topic {topic or '(none)'}" if rectified == "auto" else f"rectified:={rectified}"
    if is_rectified:
        K = _projection(info)
        model, coefficients = "", tuple[float, ...]()
        decision = f"rectified image ({why}): P without distortion{_stereo_note(info)}"
    else:
        K = _raw_matrix(info)
        model, coefficients, told = _distortion(info)
        decision = f"raw image ({why}): K with {told}; R not applied"
    K, size, window_note = _windowed(K, info)
    if image_size is not None:
        K, resize_note = _fitted(K, size, image_size, allow_resized)
        size, window_note = image_size, window_note + resize_note
    return Camera(K, *size, model, coefficients, decision + window_note)


def says_rectified(topic: str) -> bool:
    """True when the last part of a topic has a word that starts with "rect": image_rect, image_rectified/compressed."""
    parts = [part for part in topic.split("/") if part and part not in TRANSPORTS]
    return bool(parts) and re.search(r"(?<![a-z])rect", parts[-1].lower()) is not None


def _raw_matrix(info: Any) -> Float64Array:
    K = numbers(info, "k", "K", count=9).reshape(3, 3)
    if K[0, 0] == 0:
        raise MessageError(
            "k[0] is 0: expected a focal length in pixels; the camera is uncalibrated, calibrate it first"
        )
    return _checked_pinhole("k", K)


def _projection(info: Any) -> Float64Array:
    P = numbers(info, "p", "P", count=12).reshape(3, 4)
    if P[0, 0] == 0:
        raise MessageError("p[0] is 0: expected the focal length of the rectified image; set p or use rectified:=false")
    return _checked_pinhole("p", P[:, :3])


def _checked_pinhole(name: str, K: Float64Array) -> Float64Array:
    if K[0, 0] <= 0 or K[1, 1] <= 0:
        raise MessageError(f"{name} has focal lengths {K[0, 0]:g}, {K[1, 1]:g}: expected both positive, in pixels")
    if K[0, 1] != 0 or K[1, 0] != 0 or (K[2] != (0, 0, 1)).any():
        raise MessageError(
            f"{name} is {K.ravel().tolist()}: expected [fx, 0, cx, 0, fy, cy, 0, 0, 1]; is it transposed?"
        )
    return K.copy()


def _distortion(info: Any) -> tuple[str, tuple[float, ...], str]:
    name = text(info, "distortion_model")
    model = MODEL_ALIASES.get(name, name)
    coefficients = tuple(numbers(info, "d", "D").tolist())
    if not name and not any(coefficients):
        return "", (), "no distortion given, taken as none"
    if model not in COEFFICIENT_COUNTS:
        known = ", ".join([*COEFFICIENT_COUNTS, *MODEL_ALIASES])
        raise MessageError(f"distortion_model is {name!r}: expected one of {known}; publish rectified images instead")
    if len(coefficients) not in COEFFICIENT_COUNTS[model]:
        counts = " or ".join(map(str, COEFFICIENT_COUNTS[model]))
        raise MessageError(f"d has {len(coefficients)} coefficients: expected {counts} for {name}")
    # An equidistant lens with four zeros is still a fisheye: only the polynomial models vanish with their numbers.
    if model != "equidistant" and not any(coefficients):
        return "", (), f"{name} of zeros, no distortion"
    return model, coefficients, f"{model} distortion"


def _stereo_note(info: Any) -> str:
    note = ""
    if numbers(info, "p", "P", count=12)[3] != 0:
        note += "; stereo baseline in p[3] not used, the pose is of this camera"
    R = numbers(info, "r", "R", count=9).reshape(3, 3)
    if R.any() and not np.allclose(R, np.eye(3), atol=1e-9):
        note += "; axes are those of the rectified frame, turned by R against the optical frame"
    return note


def _windowed(K: Float64Array, info: Any) -> tuple[Float64Array, tuple[int, int], str]:
    """Apply region of interest, then binning (REP 104): c' = (c - offset) / binning, f' = f / binning."""
    full = tuple(integer(info, name, 0, MAX_SIDE_PX) for name in ("width", "height"))
    if 0 in full:
        raise MessageError(
            f"camera_info is {full[0]}x{full[1]}: expected the calibrated size; the camera is uncalibrated"
        )
    roi = field(info, "roi")
    offset = tuple(integer(roi, name, 0, MAX_SIDE_PX) for name in ("x_offset", "y_offset"))
    size = tuple(integer(roi, name, 0, MAX_SIDE_PX) for name in ("width", "height"))
    if offset == size == (0, 0):
        size = full
    if 0 in size or offset[0] + size[0] > full[0] or offset[1] + size[1] > full[1]:
        raise MessageError(
            f"roi is {size[0]}x{size[1]} at {offset}: expected it inside {full[0]}x{full[1]}, or all zero"
        )
    bins = tuple(max(1, integer(info, name, 0, MAX_BINNING)) for name in ("binning_x", "binning_y"))
    windowed = K.copy()
    for axis in (0, 1):
        windowed[axis, axis] = K[axis, axis] / bins[axis]
        windowed[axis, 2] = (K[axis, 2] - offset[axis]) / bins[axis]
    if min(size[0] // bins[0], size[1] // bins[1]) == 0:
        raise MessageError(f"binning is {bins[0]}x{bins[1]}: expected less than the window of {size[0]}x{size[1]}")
    note = f"; window {size[0]}x{size[1]} at {offset}" if size != full else ""
    note += f"; binning {bins[0]}x{bins[1]}" if bins != (1, 1) else ""
    return windowed, (size[0] // bins[0], size[1] // bins[1]), note


def _fitted(
    K: Float64Array, size: tuple[int, int], image_size: tuple[int, int], allow_resized: bool
) -> tuple[Float64Array, str]:
    """K for an image of another size, pixel centres at integers; the same K when the sizes agree."""
    if tuple(image_size) == size:
        return K, ""
    ratio = np.divide(image_size, size)
    given = f"image is {image_size[0]}x{image_size[1]} but camera_info describes {size[0]}x{size[1]}"
    if abs(ratio[0] * size[1] - image_size[1]) > 1:
        raise MessageError(f"{given}: expected the same size; this is another camera or a cropped image")
    if not allow_resized:
        raise MessageError(f"{given}: expected the same size; set allow_resized if the image was scaled evenly")
    fitted = K.copy()
    for axis in (0, 1):
        fitted[axis, axis] = K[axis, axis] * ratio[axis]
        fitted[axis, 2] = (K[axis, 2] + 0.5) * ratio[axis] - 0.5
    return fitted, f"; resized by {ratio[0]:.4g}"
