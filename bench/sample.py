# SPDX-License-Identifier: Apache-2.0
"""Choose the pairs of RealEstate10K and write them to a list, once; `python -m bench.run` evaluates that list.

    python -m bench.sample FOLDER                                        # in the clips' own unit
    python -m bench.sample FOLDER --depth depth_anything_v2              # in that network's metres
    python -m bench.sample FOLDER --split validation --scale sfm-depth   # in the metres of depth maps that are there

The layout of the folder is in `bench/pairs/readers/realestate10k.py`. With --depth the network first makes the depth
maps of frame 0 that are missing, for every clip whose frame is there; a run that was stopped goes on. The metres so
found are that network's: they say nothing about how right it is.
"""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import cv2
import numpy as np
import typer
from rich.console import Console
from rich.progress import Progress

from bench.pairs.depths import DEPTHS, MONOCULAR, SENSOR
from bench.pairs.readers import realestate10k as re10k
from bench.pairs.readers.dataset_files import image
from bench.pairs.readers.pair_list import RAW
from bench.pairs.readers.sfm_scale import SOURCE
from garps_core import Config, GarpsError, View
from garps_core.align import NETWORKS as SHARED
from garps_core.mixtures.reconstruct import with_depth

NETWORKS = tuple(name for name in DEPTHS if name not in (SENSOR, MONOCULAR))
MAX_MM = 65535
MADE_BY = "made_by.txt"


def frames_without_depth(folder: Path, split: str, skipped: list[str] | None) -> list[tuple[str, re10k.Camera]]:
    """Clip and first camera of every track that is long enough and whose first frame is there and has no depth map.

    Raises:
        ValueError: a malformed track, unless there is a list to name it in.
    """
    found = []
    for track in sorted((folder / "cameras" / re10k.SPLITS[split][0]).glob("*.txt")):
        try:
            cameras = re10k.read_track(track)
        except ValueError:
            if skipped is None:
                raise
            continue  # `sample` names it
        there = len(cameras) > re10k.LAST and re10k.frame_file(folder, track.stem, cameras[re10k.FIRST]).is_file()
        if there and not re10k.depth_file(folder, track.stem, cameras[re10k.FIRST]).is_file():
            found.append((track.stem, cameras[re10k.FIRST]))
    return found


def claim_depth(folder: Path, network: str) -> None:
    """Note whose depth maps the folder holds. Raises ValueError where it holds others: metres must have one origin."""
    note = folder / "depth" / MADE_BY
    if note.is_file() and note.read_text().strip() == network:
        return
    if any((folder / "depth").glob("*/*.png")):
        whose = note.read_text().strip() if note.is_file() else "somebody else's"
        raise ValueError(
            f"{folder / 'depth'} holds depth maps ({whose}), not of {network}: remove them, or take them as they are "
            f"with --scale {SOURCE}"
        )
    note.parent.mkdir(parents=True, exist_ok=True)
    note.write_text(f"{network}\n")


def make_depth(folder: Path, clip: str, camera: re10k.Camera, network: str) -> None:
    """Write the depth map of a frame: 16 bit, mm. Raises WeightsError where the network's weights are not installed."""
    rgb = image(re10k.frame_file(folder, clip, camera))
    config = Config.preset(DEPTHS[network]).replace({"reconstruction.method": network})
    (view,) = with_depth([View(rgb, camera.K(*rgb.shape[1::-1]))], config, SHARED)
    assert view.depth is not None
    path = re10k.depth_file(folder, clip, camera)
    path.parent.mkdir(parents=True, exist_ok=True)
    millimetres = np.rint(1000 * np.nan_to_num(view.depth, nan=0.0, posinf=0.0))
    unfinished = path.with_name(f"{path.stem}.unfinished.png")
    cv2.imwrite(str(unfinished), np.where(millimetres <= MAX_MM, millimetres, 0).astype(np.uint16))
    unfinished.replace(path)


def main(
    folder: Annotated[Path, typer.Argument(help="of the data set")],
    split: Annotated[str, typer.Option(help=f"one of {', '.join(re10k.SPLITS)}")] = "test",
    scale: Annotated[str, typer.Option(help=f"{RAW}, or {SOURCE} from depth maps that are there")] = RAW,
    depth: Annotated[str, typer.Option(help=f"network that makes the depth maps: {', '.join(NETWORKS)}")] = "",
    seed: Annotated[int, typer.Option(help="of the order of clips, and of the scale's draws")] = 0,
    each: Annotated[int | None, typer.Option(help="pairs of each category; default: 100, validation 10")] = None,
    skip: Annotated[bool, typer.Option(help="leave out clips with missing or malformed files, and name them")] = False,
) -> None:
    """Choose pairs of RealEstate10K."""
    console = Console(soft_wrap=True)
    left_out: list[str] = []
    skipped = left_out if skip else None
    try:
        path = folder / re10k.list_file(split)
        if path.exists():
            raise ValueError(f"{path} exists: a list is written once; remove it to choose anew")
        if depth:
            if depth not in NETWORKS or scale not in (RAW, SOURCE):
                raise ValueError(f"--depth is {depth!r}, --scale {scale!r}: expected one of {', '.join(NETWORKS)}")
            scale = f"{SOURCE}:{depth}"
            claim_depth(folder, depth)
            with Progress(console=console) as bars:
                for clip, camera in bars.track(frames_without_depth(folder, split, skipped), description="depth"):
                    make_depth(folder, clip, camera, depth)
        records = re10k.sample(folder, split=split, scale=scale, seed=seed, each=each, skipped=skipped)
    except (OSError, ValueError, GarpsError) as error:
        console.print(str(error), markup=False)
        raise typer.Exit(2) from None
    for text in left_out:
        console.print(f"left out: {text}", markup=False)
    counts = {name: sum(record.category == name for record in records) for name in ("small", "large")}
    console.print(f"{path}: {counts['small']} small, {counts['large']} large, scale {scale}, seed {seed}")


if __name__ == "__main__":
    typer.run(main)
