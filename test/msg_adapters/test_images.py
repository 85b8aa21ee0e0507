# SPDX-License-Identifier: Apache-2.0
"""Image and CompressedImage to arrays: every encoding, every library, and everything a broken driver can send."""

import struct
import zlib

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from ros_messages import LIBRARIES, changed, compressed, image

from msg_adapters import MessageError, depth_image, header_frame_id, header_stamp_ns, rgb_image
from msg_adapters.compressed import CONFIG_HEADER
from msg_adapters.images import COLOUR_ENCODINGS, DEPTH_ENCODINGS

RNG = np.random.default_rng(3)
RGB = RNG.integers(0, 256, (24, 32, 3), dtype=np.uint8)
SMOOTH = cv2.GaussianBlur(RGB, (0, 0), 2.0)
GREY = RGB[..., 1]
GREY16 = RNG.integers(0, 65536, (24, 32), dtype=np.uint16)
MM = np.where(RNG.random((24, 32)) < 0.2, 0, RNG.integers(300, 5000, (24, 32))).astype(np.uint16)
METRES = np.where(MM > 0, MM / 1000, np.nan).astype(np.float32)


def alpha(pixels):
    return np.dstack([pixels, np.full(pixels.shape[:2], 9, np.uint8)])


def same(a, b):
    np.testing.assert_array_equal(a, b)
    assert a.dtype == b.dtype and a.shape == b.shape


COLOUR = {
    "rgb8": (RGB, RGB),
    "bgr8": (RGB[..., ::-1], RGB),
    "rgba8": (alpha(RGB), RGB),
    "bgra8": (alpha(RGB[..., ::-1]), RGB),
    "mono8": (GREY, np.dstack([GREY] * 3)),
    "8UC1": (GREY, np.dstack([GREY] * 3)),
    "8UC3": (RGB[..., ::-1], RGB),
    "mono16": (GREY16, np.dstack([np.round(GREY16 / 257).astype(np.uint8)] * 3)),
}


@pytest.mark.parametrize("library", LIBRARIES)
@pytest.mark.parametrize("encoding", COLOUR)
def test_colour_encodings_give_red_first(encoding, library):
    pixels, expected = COLOUR[encoding]
    same(rgb_image(image(pixels, encoding, library)), expected)


@pytest.mark.parametrize("library", LIBRARIES)
def test_depth_encodings_give_metres_with_nan_for_none(library):
    same(depth_image(image(MM, "16UC1", library)), METRES)
    same(depth_image(image(MM, "mono16", library)), METRES)
    metres = METRES.copy()
    metres[0, :4] = (np.inf, -np.inf, 0.0, 1.25)
    expected = METRES.copy()
    expected[0, :4] = (np.nan, np.nan, np.nan, 1.25)
    same(depth_image(image(metres, "32FC1", library)), expected)


def test_every_encoding_is_tested():
    bayer = {f"bayer_{pattern}{bits}" for pattern in BAYER for bits in (8, 16)}
    assert set(COLOUR) | bayer == set(COLOUR_ENCODINGS)
    assert set(DEPTH_ENCODINGS) == {"16UC1", "mono16", "32FC1"}


BAYER = {"rggb": (0, 1, 1, 2), "bggr": (2, 1, 1, 0), "gbrg": (1, 2, 0, 1), "grbg": (1, 0, 2, 1)}


def mosaic(pattern, colour):
    """A Bayer image of one flat colour, made by hand: the pattern names the first two rows, left to right."""
    top_left, top_right, bottom_left, bottom_right = (colour[channel] for channel in BAYER[pattern])
    pixels = np.zeros((12, 16), colour.dtype)
    pixels[0::2, 0::2], pixels[0::2, 1::2] = top_left, top_right
    pixels[1::2, 0::2], pixels[1::2, 1::2] = bottom_left, bottom_right
    return pixels


@pytest.mark.parametrize("pattern", BAYER)
def test_bayer_mosaics_give_the_colour_they_were_made_of(pattern):
    colour = np.array([200, 100, 50], np.uint8)
    expected = np.broadcast_to(colour, (12, 16, 3))
    np.testing.assert_array_equal(rgb_image(image(mosaic(pattern, colour), f"bayer_{pattern}8")), expected)
    sixteen = mosaic(pattern, colour.astype(np.uint16) * 257)
    for bigendian in (False, True):
        got = rgb_image(image(sixteen, f"bayer_{pattern}16", bigendian=bigendian))
        np.testing.assert_array_equal(got, expected)


