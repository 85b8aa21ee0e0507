# SPDX-License-Identifier: Apache-2.0
"""ScanNet-1500: 1500 pairs of indoor RGB-D frames, the usual set for relative pose.

    FOLDER/test.npz                                     `name` (n, 4) whole numbers: scene, scan, frame 0, frame 1
    FOLDER/sceneNNNN_NN/color/N.jpg                     resized here to 640x480
    FOLDER/sceneNNNN_NN/depth/N.png                     640x480, 16 bit, mm, 0 = none
    FOLDER/sceneNNNN_NN/pose/N.txt                      4x4 camera to world, m
    FOLDER/sceneNNNN_NN/intrinsic/intrinsic_depth.txt   4x4; without it intrinsic_color.txt is taken and resized

As of the release that the matchers' repositories link to (`scannet_test_1500`), colour and depth cameras count as one.
Where test.npz also has `rel_pose` (n, 12: rows of the 3x4 source-to-target matrix), it has to agree with the poses.
"""

from __future__ import annotations

import functools
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt

from bench.pairs.pair import Pair
from bench.pairs.readers.dataset_files import (
    Candidate,
    Rgb,
    arrays,
    depth_map,
    gathered,
    image,
    matrix,
    pair_of,
    require,
    rigid,
    view,
)
from garps_core.checks import Float64Array, IntArray
from garps_core.geometry import se3_inverse
from garps_core.metrics import rotation_error_deg, translation_error_m
from garps_core.types import View

NAME = "scannet1500"
SIZE = (640, 480)
LAYOUT = "test.npz and sceneNNNN_NN/ with color/N.jpg, depth/N.png, pose/N.txt and intrinsic/intrinsic_depth.txt"
AGREE_M, AGREE_DEG = 0.05, 1.0


def read(folder: Path, *, limit: int | None = None, skipped: list[str] | None = None, depth: bool = True) -> list[Pair]:
    """The pairs of test.npz.

    Args:
        folder: of the release.
        limit: largest number of pairs, spread evenly; all 1500 with depth take about 7 GB.
        skipped: a list to name pairs with missing files in, instead of raising.
        depth: False reads colour only; then there are no true points.
    Raises:
        MissingFiles: with the first few of them.
        ValueError: files that are not what they should be.
    """
    require(LAYOUT, folder / "test.npz")
    names, truth = _table(folder / "test.npz")
    view_of = functools.cache(functools.partial(_view, depth=depth))

    def made(pair_id: str, scene: Path, i: int, j: int, expected: Float64Array | None) -> Pair:
        T = se3_inverse(_pose(scene, j)) @ _pose(scene, i)
        if expected is not None:
            _check_agreement(f"{folder / 'test.npz'}: {pair_id}", T, expected)
        return pair_of(NAME, pair_id, view_of(scene, i), view_of(scene, j), T)

    candidates = []
    for (number, scan, i, j), expected in zip(names.tolist(), truth, strict=True):
        scene = folder / f"scene{number:04d}_{scan:02d}"
        pair_id = f"{scene.name}/{i}-{j}"
        files = (*_files(scene, i, depth), *_files(scene, j, depth), _intrinsics(scene))
        candidates.append(Candidate(pair_id, files, functools.partial(made, pair_id, scene, i, j, expected)))
    return gathered(candidates, LAYOUT, limit, skipped)


def _table(path: Path) -> tuple[IntArray, list[Any]]:
    """Rows of `name`, and of `rel_pose` as 3x4 or None."""
    stored = arrays(path)
    names: npt.NDArray[Any] = stored.get("name", np.zeros(0))
    if names.ndim != 2 or names.shape[1] != 4 or names.dtype.kind not in "iu" or (names < 0).any():
        raise ValueError(f"{path}: expected an array `name`, (n, 4) whole numbers: scene, scan, frame 0, frame 1")
    if "rel_pose" not in stored:
        return names, [None] * len(names)
    truth = stored["rel_pose"]
    if truth.shape not in ((len(names), 12), (len(names), 3, 4)) or truth.dtype.kind != "f":
        raise ValueError(f"{path}: `rel_pose` is {truth.dtype} {truth.shape}, expected ({len(names)}, 12) floats")
    return names, list(truth.reshape(-1, 3, 4))


def _files(scene: Path, frame: int, depth: bool) -> tuple[Path, ...]:
    files = (scene / "color" / f"{frame}.jpg", scene / "pose" / f"{frame}.txt")
    return (*files, scene / "depth" / f"{frame}.png") if depth else files


def _intrinsics(scene: Path) -> Path:
    depth, colour = (scene / "intrinsic" / f"intrinsic_{which}.txt" for which in ("depth", "color"))
    return colour if colour.is_file() and not depth.is_file() else depth


def _pose(scene: Path, frame: int) -> Float64Array:
    path = scene / "pose" / f"{frame}.txt"
    return rigid(path, matrix(path))


def _check_agreement(where: str, T: Float64Array, expected: Float64Array) -> None:
    told = rigid(where, np.vstack([expected, (0, 0, 0, 1)]))
    metres, degrees = translation_error_m(T, told), rotation_error_deg(T, told)
    if metres > AGREE_M or degrees > AGREE_DEG:
        raise ValueError(f"{where}: rel_pose is {metres:.3g} m and {degrees:.3g} deg off the pose files")


def _view(scene: Path, frame: int, depth: bool) -> View:
    path, intrinsics = scene / "color" / f"{frame}.jpg", _intrinsics(scene)
    rgb = image(path)
    K = matrix(intrinsics)[:3, :3]
    if intrinsics.stem == "intrinsic_color":
        K = resized_intrinsics(K, rgb.shape[1::-1], SIZE)
    if not 0.25 < K[0, 2] / SIZE[0] < 0.75:
        raise ValueError(
            f"{intrinsics}: cx is {K[0, 2]:.1f} px at a width of {SIZE[0]}; is it of an image of another size?"
        )
    small: Rgb = np.asarray(cv2.resize(rgb, SIZE, interpolation=cv2.INTER_AREA), np.uint8)
    return view(path, small, K, depth_map(scene / "depth" / f"{frame}.png") if depth else None)


def resized_intrinsics(K: Float64Array, size: tuple[int, ...], new: tuple[int, int]) -> Float64Array:
    """K of an image resized from one (width, height) to another; pixel centres at integers before and after."""
    x, y = new[0] / size[0], new[1] / size[1]
    return np.array([[x, 0, (x - 1) / 2], [0, y, (y - 1) / 2], [0, 0, 1]]) @ K
