# SPDX-License-Identifier: Apache-2.0
"""sensor_msgs/CompressedImage: jpeg, png and compressedDepth. The size is read from the file header before decoding."""

from __future__ import annotations

import struct
from typing import Any

import numpy as np
import numpy.typing as npt

from msg_adapters.errors import MessageError

Bytes = npt.NDArray[np.uint8]

PNG_SIGNATURE = b"\x89PNG\r\n\x1a\n"
JPEG_START, JPEG_END = b"\xff\xd8\xff", b"\xff\xd9"
# The start-of-frame markers; 0xC4, 0xC8 and 0xCC in the same range are other things.
JPEG_FRAMES = frozenset(range(0xC0, 0xD0)) - {0xC4, 0xC8, 0xCC}
CONFIG_HEADER = struct.Struct("<iff")
"""compressed_depth_image_transport's ConfigHeader: format, depthQuantA, depthQuantB."""


def decode_rgb(kind: str, data: Bytes, max_side_px: int) -> Bytes:
    """Decode jpeg or png to HxWx3 uint8, red first, as stored: an EXIF orientation is ignored, K is of the sensor.

    Args:
        kind: the message's `format`, e.g. "jpeg" or "rgb8; jpeg compressed bgr8".
        data: the file.
        max_side_px: wider or higher images are refused before decoding.
    Raises:
        MessageError: depth where colour is expected, neither jpeg nor png, too large, corrupt.
    """
    import cv2

    if "compressedDepth" in kind or kind.startswith(("16UC1", "32FC1")):
        raise MessageError(f"format is {kind!r}: expected colour as jpeg or png; this is depth, use it as depth topic")
    if kind.startswith("bayer_") and "compressed bgr" not in kind:
        raise MessageError(f"format is {kind!r}: expected colour; a compressed mosaic cannot be read, debayer it first")
    bits = _checked_file(data, max_side_px)
    if bits == 16 and not kind.startswith("mono16"):
        raise MessageError(f"png has 16 bit grey and format {kind!r}: expected colour; this looks like depth")
    image = _decoded(data, cv2.IMREAD_COLOR | cv2.IMREAD_IGNORE_ORIENTATION)
    # "compressed rgb8" means that red was handed to the encoder in blue's place.
    return np.ascontiguousarray(image if "compressed rgb" in kind else image[..., ::-1])


def decode_depth(kind: str, data: Bytes, max_side_px: int) -> npt.NDArray[np.float32]:
    """Decode a 16 bit png (mm), or compressedDepth of 16UC1 (mm) or 32FC1 (inverse depth), to HxW float32 metres.

    Args:
        kind: the message's `format`, e.g. "16UC1; compressedDepth png" or "16UC1; png compressed".
        data: the file, behind a 12 byte header when the format says compressedDepth.
        max_side_px: wider or higher images are refused before decoding.
    Raises:
        MessageError: another format or codec, too large, corrupt.
    """
    if "compressedDepth" not in kind:
        return millimetres_to_metres(_decoded_16_bit(data, max_side_px))
    encoding, _, codec = (part.strip() for part in kind.partition(";"))
    codec = codec.removeprefix("compressedDepth").strip() or "png"
    if encoding not in ("16UC1", "32FC1") or codec != "png":
        raise MessageError(f"format is {kind!r}: expected '16UC1; compressedDepth png' or '32FC1; compressedDepth png'")
    if data.size <= CONFIG_HEADER.size:
        raise MessageError(f"data has {data.size} bytes: expected a {CONFIG_HEADER.size} byte header and a png")
    samples = _decoded_16_bit(data[CONFIG_HEADER.size :], max_side_px)
    if encoding == "16UC1":
        return millimetres_to_metres(samples)
    _, a, b = CONFIG_HEADER.unpack(data[: CONFIG_HEADER.size].tobytes())
    return _inverse_depth(samples, a, b)


def millimetres_to_metres(samples: npt.NDArray[np.uint16]) -> npt.NDArray[np.float32]:
    """HxW uint16 millimetres, 0 = none, to float32 metres, NaN = none."""
    return np.where(samples > 0, samples / np.float32(1000), np.float32(np.nan))


def _inverse_depth(samples: npt.NDArray[np.uint16], a: float, b: float) -> npt.NDArray[np.float32]:
    """Metres: `depth = a / (sample - b)`, sample 0 = none (compressed_depth_image_transport, codec.cpp)."""
    if not (np.isfinite([a, b]).all() and a > 0 and b < 1):
        raise MessageError(
            f"compressedDepth header has parameters {a:g}, {b:g}: expected finite, first > 0, second < 1"
        )
    return np.where(samples > 0, a / (samples.astype(np.float64) - b), np.nan).astype(np.float32)


def _decoded_16_bit(data: Bytes, max_side_px: int) -> npt.NDArray[np.uint16]:
    import cv2

    bits = _checked_file(data, max_side_px)
    if bits != 16:
        raise MessageError("data holds 8 bit or colour samples: expected depth as 16 bit grey png, millimetres")
    return np.asarray(_decoded(data, cv2.IMREAD_UNCHANGED), np.uint16)


def _decoded(data: Bytes, flags: int) -> npt.NDArray[Any]:
    import cv2

    try:
        image = cv2.imdecode(data, flags)
    except cv2.error as error:
        raise MessageError(f"data cannot be decoded ({error.err}): expected a whole jpeg or png") from None
    if image is None:
        raise MessageError(
            f"data cannot be decoded ({data.size} bytes): expected a whole jpeg or png; is it truncated?"
        )
    return np.asarray(image)


def _checked_file(data: Bytes, max_side_px: int) -> int:
    """Check kind, size and end of the file by its header; return 16 for a 16 bit grey png, else 8."""
    file = data.tobytes()
    if file.startswith(PNG_SIGNATURE):
        width, height, bits = _png_header(file)
    elif file.startswith(JPEG_START):
        width, height = _jpeg_size(file)
        bits = 8
    else:
        raise MessageError(f"data starts with {file[:4].hex() or 'nothing'}: expected a jpeg or png file")
    if not (1 <= width <= max_side_px and 1 <= height <= max_side_px):
        raise MessageError(f"compressed image is {width}x{height}: expected 1..{max_side_px} pixels each way")
    return bits


def _png_header(file: bytes) -> tuple[int, int, int]:
    if len(file) < 33 or file[12:16] != b"IHDR":
        raise MessageError("png has no IHDR chunk: expected a whole png file; is it truncated?")
    width, height, depth, colour_type = struct.unpack(">IIBB", file[16:26])
    return width, height, 16 if (depth, colour_type) == (16, 0) else 8


def _jpeg_size(file: bytes) -> tuple[int, int]:
    """Walk the segments to the frame header; old decoders fill a truncated scan with grey, so the end is checked."""
    at = 2
    while at + 9 <= len(file) and file[at] == 0xFF:
        marker, (length,) = file[at + 1], struct.unpack(">H", file[at + 2 : at + 4])
        if marker in JPEG_FRAMES:
            if file.rfind(JPEG_END) < at:
                raise MessageError("jpeg has no end marker: expected a whole file; is it truncated?")
            height, width = struct.unpack(">HH", file[at + 5 : at + 9])
            return width, height
        at += 1 if marker == 0xFF else 2 + length
    raise MessageError("jpeg has no frame header: expected a whole jpeg file; is it truncated?")
