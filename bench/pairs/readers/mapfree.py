# SPDX-License-Identifier: Apache-2.0
"""Map-free relocalisation: one reference photograph and a sequence of queries per outdoor place, metric truth.

    FOLDER/sNNNNN/seq0/frame_00000.jpg     the reference
    FOLDER/sNNNNN/seq1/frame_NNNNN.jpg     queries; every 5th is evaluated, from the first on
    FOLDER/sNNNNN/poses.txt                image qw qx qy qz tx ty tz, world to camera, m
    FOLDER/sNNNNN/intrinsics.txt           image fx fy cx cy width height, px

FOLDER is `val` (or `test`, whose poses are zeros: its truth is withheld, and such scenes are refused). Frame numbers
may have holes; "every 5th" counts the frames that are there, as the benchmark's own code does. There is no depth.
"""

from __future__ import annotations

import functools
from pathlib import Path

import numpy as np

from bench.pairs.pair import Pair
from bench.pairs.readers.dataset_files import (
    Candidate,
    floats,
    gathered,
    image,
    inside,
    pair_of,
    pinhole,
    quaternion_pose,
    require,
    rows,
    view,
)
from garps_core.checks import Float64Array
from garps_core.geometry import se3_inverse
from garps_core.types import View

NAME = "mapfree"
REFERENCE = "seq0/frame_00000.jpg"
EVERY = 5
LAYOUT = "sNNNNN/ with seq0/frame_00000.jpg, seq1/frame_*.jpg, poses.txt and intrinsics.txt"
Rows = dict[str, tuple[str, Float64Array]]


def read(folder: Path, *, limit: int | None = None, skipped: list[str] | None = None, every: int = EVERY) -> list[Pair]:
    """Pairs of reference (source) and query (target) of all scenes.

    Args:
        folder: with the scenes.
        limit: largest number of pairs, spread evenly; all of `val` take about 10 GB.
        skipped: a list to name pairs with missing images in, instead of raising.
        every: take every so-many-th query.
    Raises:
        MissingFiles: with the first few of them.
        ValueError: files that are not what they should be, or a withheld truth.
    """
    scenes = sorted(path for path in folder.glob("s[0-9]*") if path.is_dir())
    require(LAYOUT, *(scene / name for scene in scenes for name in ("poses.txt", "intrinsics.txt")))
    return gathered([item for scene in scenes for item in _scene(scene, every)], LAYOUT, limit, skipped)


def _scene(scene: Path, every: int) -> list[Candidate]:
    poses = _rows(scene / "poses.txt", "qw qx qy qz tx ty tz")
    cameras = _rows(scene / "intrinsics.txt", "fx fy cx cy width height")
    if [name for name in poses if name.startswith("seq0/")] != [REFERENCE]:
        raise ValueError(f"{scene / 'poses.txt'}: expected one reference, {REFERENCE}; is it a training scene?")
    view_of = functools.cache(functools.partial(_view, scene, cameras))

    def made(query: str) -> Pair:
        T = _pose(*poses[query]) @ se3_inverse(_pose(*poses[REFERENCE]))
        return pair_of(NAME, _id(scene, query), view_of(REFERENCE), view_of(query), T)

    queries = sorted(name for name in poses if name.startswith("seq1/"))[::every]
    return [
        Candidate(_id(scene, query), (scene / REFERENCE, scene / query), functools.partial(made, query))
        for query in queries
    ]


def _id(scene: Path, query: str) -> str:
    return f"{scene.name}/{Path(query).stem}"


def _rows(path: Path, columns: str) -> Rows:
    """Image -> where its line is, and its numbers."""
    found: Rows = {}
    for where, words in rows(path):
        inside(path.parent, words[0], where)
        found[words[0]] = where, floats(where, words[1:], columns)
    return found


def _pose(where: str, values: Float64Array) -> Float64Array:
    return quaternion_pose(where, np.roll(values[:4], -1), values[4:])


def _view(scene: Path, cameras: Rows, name: str) -> View:
    if name not in cameras:
        raise ValueError(f"{scene / 'intrinsics.txt'}: no line for {name}")
    where, (fx, fy, cx, cy, width, height) = cameras[name]
    rgb = image(scene / name)
    if rgb.shape[:2] != (height, width):
        raise ValueError(f"{where}: {width:g}x{height:g}, but the image is {rgb.shape[1]}x{rgb.shape[0]}")
    return view(scene / name, rgb, pinhole(fx, fy, cx, cy))
