# SPDX-License-Identifier: Apache-2.0
"""Write one pair as pictures: python -m bench.rooms --seed 3 --level 3 --out DIR."""

from __future__ import annotations

import argparse
from pathlib import Path

import cv2
import numpy as np
import numpy.typing as npt

from bench.rooms.mesh import LABELS
from bench.rooms.room_pair import DEPTH_NOISES, LEVELS, RoomPair, make_pair


def depth_picture(depth: npt.NDArray[np.float32], far_m: float) -> npt.NDArray[np.uint8]:
    """HxW m to HxWx3 BGR, near = warm, NaN = black."""
    scaled = np.nan_to_num(255 * (1 - depth / far_m), nan=0).clip(0, 255).astype(np.uint8)
    picture = np.array(cv2.applyColorMap(scaled, cv2.COLORMAP_TURBO))
    picture[~np.isfinite(depth)] = 0
    return picture


def label_picture(labels: npt.NDArray[np.int32]) -> npt.NDArray[np.uint8]:
    """HxW classes to HxWx3 BGR."""
    hue = (np.arange(len(LABELS)) * 67 % 180).astype(np.uint8)
    hsv = np.stack([hue, np.full_like(hue, 150), np.full_like(hue, 220)], axis=-1)[None]
    return np.asarray(cv2.cvtColor(hsv, cv2.COLOR_HSV2BGR)[0][labels], np.uint8)


def save(pair: RoomPair, folder: Path, stem: str) -> Path:
    """One PNG: rows are the views, columns are colour, depth and labels. Returns its path."""
    far = float(np.nanmax([np.nanmax(pair.true_depth0), np.nanmax(pair.true_depth1)]))
    rows = []
    for rgb, depth, labels in ((pair.rgb0, pair.depth0, pair.labels0), (pair.rgb1, pair.depth1, pair.labels1)):
        rows.append(np.hstack([rgb[..., ::-1], depth_picture(depth, far), label_picture(labels)]))
    folder.mkdir(parents=True, exist_ok=True)
    path = folder / f"{stem}.png"
    cv2.imwrite(str(path), np.vstack(rows))
    return path


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(prog="python -m bench.rooms", description=__doc__)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--level", type=int, default=3, choices=sorted(LEVELS))
    parser.add_argument("--texture", type=float, default=1.0, help="1 = rich, 0 = almost plain")
    parser.add_argument("--size", type=int, nargs=2, default=(640, 480), metavar=("WIDTH", "HEIGHT"))
    parser.add_argument("--depth-noise", choices=DEPTH_NOISES, default="none")
    parser.add_argument("--out", type=Path, required=True)
    args = parser.parse_args()
    pair = make_pair(args.seed, args.level, args.texture, args.size[0], args.size[1], args.depth_noise)
    path = save(pair, args.out, f"room{args.seed}_level{args.level}_texture{args.texture:g}")
    print(f"{path}  overlap {pair.overlap:.2f}")


if __name__ == "__main__":
    main()