@given(
    st.sampled_from(sorted(COLOUR)),
    st.integers(1, 9),
    st.integers(1, 9),
    st.integers(0, 7),
    st.booleans(),
)
def test_padding_and_byte_order_change_nothing(encoding, height, width, padding, bigendian):
    pixels = COLOUR[encoding][0][:height, :width]
    expected = COLOUR[encoding][1][:height, :width]
    row = width * pixels.dtype.itemsize * (pixels.shape[2] if pixels.ndim == 3 else 1)
    message = image(pixels, encoding, step=row + padding * pixels.dtype.itemsize, bigendian=bigendian)
    same(rgb_image(message), expected)


@given(st.sampled_from(["16UC1", "32FC1"]), st.integers(0, 5), st.booleans())
def test_depth_padding_and_byte_order_change_nothing(encoding, padding, bigendian):
    pixels = MM if encoding == "16UC1" else METRES
    step = pixels.shape[1] * pixels.itemsize + padding * pixels.itemsize
    same(depth_image(image(pixels, encoding, step=step, bigendian=bigendian)), METRES)


def test_result_does_not_share_memory_with_the_message():
    message = image(RGB, "rgb8", "rosbags")
    assert not message.data.flags.writeable  # as rosbags hands it out
    got = rgb_image(message)
    assert not np.shares_memory(got, message.data) and got.flags.writeable
    depth = image(METRES, "32FC1", "rosbags")
    assert not np.shares_memory(depth_image(depth), depth.data)


def jpeg(pixels_rgb):
    return cv2.imencode(".jpg", pixels_rgb[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, 95])[1].tobytes()


def png(pixels):
    return cv2.imencode(".png", pixels[..., ::-1] if pixels.ndim == 3 else pixels)[1].tobytes()


@pytest.mark.parametrize("library", LIBRARIES)
@pytest.mark.parametrize("kind", ["jpeg", "jpg", "", "rgb8; jpeg compressed bgr8", "bgr8; jpeg compressed bgr8"])
def test_jpeg_is_decoded_red_first(kind, library):
    data = jpeg(SMOOTH)
    got = rgb_image(compressed(data, kind, library))
    same(got, np.ascontiguousarray(cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR)[..., ::-1]))
    assert np.abs(got.astype(int) - SMOOTH).mean() < 3


def test_png_is_lossless_and_grey_is_repeated():
    same(rgb_image(compressed(png(RGB), "png")), RGB)
    same(rgb_image(compressed(png(RGB), "rgb8; png compressed bgr8")), RGB)
    same(rgb_image(compressed(png(GREY), "mono8; png compressed ")), np.dstack([GREY] * 3))
    grey16 = rgb_image(compressed(png(GREY16), "mono16; png compressed "))
    assert np.abs(grey16[..., 0] - GREY16 / 257).max() <= 1


def test_compressed_rgb_means_that_red_was_stored_as_blue():
    swapped = png(RGB[..., ::-1])
    same(rgb_image(compressed(swapped, "rgb8; png compressed rgb8")), RGB)


def test_exif_orientation_does_not_turn_the_image():
    exif = b"Exif\0\0" + struct.pack("<2sHIHHHIHHI", b"II", 42, 8, 1, 0x0112, 3, 1, 6, 0, 0)
    data = jpeg(SMOOTH)
    turned = data[:2] + b"\xff\xe1" + struct.pack(">H", len(exif) + 2) + exif + data[2:]
    assert cv2.imdecode(np.frombuffer(turned, np.uint8), cv2.IMREAD_COLOR).shape == (32, 24, 3)  # the trap exists
    same(rgb_image(compressed(turned, "jpeg")), rgb_image(compressed(data, "jpeg")))


def compressed_depth(samples, a=0.0, b=0.0):
    return CONFIG_HEADER.pack(0, a, b) + png(samples)


@pytest.mark.parametrize("library", LIBRARIES)
@pytest.mark.parametrize(
    "kind", ["16UC1; compressedDepth png", "16UC1; compressedDepth", "16UC1; png compressed", "png"]
)
def test_compressed_16_bit_depth_is_lossless(kind, library):
    data = compressed_depth(MM) if "compressedDepth" in kind else png(MM)
    same(depth_image(compressed(data, kind, library)), METRES)


