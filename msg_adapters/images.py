# SPDX-License-Identifier: Apache-2.0
"""sensor_msgs/Image and CompressedImage to numpy: colour as HxWx3 uint8 red first, depth as HxW float32 metres.

Nothing is believed before it is checked, nothing is allocated before the size is known to be sane, and the arrays
returned never share memory with the message.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from msg_adapters import compressed
from msg_adapters.errors import MessageError
from msg_adapters.fields import integer, octets, text

Rgb = npt.NDArray[np.uint8]
Depth = npt.NDArray[np.float32]

MAX_SIDE_PX = 8192
MIN_BAYER_PX = 4


@dataclass(frozen=True)
class _Layout:
    """Layout of one pixel in memory: bytes per sample, samples, which of them are red, green, blue; or a mosaic."""

    sample: str
    channels: int
    rgb: tuple[int, int, int] = (0, 0, 0)
    bayer: str = ""


# 8UC1 and 8UC3 say nothing about colour: they are read as OpenCV's users write them, grey and blue first.
COLOUR_ENCODINGS = {
    "rgb8": _Layout("u1", 3, (0, 1, 2)),
    "bgr8": _Layout("u1", 3, (2, 1, 0)),
    "rgba8": _Layout("u1", 4, (0, 1, 2)),
    "bgra8": _Layout("u1", 4, (2, 1, 0)),
    "mono8": _Layout("u1", 1),
    "mono16": _Layout("u2", 1),
    "8UC1": _Layout("u1", 1),
    "8UC3": _Layout("u1", 3, (2, 1, 0)),
    # OpenCV names a mosaic by its second row from the second column on, ROS by its first two rows.
    "bayer_rggb8": _Layout("u1", 1, bayer="COLOR_BayerBG2RGB"),
    "bayer_bggr8": _Layout("u1", 1, bayer="COLOR_BayerRG2RGB"),
    "bayer_gbrg8": _Layout("u1", 1, bayer="COLOR_BayerGR2RGB"),
    "bayer_grbg8": _Layout("u1", 1, bayer="COLOR_BayerGB2RGB"),
    "bayer_rggb16": _Layout("u2", 1, bayer="COLOR_BayerBG2RGB"),
    "bayer_bggr16": _Layout("u2", 1, bayer="COLOR_BayerRG2RGB"),
    "bayer_gbrg16": _Layout("u2", 1, bayer="COLOR_BayerGR2RGB"),
    "bayer_grbg16": _Layout("u2", 1, bayer="COLOR_BayerGB2RGB"),
}
DEPTH_ENCODINGS = {"16UC1": _Layout("u2", 1), "mono16": _Layout("u2", 1), "32FC1": _Layout("f4", 1)}


def rgb_image(message: Any) -> Rgb:
    """Read an Image or CompressedImage as HxWx3 uint8, red first; 16 bit is scaled by 255/65535, grey is repeated.

    Args:
        message: anything with the fields of sensor_msgs/Image or sensor_msgs/CompressedImage.
    Raises:
        MessageError: a field that is malformed, an encoding that is not in COLOUR_ENCODINGS, corrupt data.
    """
    if is_compressed(message):
        return compressed.decode_rgb(text(message, "format"), octets(message), MAX_SIDE_PX)
    layout, pixels = _pixels(message, COLOUR_ENCODINGS, "colour")
    if layout.bayer:
        pixels = _demosaiced(pixels[..., 0], layout.bayer)
    eight_bit = pixels if pixels.dtype == np.uint8 else ((pixels.astype(np.uint32) + 128) // 257).astype(np.uint8)
    if layout.bayer or layout.rgb == tuple(range(layout.channels)):  # in order already: picking would cost a copy
        return np.ascontiguousarray(eight_bit)
    return np.ascontiguousarray(eight_bit[..., list(layout.rgb)])


def depth_image(message: Any) -> Depth:
    """Read an Image or CompressedImage as HxW float32 metres, NaN = no reading (REP 118).

    16UC1 (and mono16) hold millimetres with 0 = none; 32FC1 metres with NaN, infinity or 0 = none. Negative metres
    are passed on: they are the producer's mistake, and the core refuses them by name.

    Args:
        message: anything with the fields of sensor_msgs/Image or sensor_msgs/CompressedImage.
    Raises:
        MessageError: a field that is malformed, an encoding that is not in DEPTH_ENCODINGS, corrupt data.
    """
    if is_compressed(message):
        return compressed.decode_depth(text(message, "format"), octets(message), MAX_SIDE_PX)
    _, pixels = _pixels(message, DEPTH_ENCODINGS, "depth")
    samples = pixels[..., 0]
    return compressed.millimetres_to_metres(samples) if samples.dtype == np.uint16 else _metres(samples)


def is_compressed(message: Any) -> bool:
    """True for a CompressedImage: it has a `format`, an Image has an `encoding`."""
    return getattr(message, "format", None) is not None and getattr(message, "encoding", None) is None


def _pixels(message: Any, legal: dict[str, _Layout], purpose: str) -> tuple[_Layout, npt.NDArray[Any]]:
    """The samples of an Image as an owned HxWxC array in native byte order, after checking every field."""
    encoding = text(message, "encoding")
    if encoding not in legal:
        raise MessageError(f"encoding is {encoding!r}: expected a {purpose} encoding, one of {', '.join(legal)}")
    layout = legal[encoding]
    width, height = (integer(message, name, 1, MAX_SIDE_PX) for name in ("width", "height"))
    sample = np.dtype((">" if integer(message, "is_bigendian", 0, 1) else "<") + layout.sample)
    row = width * layout.channels * sample.itemsize
    step = integer(message, "step", 0, 2**32 - 1)
    if step < row or step % sample.itemsize:
        raise MessageError(
            f"step is {step}: expected at least {row} bytes for {width} pixels of {encoding}"
            f"{f' and a multiple of {sample.itemsize}' if sample.itemsize > 1 else ''}"
        )
    data = octets(message)
    if data.size != step * height:
        raise MessageError(f"data has {data.size} bytes: expected step * height = {step} * {height} = {step * height}")
    rows = np.ascontiguousarray(data.reshape(height, step)[:, :row])
    return layout, rows.view(sample).reshape(height, width, layout.channels).astype(sample.newbyteorder("="))


def _demosaiced(mosaic: npt.NDArray[Any], code: str) -> npt.NDArray[Any]:
    import cv2

    if min(mosaic.shape) < MIN_BAYER_PX:
        raise MessageError(
            f"Bayer image is {mosaic.shape[1]}x{mosaic.shape[0]}: expected at least {MIN_BAYER_PX}x{MIN_BAYER_PX}"
        )
    return np.asarray(cv2.cvtColor(mosaic, getattr(cv2, code)))


def _metres(samples: npt.NDArray[np.float32]) -> Depth:
    return np.where(np.isfinite(samples) & (samples != 0), samples, np.float32(np.nan))
