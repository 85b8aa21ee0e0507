# SPDX-License-Identifier: Apache-2.0
"""`bench.run` called as from the shell."""

from __future__ import annotations

import json
from pathlib import Path

import cv2
import numpy as np
import typer
from typer.testing import CliRunner

from bench import run
from bench.rooms import make_pair


def called(*words: str) -> tuple[int, str]:
    app = typer.Typer()
    app.command()(run.main)
    found = CliRunner().invoke(app, [str(word) for word in words])
    assert found.exception is None or isinstance(found.exception, SystemExit), found.exception
    return found.exit_code, found.output


def write_rooms(place: Path) -> Path:
    """Two pairs with depth in the pairs.json layout."""
    place.mkdir()
    records = []
    for seed, level in ((7, 1), (8, 2)):
        made = make_pair(seed, level, width=320, height=240, depth_noise="sensor")
        record = {"id": f"room{seed}", "category": "small", "T_1_0": made.T_1_0.tolist()}
        for k, (rgb, depth, K) in enumerate([(made.rgb0, made.depth0, made.K0), (made.rgb1, made.depth1, made.K1)]):
            record |= {f"image{k}": f"{seed}_{k}.png", f"depth{k}": f"{seed}_{k}_d.png", f"K{k}": K.tolist()}
            cv2.imwrite(str(place / f"{seed}_{k}.png"), rgb[..., ::-1])
            cv2.imwrite(str(place / f"{seed}_{k}_d.png"), np.nan_to_num(1000 * depth).astype(np.uint16))
        records.append(record)
    (place / "pairs.json").write_text(json.dumps({"pairs": records}))
    return place