def test_compressed_float_depth_is_inverse_depth():
    """Encoded with the published formulas: A = q (q + 1), B = 1 - A / max, sample = A / depth + B."""
    quantization, farthest = 100.0, 10.0
    a = quantization * (quantization + 1)
    b = 1 - a / farthest
    samples = np.where(np.isnan(METRES), 0, np.round(a / METRES + b)).astype(np.uint16)
    got = depth_image(compressed(compressed_depth(samples, a, b), "32FC1; compressedDepth png"))
    np.testing.assert_array_equal(np.isnan(got), np.isnan(METRES))
    tolerance = METRES**2 / (2 * a) * 1.01 + 1e-5  # half a quantum of inverse depth
    assert (np.abs(got - METRES)[~np.isnan(METRES)] <= tolerance[~np.isnan(METRES)]).all()


def png_of_size(width, height):
    """A PNG whose header announces a size that its few bytes of pixels do not have."""

    def chunk(kind, body):
        return struct.pack(">I", len(body)) + kind + body + struct.pack(">I", zlib.crc32(kind + body))

    head = struct.pack(">IIBBBBB", width, height, 8, 2, 0, 0, 0)
    return b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", head) + chunk(b"IDAT", zlib.compress(b"\0" * 10)) + chunk(b"IEND", b"")


def jpeg_of_size(width, height):
    data = bytearray(jpeg(SMOOTH))
    at = data.index(b"\xff\xc0")
    data[at + 5 : at + 9] = struct.pack(">HH", height, width)
    return bytes(data)


def damaged(data, at):
    return data[:at] + bytes([data[at] ^ 0xFF]) + data[at + 1 :]


GOOD = image(RGB, "rgb8")
GOOD16 = image(GREY16, "mono16")
PNG16, PNG8, JPEG = png(MM), png(RGB), jpeg(SMOOTH)

