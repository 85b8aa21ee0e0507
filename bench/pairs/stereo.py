# SPDX-License-Identifier: Apache-2.0
"""The recorded stereo pairs of the demo, and metric depth for both of their cameras.

Twelve rectified OAK-D Lite pairs of homes, 640x480, by Nicolas Burrus, CC BY 4.0, installed with the package
stereodemo (of which nothing is imported).
"""

from __future__ import annotations

import importlib.util
import json
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
import numpy.typing as npt

UInt8 = npt.NDArray[np.uint8]
Float32 = npt.NDArray[np.float32]
DISPARITIES = 96
"""Search range, pixels: nothing closer than 0.35 m is found."""
AGREEMENT_PX = 1.0
MAX_DEPTH_M = 6.0
"""Beyond, one pixel of disparity is more than a metre."""


@dataclass(frozen=True, eq=False)
class StereoPair:
    """A rectified pair and its calibration.

    Args:
        name: of the scene.
        left, right: HxWx3 uint8 RGB.
        K: 3x3 pixels, of both cameras.
        baseline_m: distance of the cameras; the right one is to the right.
    """

    name: str
    left: UInt8
    right: UInt8
    K: npt.NDArray[np.float64]
    baseline_m: float

    @property
    def T_right_left(self) -> npt.NDArray[np.float64]:
        """The truth: 4x4, points of the left camera into the right one, metres."""
        T = np.eye(4)
        T[0, 3] = -self.baseline_m
        return T


def load_stereo_pairs() -> list[StereoPair]:
    """The twelve pairs, by name. Raises FileNotFoundError when stereodemo is not installed."""
    spec = importlib.util.find_spec("stereodemo")
    if spec is None or not spec.submodule_search_locations:
        raise FileNotFoundError(
            "stereodemo is not installed: expected `make demo`, or pip install --no-deps stereodemo"
        )
    folder = Path(spec.submodule_search_locations[0]) / "datasets" / "oak-d"
    calibration = json.loads((folder / "stereodemo_calibration.json").read_text())
    K = np.array(
        [
            [calibration["fx"], 0, calibration["cx0"]],
            [0, calibration["fy"], calibration["cy"]],
            [0, 0, 1],
        ]
    )
    names = sorted(path.name.removesuffix("_left.png") for path in folder.glob("*_left.png"))
    return [
        StereoPair(
            name,
            _rgb(folder / f"{name}_left.png"),
            _rgb(folder / f"{name}_right.png"),
            K,
            calibration["baseline_meters"],
        )
        for name in names
    ]


def _rgb(path: Path) -> UInt8:
    return np.ascontiguousarray(cv2.imread(str(path), cv2.IMREAD_COLOR)[:, :, ::-1], dtype=np.uint8)


def depth_of_both(pair: StereoPair) -> tuple[Float32, Float32]:
    """Depth HxW float32 metres for the left and the right image, NaN where the two directions disagree."""
    left, right = (cv2.cvtColor(image, cv2.COLOR_RGB2GRAY) for image in (pair.left, pair.right))
    d_left = _disparity(left, right)
    # Mirrored, the right camera is the left one of a pair: the same matcher gives its disparity.
    d_right = _disparity(right[:, ::-1], left[:, ::-1])[:, ::-1]
    columns = np.arange(left.shape[1], dtype=np.float32)[None, :]
    d_left, d_right = (
        np.where(_agrees(d_left, d_right, columns - d_left), d_left, np.nan),
        np.where(_agrees(d_right, d_left, columns + d_right), d_right, np.nan),
    )
    scale = pair.K[0, 0] * pair.baseline_m
    return _metres(d_left, scale), _metres(d_right, scale)


def _disparity(left: UInt8, right: UInt8) -> Float32:
    """Pixels, NaN = none."""
    block = 5
    matcher = cv2.StereoSGBM_create(
        minDisparity=0,
        numDisparities=DISPARITIES,
        blockSize=block,
        P1=8 * block**2,
        P2=32 * block**2,
        disp12MaxDiff=-1,  # checked here against the other image's own disparity
        uniquenessRatio=10,
        speckleWindowSize=200,
        speckleRange=2,
        mode=cv2.STEREO_SGBM_MODE_HH,
    )
    # Borders are repeated so that the first columns, which a search to the left cannot match, are not lost twice.
    padded = [cv2.copyMakeBorder(image, 0, 0, DISPARITIES, 0, cv2.BORDER_REPLICATE) for image in (left, right)]
    raw = matcher.compute(*padded)[:, DISPARITIES:].astype(np.float32) / 16
    return np.where(raw > 1, raw, np.nan)


def _agrees(own: Float32, other: Float32, columns: Float32) -> npt.NDArray[np.bool_]:
    """Whether the other image's disparity at the matched column (rounded) is the same to a pixel."""
    known = np.isfinite(columns) & (columns >= 0) & (columns <= own.shape[1] - 1)
    index = np.where(known, np.rint(np.where(known, columns, 0)), 0).astype(int)
    back = np.take_along_axis(other, index, axis=1)
    with np.errstate(invalid="ignore"):
        return np.asarray(known & (np.abs(back - own) <= AGREEMENT_PX))


def _metres(disparity: Float32, scale: float) -> Float32:
    with np.errstate(invalid="ignore"):
        depth = scale / disparity
        return np.where(depth <= MAX_DEPTH_M, depth, np.nan).astype(np.float32)
