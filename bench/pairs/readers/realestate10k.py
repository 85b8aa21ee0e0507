# SPDX-License-Identifier: Apache-2.0
"""RealEstate10K: clips of videos with camera tracks, in an arbitrary unit per clip.

    FOLDER/cameras/SPLIT/CLIP.txt           the tracks as published, SPLIT = train or test
    FOLDER/frames/CLIP/TIMESTAMP.jpg        (or .png) frames cut from the videos, named by the tracks' microseconds
    FOLDER/points/CLIP.npz                  (or .txt) for "sfm-depth": Nx3 sparse points, world frame, clip's unit
    FOLDER/depth/CLIP/TIMESTAMP.png         for "sfm-depth": a network's depth of frame 0, 16 bit, mm, 0 = none
    FOLDER/pairs_test.jsonl                 written by `sample`, read by `read`; also pairs_validation.jsonl

A track is the video's URL and then 19 columns per frame: timestamp, fx fy cx cy in units of the image's width and
height, k1 k2 (zero), and the rows of the 3x4 world-to-camera matrix. Pixels: u = fx W x + cx W has pixel centres at .5,
so K here has cx W - 0.5. Frame 0 and frame 29 make a pair; shorter clips are not used. The paper this follows says
neither which clips it took nor the unit of its 0.3 m: here clips come in seeded order, and the scale is in the list.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from bench.pairs.pair import Pair, rng_of
from bench.pairs.readers import pair_list
from bench.pairs.readers.dataset_files import (
    MissingFiles,
    category_of,
    depth_map,
    floats,
    image,
    pinhole,
    require,
    rigid,
    rows,
    text_of,
)
from bench.pairs.readers.pair_list import RAW, Record
from bench.pairs.readers.sfm_scale import SOURCE, depth_scale, points_file, read_points
from garps_core.checks import Float64Array
from garps_core.geometry import se3_inverse, transform

NAME = "realestate10k"
FIRST, LAST = 0, 29
SPLITS = {"test": ("test", 100), "validation": ("train", 10)}
"""Folder of tracks that a list is drawn from, and pairs of each category."""
SCALES = (RAW, SOURCE)
COLUMNS = "timestamp fx fy cx cy k1 k2 r11 r12 r13 t1 r21 r22 r23 t2 r31 r32 r33 t3"
LAYOUT = "cameras/SPLIT/CLIP.txt and frames/CLIP/TIMESTAMP.jpg or .png"
LAYOUT_SFM = f"{LAYOUT}, for {SOURCE} also depth/CLIP/TIMESTAMP.png and points/CLIP.npz or .txt"


@dataclass(frozen=True, eq=False)
class Camera:
    """One line of a track.

    Args:
        timestamp: microseconds.
        fx, fy, cx, cy: in units of the image's width (x) and height (y).
        T_camera_world: 4x4, translation in the clip's unit.
    """

    timestamp: int
    fx: float
    fy: float
    cx: float
    cy: float
    T_camera_world: Float64Array

    def K(self, width: int, height: int) -> Float64Array:
        """3x3 in pixels of an image of this size, pixel centres at integers."""
        return pinhole(self.fx * width, self.fy * height, self.cx * width - 0.5, self.cy * height - 0.5)


def read_track(path: Path) -> list[Camera]:
    """A camera track. Raises ValueError, one line with file and line number, for what is malformed."""
    first = text_of(path).partition("\n")[0].split()
    if len(first) != 1:
        raise ValueError(f"{path}:1: {len(first)} words, expected the URL of the video")
    return [_camera(where, words) for where, words in rows(path, header=1)]


def _camera(where: str, words: list[str]) -> Camera:
    values = floats(where, words, COLUMNS)
    if not words[0].isdecimal():
        raise ValueError(f"{where}: timestamp {words[0]!r}, expected whole microseconds")
    if (values[1:3] <= 0).any():
        raise ValueError(f"{where}: focal lengths {values[1]:g} {values[2]:g}, expected both positive")
    if values[5:7].any():
        raise ValueError(f"{where}: distortion {values[5]:g} {values[6]:g}, expected zeros")
    T = np.vstack([values[7:].reshape(3, 4), (0, 0, 0, 1)])
    if abs(np.linalg.det(T[:3, :3]) - 1) > 1e-3:
        raise ValueError(f"{where}: determinant {np.linalg.det(T[:3, :3]):.4g}, expected a rotation, 1 to 1e-3")
    fx, fy, cx, cy = map(float, values[1:5])
    return Camera(int(words[0]), fx, fy, cx, cy, rigid(where, T))


def relative(source: Camera, target: Camera) -> Float64Array:
    """4x4 T_target_source: R = R1 R0^T, t = t1 - R t0, in the clip's unit."""
    return np.asarray(target.T_camera_world @ se3_inverse(source.T_camera_world))


def frame_file(folder: Path, clip: str, camera: Camera) -> Path:
    """FOLDER/frames/CLIP/TIMESTAMP.jpg, or .png where only that is there."""
    jpg = folder / "frames" / clip / f"{camera.timestamp}.jpg"
    png = jpg.with_suffix(".png")
    return png if png.is_file() and not jpg.is_file() else jpg


def depth_file(folder: Path, clip: str, camera: Camera) -> Path:
    """FOLDER/depth/CLIP/TIMESTAMP.png."""
    return folder / "depth" / clip / f"{camera.timestamp}.png"


def list_file(split: str) -> str:
    """Name of the pair list of a split."""
    if split not in SPLITS:
        raise ValueError(f"split is {split!r}: expected one of {', '.join(SPLITS)}")
    return f"pairs_{split}.jsonl"