MALFORMED_COLOUR = {
    "width zero": (changed(GOOD, width=0), r"width is 0: expected 1\.\.8192"),
    "width negative": (changed(GOOD, width=-32), "width is -32"),
    "width too large": (changed(GOOD, width=8193, step=8193 * 3), "width is 8193"),
    "width beyond any memory": (changed(GOOD, width=2**40), "width is 1099511627776"),
    "width text": (changed(GOOD, width="32"), "width is '32': expected an integer"),
    "width float": (changed(GOOD, width=32.0), r"width is 32\.0: expected an integer"),
    "width array": (changed(GOOD, width=np.array([32, 32])), "width is .*: expected an integer"),
    "width missing": (changed(GOOD, width=...), "has no field 'width'"),
    "width lies low with old step": (changed(GOOD, width=33), "step is 96: expected at least 99 bytes"),
    "height zero": (changed(GOOD, height=0), "height is 0"),
    "height too large": (changed(GOOD, height=10**6), "height is 1000000"),
    "height lies low": (changed(GOOD, height=23), r"data has 2304 bytes: expected step \* height = 96 \* 23 = 2208"),
    "height lies high": (changed(GOOD, height=25), "data has 2304 bytes: expected .* 2400"),
    "step zero": (changed(GOOD, step=0), "step is 0: expected at least 96"),
    "step one short": (changed(GOOD, step=95), "step is 95: expected at least 96"),
    "step of the wrong encoding": (changed(GOOD, step=32), "step is 32: expected at least 96"),
    "step negative": (changed(GOOD, step=-96), "step is -96"),
    "step huge": (changed(GOOD, step=2**31), "data has 2304 bytes: expected"),
    "step beyond its type": (changed(GOOD, step=2**32), "step is 4294967296"),
    "step splits a sample": (changed(GOOD16, step=65), "step is 65: expected .* multiple of 2"),
    "step none": (changed(GOOD, step=None), "has no field 'step'"),
    "data empty": (changed(GOOD, data=b""), "data has 0 bytes: expected"),
    "data one short": (changed(GOOD, data=GOOD.data[:-1]), "data has 2303 bytes"),
    "data one long": (changed(GOOD, data=GOOD.data + b"x"), "data has 2305 bytes"),
    "data a list": (changed(GOOD, data=list(GOOD.data)), "data is list: expected bytes"),
    "data text": (changed(GOOD, data="x" * 2304), "data is str: expected bytes"),
    "data missing": (changed(GOOD, data=None), "has no field 'data'"),
    "data of words": (changed(GOOD, data=np.zeros(1152, np.uint16)), "data is 1-dimensional of format 'H'"),
    "data two-dimensional": (changed(GOOD, data=np.zeros((24, 96), np.uint8)), "data is 2-dimensional"),
    "data strided": (changed(GOOD, data=np.zeros(4608, np.uint8)[::2]), "expected flat bytes"),
    "encoding unknown": (changed(GOOD, encoding="yuv422"), "encoding is 'yuv422': .* rgb8, bgr8"),
    "encoding upper case": (changed(GOOD, encoding="RGB8"), "encoding is 'RGB8'"),
    "encoding empty": (changed(GOOD, encoding=""), "encoding is ''"),
    "encoding number": (changed(GOOD, encoding=8), "encoding is int: expected text"),
    "encoding missing": (changed(GOOD, encoding=...), "has no field 'encoding'"),
    "encoding of depth": (changed(GOOD, encoding="16UC1"), "expected a colour encoding"),
    "endianness two": (changed(GOOD, is_bigendian=2), r"is_bigendian is 2: expected 0\.\.1"),
    "endianness text": (changed(GOOD, is_bigendian="little"), "is_bigendian is 'little'"),
    "mosaic too small": (image(GREY[:2, :6], "bayer_rggb8"), "Bayer image is 6x2: expected at least 4x4"),
    "another type": (object(), "object has no field 'encoding'"),
    "compressed empty": (compressed(b"", "jpeg"), "data starts with nothing: expected a jpeg or png"),
    "compressed garbage": (compressed(b"hello world", "jpeg"), "data starts with 68656c6c"),
    "compressed gif": (compressed(b"GIF89a" + bytes(50), "gif"), "expected a jpeg or png file"),
    "compressed list": (changed(compressed(b"", "jpeg"), data=[1, 2]), "data is list"),
    "format number": (changed(compressed(JPEG, "jpeg"), format=3), "format is int: expected text"),
    "jpeg cut short": (compressed(JPEG[: len(JPEG) * 2 // 3], "jpeg"), "jpeg has no end marker"),
    "jpeg header only": (compressed(JPEG[:20], "jpeg"), "jpeg has no frame header"),
    "jpeg start only": (compressed(JPEG[:3], "jpeg"), "jpeg has no frame header"),
    "jpeg frame without scan": (compressed(JPEG[: JPEG.index(b"\xff\xda")] + b"\xff\xd9", "jpeg"), "cannot be decoded"),
    "jpeg huge": (compressed(jpeg_of_size(65535, 65535), "jpeg"), "compressed image is 65535x65535"),
    "jpeg without width": (compressed(jpeg_of_size(0, 24), "jpeg"), "compressed image is 0x24"),
    "png cut short": (compressed(PNG8[: len(PNG8) // 2], "png"), "data cannot be decoded"),
    "png signature only": (compressed(PNG8[:8], "png"), "png has no IHDR"),
    "png first chunk wrong": (compressed(damaged(PNG8, 13), "png"), "png has no IHDR"),
    "png bit flipped": (compressed(damaged(PNG8, len(PNG8) // 2), "png"), "data cannot be decoded"),
    "png huge": (compressed(png_of_size(2**31 - 1, 2**31 - 1), "png"), "compressed image is 2147483647x2147483647"),
    "png wide": (compressed(png_of_size(8193, 1), "png"), "compressed image is 8193x1"),
    "png tall": (compressed(png_of_size(1, 8193), "png"), "compressed image is 1x8193"),
    "png empty": (compressed(png_of_size(0, 5), "png"), "compressed image is 0x5"),
    "depth png as colour": (compressed(PNG16, "png"), "16 bit grey .*looks like depth"),
    "declared depth as colour": (compressed(PNG16, "16UC1; png compressed"), "this is depth"),
    "compressedDepth as colour": (compressed(compressed_depth(MM), "16UC1; compressedDepth png"), "this is depth"),
    "compressed mosaic": (compressed(JPEG, "bayer_rggb8; jpeg compressed "), "debayer it first"),
}
DEPTH_GOOD = image(MM, "16UC1")
MALFORMED_DEPTH = {
    "colour as depth": (GOOD, "encoding is 'rgb8': expected a depth encoding, one of 16UC1, mono16, 32FC1"),
    "grey as depth": (image(GREY, "mono8"), "expected a depth encoding"),
    "float labelled 16 bit": (changed(image(METRES, "32FC1"), encoding="16UC1", step=64), "data has 3072 bytes"),
    "16 bit labelled float": (changed(DEPTH_GOOD, encoding="32FC1"), "step is 64: expected at least 128"),
    "double": (image(METRES.astype(np.float64), "64FC1"), "encoding is '64FC1'"),
    "float step splits a sample": (image(METRES, "32FC1", step=130), "multiple of 4"),
    "truncated": (changed(DEPTH_GOOD, data=DEPTH_GOOD.data[:100]), "data has 100 bytes"),
    "jpeg": (compressed(JPEG, "jpeg"), "expected depth as 16 bit grey png"),
    "8 bit png": (compressed(png(GREY), "png"), "expected depth as 16 bit grey png"),
    "rvl": (compressed(bytes(99), "16UC1; compressedDepth rvl"), "expected '16UC1; compressedDepth png'"),
    "unknown depth encoding": (compressed(compressed_depth(MM), "8UC1; compressedDepth png"), "format is '8UC1;"),
    "header only": (compressed(compressed_depth(MM)[:12], "16UC1; compressedDepth png"), "data has 12 bytes"),
    "nothing": (compressed(b"", "16UC1; compressedDepth png"), "data has 0 bytes"),
    "header left out": (compressed(PNG16, "16UC1; compressedDepth png"), "data starts with"),
    "parameter NaN": (compressed(compressed_depth(MM, np.nan, 0), "32FC1; compressedDepth png"), "parameters nan"),
    "parameter zero": (compressed(compressed_depth(MM, 0, 0), "32FC1; compressedDepth png"), "first > 0"),
    "parameter of a pole": (compressed(compressed_depth(MM, 100, 2), "32FC1; compressedDepth png"), "second < 1"),
    "png cut short": (compressed(PNG16[:60], "16UC1; png compressed"), "data cannot be decoded"),
    "huge": (compressed(bytes(12) + png_of_size(9000, 9000), "16UC1; compressedDepth png"), "9000x9000"),
}


@pytest.mark.parametrize("name", MALFORMED_COLOUR)
def test_malformed_colour_is_refused_by_name(name):
    message, expected = MALFORMED_COLOUR[name]
    with pytest.raises(MessageError, match=expected):
        rgb_image(message)


@pytest.mark.parametrize("name", MALFORMED_DEPTH)
def test_malformed_depth_is_refused_by_name(name):
    message, expected = MALFORMED_DEPTH[name]
    with pytest.raises(MessageError, match=expected):
        depth_image(message)


def test_malformed_table_is_as_long_as_promised():
    assert len(MALFORMED_COLOUR) + len(MALFORMED_DEPTH) >= 60


JUNK = st.one_of(
    st.none(), st.integers(-5, 200), st.integers(), st.text(max_size=5), st.binary(max_size=50), st.floats(),
    st.sampled_from([*COLOUR_ENCODINGS, *DEPTH_ENCODINGS]),
)  # fmt: skip
FIELDS = st.sampled_from(["width", "height", "step", "encoding", "is_bigendian", "data"])


@settings(max_examples=300)
@given(st.dictionaries(FIELDS, JUNK, min_size=1), st.sampled_from([rgb_image, depth_image]))
def test_any_mutation_gives_the_declared_shape_or_a_message_error(fields, convert):
    message = changed(GOOD, **fields)
    try:
        got = convert(message)
    except MessageError as error:
        assert str(error) and "\n" not in str(error)
    else:
        assert got.shape[:2] == (message.height, message.width)
        assert len(message.data) == message.step * message.height


@settings(max_examples=150)
@given(st.sampled_from([JPEG, PNG8, PNG16, compressed_depth(MM)]), st.data())
def test_any_damage_to_a_compressed_file_gives_an_array_or_a_message_error(file, data):
    at = data.draw(st.integers(0, len(file) - 1))
    cut = data.draw(st.integers(0, len(file)))
    kind = data.draw(st.sampled_from(["jpeg", "png", "16UC1; compressedDepth png", "32FC1; compressedDepth png"]))
    for convert, ndim in ((rgb_image, 3), (depth_image, 2)):
        try:
            got = convert(compressed(damaged(file, at)[:cut], kind))
        except MessageError as error:
            assert str(error)
        else:
            assert got.ndim == ndim and max(got.shape) <= 8192


@pytest.mark.parametrize("library", LIBRARIES)
def test_header_is_read(library):
    message = image(GREY, "mono8", library, stamp_ns=1_600_000_000_123_456_789, frame_id="left")
    assert header_stamp_ns(message) == 1_600_000_000_123_456_789
    assert header_frame_id(message) == "left"


def test_unset_stamp_is_refused():
    with pytest.raises(MessageError, match=r"header\.stamp is zero"):
        header_stamp_ns(image(GREY, "mono8", stamp_ns=0))
    message = image(GREY, "mono8")
    message.header.stamp.nanosec = 10**9
    with pytest.raises(MessageError, match="nanosec is 1000000000"):
        header_stamp_ns(message)
    message.header.frame_id = 3
    with pytest.raises(MessageError, match="frame_id is int: expected text"):
        header_frame_id(message)
