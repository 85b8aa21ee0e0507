# SPDX-License-Identifier: Apache-2.0
"""Image and depth files -> View. Pictures are read only here in the core."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt

from garps_core.checks import Float32Array, Float64Array
from garps_core.errors import InputError
from garps_core.types import MAX_IMAGE_PIXELS, View

MILLIMETRE = 0.001


def read_view(
    image: Path,
    K: Float64Array,
    depth: Path | None = None,
    depth_scale: float | None = None,
    K_estimated: bool = False,
) -> View:
    """Read a colour image and, when given, its registered depth.

    Args:
        image: a file that OpenCV decodes to colour (PNG, JPEG, ...). EXIF rotation is ignored: K belongs to the stored
            pixels.
        K: 3x3, px.
        depth: see `read_depth`.
        depth_scale: metres per unit of the depth file; None = 0.001 for integers, 1 for floats.
        K_estimated: K is a network's estimate.
    Raises:
        InputError: a file is missing, is no image, or does not fit the other; the text names the file.
    """
    rgb = read_image(image)
    metres = None if depth is None else read_depth(depth, depth_scale)
    try:
        return View(rgb=rgb, K=K, depth=metres, frame_id=image.stem, K_estimated=K_estimated)
    except InputError as error:
        raise InputError(f"{image}{f' with {depth}' if depth else ''}: {error}") from None


def read_image(path: Path) -> npt.NDArray[np.uint8]:
    """Read an image file. Returns HxWx3 uint8, red first; raises InputError."""
    bgr = _decoded(path, cv2.IMREAD_COLOR | cv2.IMREAD_IGNORE_ORIENTATION, "a colour image (PNG, JPEG, ...)")
    return np.ascontiguousarray(bgr[:, :, ::-1], dtype=np.uint8)


def read_depth(path: Path, scale: float | None = None) -> Float32Array:
    """Read depth from a 16-bit PNG or TIFF, a float TIFF, or a .npy file.

    Args:
        path: the file.
        scale: metres per unit; None = 0.001 for integers, 1 for floats.
    Returns:
        HxW float32 metres, NaN = no reading.
    Raises:
        InputError: the file cannot be read or decoded, or has the wrong shape, type or scale.
    """
    raw = _loaded_npy(path) if path.suffix.lower() == ".npy" else _decoded(path, cv2.IMREAD_UNCHANGED, "a depth image")
    if raw.ndim != 2 or raw.dtype.kind not in "uif" or raw.dtype.itemsize == 1:
        raise InputError(
            f"{path} holds {raw.dtype} {'x'.join(map(str, raw.shape))}: "
            "expected one channel of 16-bit integers (millimetres) or floats (metres)"
        )
    if scale is None:
        scale = 1.0 if raw.dtype.kind == "f" else MILLIMETRE
    if not (np.isfinite(scale) and scale > 0):
        raise InputError(f"depth scale is {scale:g}: expected metres per unit, positive, e.g. 0.001 for millimetres")
    metres = raw.astype(np.float64) * scale
    return np.where(np.isfinite(metres) & (metres != 0), metres, np.nan).astype(np.float32)


def _decoded(path: Path, flags: int, expected: str) -> npt.NDArray[Any]:
    try:
        data = np.fromfile(path, np.uint8)  # not cv2.imread: that prints, and knows no Unicode names on Windows
    except OSError as error:
        raise InputError(f"cannot read {path} ({error.strerror}): expected {expected}") from None
    try:
        image = cv2.imdecode(data, flags) if data.size else None
    except cv2.error:  # the decoder's own limit on the number of pixels
        image = None
    if image is None:
        raise InputError(f"{path} is no image that can be decoded ({data.size} bytes): expected {expected}")
    _check_size(path, image.shape)
    return np.asarray(image)


def _loaded_npy(path: Path) -> npt.NDArray[Any]:
    try:
        lazy = np.load(path, mmap_mode="r", allow_pickle=False)  # the header first: its size is checked before reading
    except OSError as error:
        raise InputError(f"cannot read {path} ({error.strerror or error}): expected a .npy file of metres") from None
    except (ValueError, EOFError) as error:
        raise InputError(f"{path} is no plain .npy array ({error}): expected HxW floats, metres") from None
    _check_size(path, lazy.shape)
    return np.array(lazy)


def _check_size(path: Path, shape: tuple[int, ...]) -> None:
    if len(shape) >= 2 and shape[0] * shape[1] > MAX_IMAGE_PIXELS:
        raise InputError(
            f"{path} is {shape[1]}x{shape[0]}: expected at most {MAX_IMAGE_PIXELS} pixels. Resize the image."
        )