def read(
    folder: Path, *, limit: int | None = None, skipped: list[str] | None = None, split: str = "test"
) -> list[Pair]:
    """The pairs of the list that `sample` wrote, and nothing else; arguments as for `pair_list.read`."""
    require(f"the list that `bench.pairs.readers.{NAME}.sample` writes", folder / list_file(split))
    return pair_list.read(folder, limit=limit, skipped=skipped, list_file=list_file(split), name=NAME)


def sample(
    folder: Path,
    *,
    split: str = "test",
    scale: str = RAW,
    seed: int = 0,
    each: int | None = None,
    skipped: list[str] | None = None,
) -> list[Record]:
    """Choose clips in seeded order until both categories are full, and write the pair list.

    Args:
        folder: of the data set, see the module.
        split: "test" (100 small and 100 large) or "validation" (10 and 10 of the training tracks).
        scale: "raw" (the clip's unit, also for the 0.3 of the categories) or "sfm-depth" (`sfm_scale`), which may be
            followed by whose depth it is, "sfm-depth:NAME".
        seed: of the order, and of the draws of "sfm-depth".
        each: pairs of each category, instead of the split's.
        skipped: a list to name unusable clips (files missing, malformed, no scale) in, instead of raising.
    Raises:
        MissingFiles: the frames and whatever else of the chosen clips is not there.
        ValueError: malformed tracks, no scale, not enough clips, or a list that exists.
    """
    path = folder / list_file(split)
    if scale != RAW and scale.partition(":")[0] != SOURCE:
        raise ValueError(f"scale is {scale!r}: expected one of {', '.join(SCALES)}")
    if path.exists():
        raise ValueError(f"{path} exists: a list is written once; remove it to choose anew")
    each = SPLITS[split][1] if each is None else each
    records = _chosen(folder, split, scale, seed, each, skipped)
    pair_list.write(path, records)
    return records


def _chosen(folder: Path, split: str, scale: str, seed: int, each: int, skipped: list[str] | None) -> list[Record]:
    room = {"small": each, "large": each}
    records: list[Record] = []
    absent: list[Path] = []
    for track in _in_seeded_order(folder, split, seed):
        if not any(room.values()):
            break
        try:
            record = _record(folder, track, scale, seed, room)
        except ValueError as error:
            if skipped is not None:
                skipped.append(f"{track.stem}: {error}")
            elif isinstance(error, MissingFiles):  # goes on, to list all that is missing at once
                absent += error.files
                room[_raw_category(track)] -= room[_raw_category(track)] > 0
            else:
                raise
            continue
        if record is not None and room[record.category]:
            room[record.category] -= 1
            records.append(record)
    if absent:
        raise MissingFiles(absent, LAYOUT_SFM if scale != RAW else LAYOUT)
    if any(room.values()):
        raise ValueError(f"{folder}: {room['small']} small and {room['large']} large pairs are wanting of {each} each")
    return sorted(records, key=lambda record: (record.category != "small", record.clip))


def _in_seeded_order(folder: Path, split: str, seed: int) -> Iterator[Path]:
    tracks = sorted((folder / "cameras" / SPLITS[split][0]).glob("*.txt"))
    for k in rng_of(f"{NAME}/{split}", seed).permutation(len(tracks)):
        yield tracks[k]


def _raw_category(track: Path) -> str:
    cameras = read_track(track)
    return category_of(relative(cameras[FIRST], cameras[LAST]))


def _record(folder: Path, track: Path, scale: str, seed: int, room: dict[str, int]) -> Record | None:
    """The pair of a clip; None where it is too short, or where its category is known to be full."""
    clip, cameras = track.stem, read_track(track)
    if len(cameras) <= LAST:
        return None
    source, target = cameras[FIRST], cameras[LAST]
    T = relative(source, target)
    if scale == RAW and not room[category_of(T)]:
        return None
    images = [frame_file(folder, clip, camera) for camera in (source, target)]
    more = [depth_file(folder, clip, source), points_file(folder, clip)] if scale != RAW else []
    if absent := [file for file in (*images, *more) if not file.is_file()]:
        raise MissingFiles(absent, LAYOUT_SFM if more else LAYOUT)
    factor = _sfm_factor(folder, clip, source, seed) if scale != RAW else 1.0
    scaled = T.copy()
    scaled[:3, 3] *= factor
    (image0, size0), (image1, size1) = (_described(folder, file) for file in images)
    return Record(
        clip=track.stem,
        i=FIRST,
        j=LAST,
        image0=image0,
        image1=image1,
        size0=size0,
        size1=size1,
        K0=source.K(*size0),
        K1=target.K(*size1),
        T_1_0=T,
        scale=factor,
        scale_source=scale,
        category=category_of(scaled),
        seed=seed,
    )


def _described(folder: Path, file: Path) -> tuple[str, tuple[int, int]]:
    """Its path relative to the folder, width and height."""
    height, width = image(file).shape[:2]
    return file.relative_to(folder).as_posix(), (width, height)


def _sfm_factor(folder: Path, clip: str, source: Camera, seed: int) -> float:
    depth, sparse = depth_map(depth_file(folder, clip, source)), points_file(folder, clip)
    points = transform(source.T_camera_world, read_points(sparse))
    try:
        return depth_scale(depth, source.K(depth.shape[1], depth.shape[0]), points, rng_of(clip, seed))
    except ValueError as error:
        raise ValueError(f"{sparse}: {error}") from None
