# SPDX-License-Identifier: Apache-2.0
"""The demo's part without depth: two plain images of a generated room, depth by the network in the package."""

from __future__ import annotations

import json
from contextlib import redirect_stdout
from io import StringIO
from pathlib import Path

import cv2
import numpy as np
from rich.console import Console

from bench.demo.picture import with_inputs
from bench.pairs.pair import scene_points
from bench.rooms import RoomPair, make_pair
from bench.rows.depth_errors import depth_errors
from garps_core import View, metrics
from garps_core.checks import Float64Array
from garps_core.cli.command import main as garps
from garps_core.models.demo_net import WHAT_IT_IS, depth_of_views, shipped

ROOM_SEED, ROOM_LEVEL = 12, 3
LIMIT = 0.15
"""Largest scene-point error, over the median distance of the scene, with which the demo succeeds."""


def rgb_part(out: Path, console: Console) -> bool:
    """Write the images, run the command on them, compare with the truth; whether the pose is usable and near it."""
    console.rule("Two plain images, no depth: the network in the package")
    console.print(f"demo_net is {WHAT_IT_IS}.", style="yellow", soft_wrap=True)
    pair = make_pair(ROOM_SEED, ROOM_LEVEL)
    words = written(pair, out)
    figure = out / "rgb_before_after.png"
    shown = " ".join(f'"{word}"' if " " in word else word for word in words)
    console.print(f"$ garps {shown} --figure {figure}", soft_wrap=True)
    answer = StringIO()
    with redirect_stdout(answer):
        code = garps([*words, "--json", "--figure", str(figure)])
    found = json.loads(answer.getvalue())
    console.print(depth_line(pair))
    if found["T_target_source"] is None:
        console.print(f"{found['status']}: {found['reason']}", soft_wrap=True)
        return False
    with_inputs(pair.rgb0, pair.rgb1, figure)
    console.print(f"picture: {figure}")
    return report(pair, found, console) and code == 0


def written(pair: RoomPair, out: Path) -> list[str]:
    """The pair's images in files, and the words of the command for them."""
    paths = [out / f"rgb_{name}.png" for name in ("a", "b")]
    for path, rgb in zip(paths, (pair.rgb0, pair.rgb1), strict=True):
        cv2.imwrite(str(path), cv2.cvtColor(rgb, cv2.COLOR_RGB2BGR))
    words = ["align", *map(str, paths), "--preset", "demo_net"]
    for option, K in (("--K", pair.K0), ("--K-target", pair.K1)):
        words += [option, *(f"{K[i, j]:.2f}" for i, j in ((0, 0), (1, 1), (0, 2), (1, 2)))]
    return words


def depth_line(pair: RoomPair) -> str:
    """Errors of the depth of both views."""
    views = View(pair.rgb0, pair.K0), View(pair.rgb1, pair.K1)
    found = zip(depth_of_views(shipped(), views), (pair.true_depth0, pair.true_depth1), strict=True)
    errors = [100 * depth_errors(ours, true).abs_rel for ours, true in found]
    return f"depth by the network: off by {errors[0]:.0f} and {errors[1]:.0f} % in the mean over the pixels"


def report(pair: RoomPair, found: dict[str, object], console: Console) -> bool:
    """Print the errors; whether that of the scene's points is below the limit."""
    T: Float64Array = np.array(found["T_target_source"])
    sigma = float(np.sqrt(np.trace(np.array(found["covariance"])[:3, :3])))
    scene = scene_points(View(pair.rgb0, pair.K0, pair.true_depth0))
    off = metrics.error_3d_m(T, pair.T_1_0, scene)
    length = float(np.linalg.norm(pair.T_1_0[:3, 3]))
    console.print(
        f"{found['status']}: motion of {length:.2f} m and {metrics.rotation_error_deg(np.eye(4), pair.T_1_0):.0f} deg, "
        f"[bold]error {1000 * metrics.translation_error_m(T, pair.T_1_0):.0f} mm and "
        f"{metrics.rotation_error_deg(T, pair.T_1_0):.2f} deg[/bold], sigma {1000 * sigma:.0f} mm; scene points off by "
        f"{1000 * off:.0f} mm",
        soft_wrap=True,
    )
    return off < LIMIT * float(np.median(scene[:, 2]))
