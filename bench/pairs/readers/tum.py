# SPDX-License-Identifier: Apache-2.0
"""TUM RGB-D: hand-held Kinect sequences with motion-capture truth.

    FOLDER/rgb.txt, depth.txt     stamp (s) and file, lines with # are comments
    FOLDER/groundtruth.txt        stamp tx ty tz qx qy qz qw, colour camera to world, m
    FOLDER/rgb/, depth/           8-bit PNG, and 16-bit PNG with 5000 per metre, 0 = none, registered to colour

As of the set's own page, depth needs no further correction factor, and calibrations hold per series: they are chosen
by "freiburg1", "freiburg2" or "freiburg3" in the folder's name. Colour and depth are undistorted to the pinhole camera
of the same K (series 3 is so already). Truth is good to about 1 cm and 0.5 deg.
"""

from __future__ import annotations

import functools
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from bench.pairs.pair import Pair, rng_of
from bench.pairs.readers.dataset_files import (
    Candidate,
    chosen,
    depth_map,
    floats,
    frame_gaps,
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
from garps_core.checks import Float64Array, IntArray
from garps_core.geometry import se3_inverse
from garps_core.types import View
from msg_adapters.undistort import undistorted_pair

NAME = "tum"
PER_METRE = 5000.0
TOLERANCE_S = 0.02
LAYOUT = "rgb.txt, depth.txt, groundtruth.txt and the images they name"
CALIBRATIONS = {
    "freiburg1": (517.306408, 516.469215, 318.643040, 255.313989),
    "freiburg2": (520.908620, 521.007327, 325.141442, 249.701764),
    "freiburg3": (535.4, 539.2, 320.1, 247.6),
}
"""Intrinsics fx, fy, cx, cy in px of the 640x480 colour image."""
DISTORTIONS = {
    "freiburg1": (0.262383, -0.953104, -0.005358, 0.002628, 1.163314),
    "freiburg2": (0.231222, -0.784899, -0.003257, -0.000105, 0.917205),
}


@dataclass(frozen=True, eq=False)
class Frame:
    """A colour image with the depth and the pose nearest in time.

    Args:
        stamp: s, as written.
        rgb, depth: files.
        T_world_camera: 4x4, m.
    """

    stamp: str
    rgb: Path
    depth: Path
    T_world_camera: Float64Array


def read(
    folder: Path,
    *,
    limit: int | None = None,
    skipped: list[str] | None = None,
    gap: int = 10,
    count: int = 100,
    seed: int = 0,
    series: str | None = None,
) -> list[Pair]:
    """Pairs of frames `gap` apart.

    Args:
        folder: one sequence.
        limit: largest number of them, spread evenly.
        skipped: a list to name pairs with missing images in, instead of raising.
        gap: frames (those that have depth and truth) between source and target.
        count: pairs drawn.
        seed: of the draw.
        series: of `CALIBRATIONS`; None = by the folder's name.
    Raises:
        MissingFiles: with the first few of them.
        ValueError: files that are not what they should be, or no calibration.
    """
    series = series or next((name for name in CALIBRATIONS if name in folder.resolve().name), "")
    if series not in CALIBRATIONS:
        raise ValueError(f"{folder}: series {series!r}, expected one of {', '.join(CALIBRATIONS)} in the name")
    frames = frames_of(folder)
    view_of = functools.cache(functools.partial(_view, series=series))

    def made(source: Frame, target: Frame, pair_id: str) -> Pair:
        T = se3_inverse(target.T_world_camera) @ source.T_world_camera
        return pair_of(NAME, pair_id, view_of(source.rgb, source.depth), view_of(target.rgb, target.depth), T)

    def candidate(source: Frame, target: Frame) -> Candidate:
        pair_id = f"{folder.resolve().name}/{source.stamp}-{target.stamp}"
        files = (source.rgb, source.depth, target.rgb, target.depth)
        return Candidate(pair_id, files, functools.partial(made, source, target, pair_id))

    starts = chosen(frame_gaps({"": len(frames)}, gap), count, rng_of(folder.resolve().name, seed))
    return gathered([candidate(frames[i], frames[i + gap]) for _, i in starts], LAYOUT, limit, skipped)


def frames_of(folder: Path) -> list[Frame]:
    """Colour images in order of time that have depth and a pose within 20 ms."""
    require(LAYOUT, *(folder / name for name in ("rgb.txt", "depth.txt", "groundtruth.txt")))
    colour, depth = _files(folder / "rgb.txt"), _files(folder / "depth.txt")
    poses = [(words[0], _pose(where, words)) for where, words in rows(folder / "groundtruth.txt")]
    at = np.array([float(stamp) for stamp, _ in colour])
    with_depth, with_pose = (
        nearest(np.array([float(item[0]) for item in items]), at, TOLERANCE_S) for items in (depth, poses)
    )
    found = [
        (float(stamp), Frame(stamp, path, depth[d][1], poses[p][1]))
        for (stamp, path), d, p in zip(colour, with_depth, with_pose, strict=True)
        if d >= 0 and p >= 0
    ]
    return [frame for _, frame in sorted(found, key=lambda item: item[0])]


def nearest(stamps: Float64Array, at: Float64Array, tolerance: float) -> IntArray:
    """For each time the index of the nearest stamp (s, any order), -1 where it is further off than the tolerance."""
    if not len(stamps):
        return np.full(len(at), -1)
    order = np.argsort(stamps, kind="stable")
    right = np.searchsorted(stamps[order], at)
    sides = order[np.stack([right - 1, right]).clip(0, len(stamps) - 1)]
    best = sides[np.abs(stamps[sides] - at).argmin(0), np.arange(len(at))]
    return np.where(np.abs(stamps[best] - at) <= tolerance, best, -1)


def _files(path: Path) -> list[tuple[str, Path]]:
    found = []
    for where, words in rows(path):
        if len(words) != 2:
            raise ValueError(f"{where}: {len(words)} columns, expected 2: stamp file")
        floats(where, words[:1], "stamp")
        found.append((words[0], inside(path.parent, words[1], where)))
    return found


def _pose(where: str, words: list[str]) -> Float64Array:
    values = floats(where, words, "stamp tx ty tz qx qy qz qw")
    return quaternion_pose(where, values[4:], values[1:4])


def _view(rgb_file: Path, depth_file: Path, series: str) -> View:
    rgb, depth, K = image(rgb_file), depth_map(depth_file, PER_METRE), pinhole(*CALIBRATIONS[series])
    checked = view(rgb_file, rgb, K, depth)
    if series not in DISTORTIONS:
        return checked
    straight, registered = undistorted_pair(K, "plumb_bob", DISTORTIONS[series], checked.rgb, checked.depth)
    return view(rgb_file, straight, K, registered)
