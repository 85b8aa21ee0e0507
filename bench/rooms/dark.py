# SPDX-License-Identifier: Apache-2.0
"""A dim room as a moving camera records it: less light, motion blur, shot and read noise."""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
import numpy.typing as npt

EXPOSURE = 0.3
"""Share of the light of a well exposed image: the shutter is at its limit."""
BLUR_PX = 8.0
"""Length of the motion blur at 640 px width: a turn of about 0.4 rad/s over 1/30 s."""
WHITE_ELECTRONS = 150.0
"""Photons counted at white: a small sensor at a high gain."""
READ_ELECTRONS = 2.0
GAMMA = 2.2


def in_the_dark(rgb: npt.NDArray[np.uint8], rng: np.random.Generator) -> npt.NDArray[np.uint8]:
    """HxWx3 uint8 -> the same scene, taken with less light by a moving camera."""
    light: npt.NDArray[Any] = (rgb / 255.0) ** GAMMA * EXPOSURE
    light = cv2.filter2D(light, -1, _streak(BLUR_PX * rgb.shape[1] / 640, rng), borderType=cv2.BORDER_REFLECT)
    electrons = rng.poisson(light * WHITE_ELECTRONS) + rng.normal(0, READ_ELECTRONS, light.shape)
    return np.rint(255 * np.clip(electrons / WHITE_ELECTRONS, 0, 1) ** (1 / GAMMA)).astype(np.uint8)


def _streak(length_px: float, rng: np.random.Generator) -> npt.NDArray[np.float32]:
    """Kernel of a straight motion in a random direction."""
    angle, reach = rng.uniform(0, np.pi), int(np.ceil(length_px / 2))
    end = np.rint(np.array([np.cos(angle), np.sin(angle)]) * length_px / 2).astype(int)
    kernel = np.zeros((2 * reach + 1, 2 * reach + 1), np.float32)
    cv2.line(kernel, (reach - end).tolist(), (reach + end).tolist(), 1.0)
    return np.asarray(kernel / kernel.sum(), np.float32)
