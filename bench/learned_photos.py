# SPDX-License-Identifier: Apache-2.0
"""The demonstration network on real photographs, which it knows nothing of, beside their sensor's depth; and its time.

    python -m bench.learned_photos

Prints, and writes into --out: errors of its depth per data set, the error of GARPS' pose with either depth from the
same start, a picture of photograph, sensor's and network's depth, and the time of both views' depth over that of SIFT
detection in them.
"""

from __future__ import annotations

import statistics
import time
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Annotated, Any

import cv2
import numpy as np
import numpy.typing as npt
import torch
import typer
from rich.console import Console

from bench.pairs import learned_rooms
from bench.pairs.depths import DEMO_NET, config_of, with_depth_of
from bench.pairs.pair import Pair, spread
from bench.pairs.readers.pairs_json import DATA, available, load_pairs
from bench.pairs.starts import disturbed_prior
from bench.rows.depth_errors import depth_errors
from garps_core import Config, estimate_relative_pose, metrics
from garps_core.models.demo_net import DemoNet, depth_of_views, shipped
from garps_core.types import View

PICTURES = 4
RUNS = 21


def depth_rows(pairs: Sequence[Pair], network: DemoNet) -> list[str]:
    """Markdown rows, one per set: depth of the network against the sensor's."""
    found = []
    for name in dict.fromkeys(pair.set for pair in pairs):
        errors, sensor, ours = [], [], []
        for view in (view for pair in pairs if pair.set == name for view in (pair.source, pair.target)):
            (depth,) = depth_of_views(network, [view])
            errors.append(depth_errors(depth, _sensor(view)))
            sensor.append(float(np.nanmedian(_sensor(view))))
            ours.append(float(np.median(depth)))
        mean = np.mean(errors, axis=0)
        found.append(
            f"| {name} | {len(errors)} | {np.median(sensor):.2f} | {np.median(ours):.2f} | {mean[0]:.2f} "
            f"| {mean[1]:.2f} | {mean[3]:.2f} |"
        )
    return found


def _sensor(view: View) -> npt.NDArray[np.float32]:
    assert view.depth is not None
    return view.depth


def pose_rows(pairs: Sequence[Pair]) -> list[str]:
    """Markdown rows: median E_3D (m) from a disturbed start with either depth, and how often it says `converged`."""
    found = []
    for name in dict.fromkeys(pair.set for pair in pairs):
        own = [pair for pair in pairs if pair.set == name]
        starts = [disturbed_prior(pair) for pair in own]
        cells = [f"{_median_e3d(own, [s.T_target_source for s in starts]):.4f}"]
        learned = [with_depth_of(pair, DEMO_NET) for pair in own]
        for views, config in ((own, Config()), (learned, config_of(DEMO_NET))):
            results = [
                estimate_relative_pose(pair.source, pair.target, config, start)
                for pair, start in zip(views, starts, strict=True)
            ]
            error = _median_e3d(own, [result.T_target_source for result in results])
            cells.append(f"{error:.4f} ({sum(result.ok for result in results)}/{len(results)})")
        found.append(f"| {name} | {len(own)} | {' | '.join(cells)} |")
    return found


def _median_e3d(pairs: Sequence[Pair], poses: Sequence[Any]) -> float:
    errors = [
        np.inf if T is None else metrics.error_3d_m(T, pair.T_target_source, pair.points)
        for pair, T in zip(pairs, poses, strict=True)
    ]
    return float(np.median(errors))


def picture(pairs: Sequence[Pair], network: DemoNet) -> npt.NDArray[np.uint8]:
    """A row per pair: photograph, true or sensor's depth, the network's, on one scale of colours; BGR."""
    rows = []
    for pair in spread(list(pairs), PICTURES):
        (ours,) = depth_of_views(network, [pair.source])
        top = float(np.nanquantile(_sensor(pair.source), 0.98)) * 1.2
        panels = [pair.source.rgb[..., ::-1], *(coloured(depth, top) for depth in (_sensor(pair.source), ours))]
        rows.append(np.hstack([cv2.resize(panel, (320, 240), interpolation=cv2.INTER_AREA) for panel in panels]))
    return np.vstack(rows)


def coloured(depth: npt.NDArray[np.float32], top_m: float) -> npt.NDArray[np.uint8]:
    """Depth as colours, near = blue, `top_m` and beyond = red, none = black; BGR."""
    level = np.clip(np.nan_to_num(depth / top_m, nan=0.0), 0, 1)
    drawn = cv2.applyColorMap((255 * level).astype(np.uint8), cv2.COLORMAP_TURBO)
    return np.asarray(np.where(np.isfinite(depth)[..., None], drawn, 0), np.uint8)


def time_line(views: Sequence[View], network: DemoNet) -> str:
    """Median time of the network on both views over that of SIFT detection in them, taking turns."""
    greys = [cv2.cvtColor(view.rgb, cv2.COLOR_RGB2GRAY) for view in views]
    count = Config().start.max_features

    def detect(grey: npt.NDArray[np.uint8]) -> Any:
        return cv2.SIFT.create(nfeatures=count).detect(grey, None)

    with ThreadPoolExecutor(2) as pool:  # as GARPS does it
        turns = range(RUNS + 3)
        both = [
            (_seconds(lambda: depth_of_views(network, views)), _seconds(lambda: list(pool.map(detect, greys))))
            for _ in turns
        ]
    spent = both[3:]
    network_s, sift_s = (statistics.median(one) for one in zip(*spent, strict=True))
    size = "x".join(map(str, views[0].rgb.shape[1::-1]))
    return (
        f"Depth of two {size} images {1000 * network_s:.1f} ms, SIFT detection in them {1000 * sift_s:.1f} ms, "
        f"ratio {network_s / sift_s:.2f} (medians of {RUNS} runs in turns, {torch.get_num_threads()} threads)"
    )


def _seconds(what: Callable[[], Any]) -> float:
    begin = time.perf_counter()
    what()
    return time.perf_counter() - begin


def main(
    data: Annotated[Path, typer.Option(help="folder that holds dev/<set>/pairs.json")] = DATA,
    limit: Annotated[int | None, typer.Option(help="largest number of pairs of a set")] = None,
    rooms: Annotated[Path, typer.Option(help="folder of the generated pairs, for the time")] = learned_rooms.FOLDER,
    out: Annotated[Path, typer.Option(help="folder of table and pictures")] = Path("out/learned_photos"),
) -> None:
    """Errors on real photographs, and time."""
    console, network = Console(soft_wrap=True), shipped()
    out.mkdir(parents=True, exist_ok=True)
    generated = spread(learned_rooms.load("tune", rooms, console), PICTURES)
    cv2.imwrite(str(out / "rooms.png"), picture(generated, network))
    lines = [time_line([generated[0].source, generated[0].target], network), ""]
    pairs = [pair for name in available(data) for pair in load_pairs(name, data, limit)]
    if pairs:
        cv2.imwrite(str(out / "photos.png"), picture(pairs, network))
        lines += [
            "| set | images | sensor, median m | network, median m | AbsRel | delta < 1.25 | AbsRel, scale put right |"
        ]
        lines += ["|---" * 7 + "|", *depth_rows(pairs, network), ""]
        lines += ["| set | pairs | start, median E_3D m | sensor's depth (converged) | demo_net (converged) |"]
        lines += ["|---" * 5 + "|", *pose_rows(pairs), ""]
    else:
        lines.append(f"no photographs with sensor depth under {data / 'dev'}")
    console.print("\n".join(lines))
    (out / "table.md").write_text("\n".join(lines) + "\n", encoding="utf-8")


if __name__ == "__main__":
    typer.run(main)
