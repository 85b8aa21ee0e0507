# SPDX-License-Identifier: Apache-2.0
"""Errors of real depth sources on a true depth map: a network's guess and a depth sensor's noise.

Depth maps are HxW metres along z; NaN (or anything not finite and positive) is no reading and stays NaN.
"""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
import numpy.typing as npt

Float32Array = npt.NDArray[np.float32]
BoolArray = npt.NDArray[np.bool_]

JUMP_RATIO = 1.15
BLUR_REACH_PX = 640 / 160  # at 640 px width a network rounds edges over about 4 px


def monocular_depth(
    depth: npt.NDArray[Any], rng: np.random.Generator, scale: float = 0.05, warp: float = 0.03
) -> Float32Array:
    """Depth as a metric monocular network might report it.

    Args:
        depth: HxW metres, NaN = no reading.
        rng: source of the error; the same state gives the same error.
        scale: the global scale is drawn from U(1 - scale, 1 + scale).
        warp: largest relative size of the smooth error (4x5 grid, bicubic, in log depth).
    Returns:
        HxW float32 metres, NaN exactly where `depth` had no reading.
    """
    clean, valid = _clean(depth)
    height, width = clean.shape
    gain = rng.uniform(1 - scale, 1 + scale)
    grid = rng.uniform(-warp, warp, (4, 5)).astype(np.float32)
    grain = rng.normal(0.0, 0.005, clean.shape).astype(np.float32)
    smooth = np.clip(cv2.resize(grid, (width, height), interpolation=cv2.INTER_CUBIC), -warp, warp)
    log_depth = np.log(np.where(valid, clean, 1.0))
    log_depth = _blur_at_jumps(log_depth.astype(np.float32), valid)
    out = np.exp(log_depth + smooth) * gain * (1 + grain)
    return np.where(valid, out, np.nan).astype(np.float32)


def sensor_depth(depth: npt.NDArray[Any], rng: np.random.Generator, far_m: float = 6.0) -> Float32Array:
    """Depth as an active stereo or time-of-flight camera might report it.

    Noise has sigma 1 mm + 2 mm/m^2 * z^2, a little correlated between neighbours; readings are whole millimetres;
    there are holes at depth edges, on surfaces seen at a grazing angle and towards `far_m`.

    Args:
        depth: HxW metres, NaN = no reading.
        rng: source of the noise.
        far_m: nothing is read beyond; holes grow over the last fifth.
    Returns:
        HxW float32 metres, NaN at least where `depth` had no reading.
    """
    clean, valid = _clean(depth)
    white = rng.normal(0.0, 1.0, clean.shape).astype(np.float32)
    patch = cv2.GaussianBlur(rng.normal(0.0, 1.0, clean.shape).astype(np.float32), (0, 0), 1.5)
    noise = 0.8 * white + 0.6 * patch / max(float(patch.std()), 1e-6)
    out = clean + (1e-3 + 2e-3 * clean**2) * noise
    out = np.round(out * 1000) / 1000
    lost = _sensor_holes(clean, valid, rng, far_m)
    return np.where(valid & ~lost & (out > 0), out, np.nan).astype(np.float32)


def _clean(depth: npt.NDArray[Any]) -> tuple[Float32Array, BoolArray]:
    """Depth with 0 for no reading, and where there is one."""
    values = np.asarray(depth, np.float32)
    with np.errstate(invalid="ignore"):
        valid = np.isfinite(values) & (values > 0)
    return np.where(valid, values, np.float32(0)), valid


def _jumps(log_depth: Float32Array, valid: BoolArray) -> npt.NDArray[np.uint8]:
    """1 where the depth of a 3x3 neighbourhood spans more than `JUMP_RATIO`; holes are no jump."""
    kernel = np.ones((3, 3), np.uint8)
    high = cv2.dilate(np.where(valid, log_depth, np.float32(-1e3)), kernel)
    low = cv2.erode(np.where(valid, log_depth, np.float32(1e3)), kernel)
    return np.asarray(valid & (high - low > np.log(JUMP_RATIO)), np.uint8)


def _blur_at_jumps(log_depth: Float32Array, valid: BoolArray) -> Float32Array:
    """Mix in a blurred map within a few pixels of depth edges; the blur looks at valid pixels only."""
    sigma = max(BLUR_REACH_PX * log_depth.shape[1] / 640 / 2, 0.7)
    reach = round(2 * sigma)
    jumps = _jumps(log_depth, valid)
    if not jumps.any():
        return log_depth
    near = cv2.dilate(jumps, cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * reach + 1, 2 * reach + 1)))
    blend = cv2.GaussianBlur(near.astype(np.float32), (0, 0), max(sigma / 2, 0.5)) * near
    weight = cv2.GaussianBlur(valid.astype(np.float32), (0, 0), sigma)
    total = cv2.GaussianBlur(np.where(valid, log_depth, np.float32(0)), (0, 0), sigma)
    blurred = total / np.maximum(weight, 1e-6)
    # A valid pixel is within its own blur window, so `weight` is well above zero wherever the result is used.
    return np.where(valid, log_depth + blend * (blurred - log_depth), log_depth).astype(np.float32)


def _sensor_holes(clean: Float32Array, valid: BoolArray, rng: np.random.Generator, far_m: float) -> BoolArray:
    """True where the sensor gives no reading."""
    chance = rng.random(clean.shape, dtype=np.float32)
    # Blotchy rather than single-pixel holes: the threshold varies slowly over the image.
    coarse = tuple(max(n // 12, 2) for n in clean.shape)
    blotch = cv2.resize(rng.random(coarse, dtype=np.float32), clean.shape[::-1], interpolation=cv2.INTER_CUBIC)
    level = 0.35 * chance + 0.65 * np.clip(blotch, 0, 1)

    log_depth = np.log(np.where(valid, clean, 1.0)).astype(np.float32)
    edges = cv2.dilate(_jumps(log_depth, valid), np.ones((3, 3), np.uint8)) > 0
    # Relative depth change per pixel on a smooth surface grows as the surface turns away; 640 px is the reference.
    reference = clean.shape[1] / 640
    slope = np.hypot(_gradient(log_depth, valid, 1), _gradient(log_depth, valid, 0)) * reference
    lost_grazing = np.clip((slope - 0.012) / 0.03, 0, 1)
    lost_far = np.clip((clean - 0.8 * far_m) / (0.2 * far_m), 0, 1)
    lost = (edges & (level < 0.8)) | (level < lost_grazing) | (level < lost_far)
    return np.asarray(lost | (clean > far_m) | (chance < 0.001), bool)


def _gradient(values: Float32Array, valid: BoolArray, axis: int) -> Float32Array:
    """Size of the smaller one-sided difference along an axis; 0 next to holes and the border."""
    step = np.abs(np.diff(values, axis=axis))
    both = np.logical_and(*(np.take(valid, range(s, valid.shape[axis] - 1 + s), axis=axis) for s in (0, 1)))
    step = np.where(both, step, np.float32(0))
    shape = list(values.shape)
    shape[axis] = 1
    zero = np.zeros(shape, np.float32)
    forward, backward = np.concatenate([step, zero], axis), np.concatenate([zero, step], axis)
    return np.asarray(np.minimum(forward, backward), np.float32)
