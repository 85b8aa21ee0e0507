# SPDX-License-Identifier: Apache-2.0
"""7-Scenes: Kinect sequences of seven small indoor scenes, poses by dense tracking.

    FOLDER/TestSplit.txt                     "sequence3" per line, read as seq-03
    FOLDER/seq-XX/frame-NNNNNN.color.png     640x480
    FOLDER/seq-XX/frame-NNNNNN.depth.png     16 bit, mm, 0 and 65535 = none
    FOLDER/seq-XX/frame-NNNNNN.pose.txt      4x4 camera to world, m

FOLDER is one scene (chess, fire, ...). As of the set's page fx = fy = 585, cx = 320, cy = 240 for colour and depth,
which are not calibrated to each other: depth is off by some pixels from colour, whose focal length others put at 525,
and the poses are those of the depth camera. Good for metres, not for centimetres.
"""

from __future__ import annotations

import functools
import re
from pathlib import Path

from bench.pairs.pair import Pair, rng_of
from bench.pairs.readers.dataset_files import (
    Candidate,
    chosen,
    depth_map,
    frame_gaps,
    gathered,
    image,
    matrix,
    pair_of,
    pinhole,
    require,
    rigid,
    rows,
    view,
)
from garps_core.checks import Float64Array
from garps_core.geometry import se3_inverse
from garps_core.types import View

NAME = "seven_scenes"
K = pinhole(585.0, 585.0, 320.0, 240.0)
NO_DEPTH = 65535
SPLIT_FILE = "TestSplit.txt"
LAYOUT = f"{SPLIT_FILE} and seq-XX/frame-NNNNNN with .color.png, .depth.png and .pose.txt"


def read(
    folder: Path,
    *,
    limit: int | None = None,
    skipped: list[str] | None = None,
    gap: int = 20,
    count: int = 100,
    seed: int = 0,
) -> list[Pair]:
    """Pairs of frames `gap` apart, of the test sequences.

    Args:
        folder: one scene.
        limit: largest number of them, spread evenly.
        skipped: a list to name pairs with missing files in, instead of raising.
        gap: frames between source and target.
        count: pairs drawn.
        seed: of the draw.
    Raises:
        MissingFiles: with the first few of them.
        ValueError: files that are not what they should be.
    """
    require(LAYOUT, folder / SPLIT_FILE)
    sequences = {name: _frames(folder / name) for name in test_sequences(folder / SPLIT_FILE)}
    view_of = functools.cache(_view)
    scene = folder.resolve().name

    def made(source: Path, target: Path, pair_id: str) -> Pair:
        T = se3_inverse(_pose(target)) @ _pose(source)
        return pair_of(NAME, pair_id, view_of(source), view_of(target), T)

    def candidate(name: str, i: int) -> Candidate:
        source, target = sequences[name][i], sequences[name][i + gap]
        pair_id = f"{scene}/{name}/{source.name}-{target.name.removeprefix('frame-')}"
        return Candidate(pair_id, _files(source) + _files(target), functools.partial(made, source, target, pair_id))

    starts = frame_gaps({name: len(frames) for name, frames in sequences.items()}, gap)
    return gathered([candidate(*start) for start in chosen(starts, count, rng_of(scene, seed))], LAYOUT, limit, skipped)


def test_sequences(path: Path) -> list[str]:
    """Folders of a split file's sequences."""
    names = []
    for where, words in rows(path):
        found = re.fullmatch(r"(?:sequence|seq-?)(\d{1,4})", "".join(words))
        if found is None:
            raise ValueError(f"{where}: {' '.join(words)[:40]!r}, expected for instance 'sequence3'")
        names.append(f"seq-{int(found[1]):02d}")
    return names


def _frames(folder: Path) -> list[Path]:
    """Frames without the endings of their files, in order."""
    endings = (".color.png", ".depth.png", ".pose.txt")
    names = {path.name.split(".")[0] for path in folder.glob("frame-*") if path.name.endswith(endings)}
    return [folder / name for name in sorted(names)]


def _files(frame: Path) -> tuple[Path, Path, Path]:
    return _file(frame, "color.png"), _file(frame, "depth.png"), _file(frame, "pose.txt")


def _file(frame: Path, ending: str) -> Path:
    return frame.with_name(f"{frame.name}.{ending}")


def _pose(frame: Path) -> Float64Array:
    path = _file(frame, "pose.txt")
    return rigid(path, matrix(path))


def _view(frame: Path) -> View:
    path = _file(frame, "color.png")
    return view(path, image(path), K, depth_map(_file(frame, "depth.png"), none=NO_DEPTH))
