# SPDX-License-Identifier: Apache-2.0
"""`python -m bench.demo`: GARPS on twelve recorded stereo pairs, offline and live, and in generated rooms.

1. Stereo: depth for both cameras by a stereo matcher, written to a rosbag2 as a robot would record it, replayed by
   `garps-replay`. The truth is the calibrated rig: baseline 75 mm, no rotation. (The depth was made with the same
   baseline: what is tested is the alignment, not the depth. The rectification is good to about 0.2 px, 0.03 deg.)
2. Room: two views 0.6 m and 20 degrees apart with a depth sensor's noise; the truth is exact. Once from the images
   alone, once from a rough pose (0.12 m and 3 degrees off) as odometry would give it; that one is the picture.
3. Two plain images of a generated room, without depth: that comes from the network in the package (`bench.demo.rgb`).
4. Live: `pose_node` in a process of its own, the stereo pairs played into it over ROS 2, its poses as they come.
   Left out where rclpy is not installed.
"""

from __future__ import annotations

import csv
import shutil
import sys
import time
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import numpy as np
import numpy.typing as npt
import typer
from rich.box import SIMPLE
from rich.console import Console
from rich.progress import track
from rich.table import Table
from scipy.spatial.transform import Rotation

from bench.demo.bag import stamp_ns_of, write_bag
from bench.demo.picture import with_inputs
from bench.demo.rgb import rgb_part
from bench.pairs.stereo import StereoPair, depth_of_both, load_pairs
from bench.rooms import RoomPair, make_pair
from garps_core import Config, PoseEstimate, Prior, View, estimate_relative_pose, metrics, reconstruct
from garps_core.cli.figure import before_after
from garps_ros.replay import main as replay

if TYPE_CHECKING:
    from bench.demo.live import LivePose

LIMIT_MM = 5.0
"""Median error of the estimated baseline above which the demo fails."""
PICTURE = "bedroom_chair"
ROOM_SEED, ROOM_LEVEL = 3, 4
ROUGH_M, ROUGH_DEG = 0.12, 3.0
"""Error of the room's rough start."""

Array = npt.NDArray[np.float64]
console = Console()


@dataclass(frozen=True, eq=False)
class Estimate:
    """A row of the replay's poses.csv: T is 4x4 or None, covariance 6x6 (m^2, rad^2) or None."""

    status: str
    T: Array | None
    covariance: Array | None


def main(
    out: Annotated[Path, typer.Option(help="Folder for the bag, poses.csv and the pictures.")] = Path("out/demo"),
    scenes: Annotated[int, typer.Option(help="Number of stereo pairs, from the first on.", min=1)] = 12,
) -> int:
    """Run all parts; exit code 0 when the median baseline error is below the limit, offline and live."""
    begin = time.perf_counter()
    try:
        load_pairs()
    except FileNotFoundError as error:
        console.print(f"demo: error: {error}", style="red", soft_wrap=True)
        return 2
    out.mkdir(parents=True, exist_ok=True)
    good = stereo_part(out, scenes)
    room_part(out)
    good &= rgb_part(out, console)
    good &= live_part(out, scenes)
    console.print(f"\nEverything is in [bold]{out}[/bold]; {time.perf_counter() - begin:.0f} s.")
    return 0 if good else 1


def stereo_part(out: Path, scenes: int) -> bool:
    """Bag, replay, table, picture."""
    console.rule("Recorded stereo pairs: does the estimate find the calibrated baseline?")
    pairs = load_pairs()[:scenes]
    depths = [depth_of_both(pair) for pair in track(pairs, "stereo depth of both cameras", console=console)]
    for folder in ("bag", "replay"):
        shutil.rmtree(out / folder, ignore_errors=True)
    write_bag(out / "bag", [(pair, *depth) for pair, depth in zip(pairs, depths, strict=True)])
    command = [str(out / "bag"), "--out", str(out / "replay")]
    command += ["--source-image", "/left/image_rect", "--target-image", "/right/image_rect"]
    console.print(f"$ garps-replay {' '.join(command)}", soft_wrap=True)
    if replay(command) not in (0, 1):
        return False
    estimates = read_poses(out / "replay" / "poses.csv")
    rows = [estimates.get(stamp_ns_of(i)) for i in range(len(pairs))]
    draw_stereo(pairs, depths, rows, out / "stereo_before_after.png")
    return report_stereo(pairs, rows)


def read_poses(path: Path) -> dict[int, Estimate]:
    """Source stamp -> estimate."""
    found = {}
    with path.open(newline="", encoding="utf-8") as file:
        for row in csv.DictReader(file):
            T = covariance = None
            if row["tx"]:
                T = np.eye(4)
                T[:3, 3] = [float(row[name]) for name in ("tx", "ty", "tz")]
                T[:3, :3] = Rotation.from_quat([float(row[name]) for name in ("qx", "qy", "qz", "qw")]).as_matrix()
            if row["c00"]:
                covariance = np.array([[float(row[f"c{min(i, j)}{max(i, j)}"]) for i in range(6)] for j in range(6)])
            found[int(row["source_stamp_ns"])] = Estimate(row["status"], T, covariance)
    return found


def errors(T: Array, truth: Array) -> tuple[float, float]:
    """Millimetres and degrees."""
    return 1000 * metrics.translation_error_m(T, truth), metrics.rotation_error_deg(T, truth)


def report_stereo(pairs: list[StereoPair], rows: list[Estimate | None]) -> bool:
    """Print the table and its medians; whether the median error of the baseline's length is below the limit."""
    table = Table(title="Left camera in the right one; truth: -75 0 0 mm, 0 deg", box=SIMPLE, padding=(0, 1, 0, 0))
    for heading in ("scene", "status", "x y z\nmm", "sigma\nmm", "error\nmm", "error\ndeg", "baseline\noff by mm"):
        table.add_column(heading, no_wrap=True, justify="left" if heading in ("scene", "status") else "right")
    misses = []
    for pair, row in zip(pairs, rows, strict=True):
        if row is None or row.T is None or row.covariance is None:
            table.add_row(pair.name, row.status if row else "not estimated", *["-"] * 5)
            misses.append((np.inf,) * 4)
            continue
        miss = 1000 * abs(float(np.linalg.norm(row.T[:3, 3])) - pair.baseline_m)
        millimetres, degrees = errors(row.T, pair.T_right_left)
        misses.append((miss, millimetres, degrees, metrics.nees(row.T, row.covariance, pair.T_right_left)))
        where = " ".join(f"{1000 * x:+.1f}" for x in row.T[:3, 3])
        numbers = f"{sigma_mm(row.covariance):.1f}", f"{millimetres:.1f}", f"{degrees:.2f}", f"{miss:.1f}"
        table.add_row(pair.name, row.status, where, *numbers)
    console.print(table)
    used = sum(row is not None and row.status == "converged" for row in rows)
    within = sum(values[3] < metrics.CHI2_6_95 for values in misses)
    baseline, position, turn, _ = (float(value) for value in np.median(misses, axis=0))
    verdict = "[green]good[/green]" if baseline < LIMIT_MM else "[red]too much[/red]"
    console.print(
        f"{used} of {len(rows)} converged and are used. Median position error {position:.1f} mm, "
        f"rotation {turn:.2f} deg; {within} of {len(rows)} within the 95 % bound of their own covariance.",
        soft_wrap=True,
    )
    console.print(f"Median baseline error [bold]{baseline:.1f} mm[/bold] (expected below {LIMIT_MM:g}): {verdict}")
    console.print("Images: N. Burrus, CC BY 4.0, from the package stereodemo.", style="dim")
    return baseline < LIMIT_MM


def sigma_mm(covariance: Array) -> float:
    """Square root of the summed variances of x, y and z, millimetres: how long a typical position error is."""
    return 1000 * float(np.sqrt(np.trace(covariance[:3, :3])))


def draw_stereo(
    pairs: list[StereoPair],
    depths: list[tuple[npt.NDArray[np.float32], npt.NDArray[np.float32]]],
    rows: list[Estimate | None],
    path: Path,
) -> None:
    """The picture of one scene: both mixtures at one place (no motion), and at the estimate."""
    index = next((i for i, pair in enumerate(pairs) if pair.name == PICTURE), 0)
    pair, row, (left, right) = pairs[index], rows[index], depths[index]
    if row is None or row.T is None:
        return
    source, target = (reconstruct(View(rgb, pair.K, d)) for rgb, d in ((pair.left, left), (pair.right, right)))
    title = f"Stereo pair '{pair.name}': as if the cameras were at one place, and at the estimate"
    before_after(source, target, np.eye(4), row.T, path, title)
    with_inputs(pair.left, pair.right, path)
    console.print(f"picture: {path}")


def room_part(out: Path) -> None:
    """Two views of a generated room: error against exact truth from two kinds of start, and the picture."""
    console.rule("Generated room: a larger motion, exact truth")
    with console.status("rendering and aligning"):
        pair = make_pair(ROOM_SEED, ROOM_LEVEL, depth_noise="sensor")
        views = View(pair.rgb0, pair.K0, pair.depth0), View(pair.rgb1, pair.K1, pair.depth1)
        alone = estimate_relative_pose(*views)
        by_shape = Config().replace({"start.features": False})  # the picture is of the alignment
        rough = estimate_relative_pose(*views, by_shape, prior=rough_start(pair))
    length, turn = errors(np.eye(4), pair.T_1_0)
    console.print(f"motion {length / 1000:.2f} m and {turn:.0f} deg, overlap {100 * pair.overlap:.0f} %")
    describe("from the images alone", alone, pair.T_1_0)
    describe("from a rough pose, without features", rough, pair.T_1_0)
    if rough.T_target_source is None or rough.initial is None:
        return
    start, end = rough.initial.T_target_source, rough.T_target_source
    before, after = errors(start, pair.T_1_0), errors(end, pair.T_1_0)
    path = out / "room_before_after.png"
    title = (
        f"Generated room. Start: {before[0]:.0f} mm and {before[1]:.1f}\u00b0 off.  "
        f"Aligned: {after[0]:.1f} mm and {after[1]:.2f}\u00b0 off."
    )
    before_after(reconstruct(views[0]), reconstruct(views[1]), start, end, path, title)
    with_inputs(pair.rgb0, pair.rgb1, path)
    console.print(f"picture: {path}")


def rough_start(pair: RoomPair) -> Prior:
    """The truth, moved and turned by `ROUGH_M` and `ROUGH_DEG` in directions of no significance, with such sigmas."""
    move, axis = np.array([2.0, -1.0, 2.0]) / 3, np.array([1.0, 2.0, -2.0]) / 3
    T = pair.T_1_0.copy()
    T[:3, :3] = Rotation.from_rotvec(np.radians(ROUGH_DEG) * axis).as_matrix() @ T[:3, :3]
    T[:3, 3] += ROUGH_M * move
    sigmas = np.repeat([ROUGH_M, np.radians(ROUGH_DEG)], 3)
    return Prior(T, np.diag(sigmas**2), "given", "rough pose")


def describe(name: str, estimate: PoseEstimate, truth: Array) -> None:
    """One line: where it started, where it ended, how sure it is."""
    if estimate.T_target_source is None or estimate.covariance is None or estimate.initial is None:
        console.print(f"{name}: {estimate.status.value}, {estimate.reason}")
        return
    before, after = errors(estimate.initial.T_target_source, truth), errors(estimate.T_target_source, truth)
    console.print(
        f"{name} ({estimate.initial.origin}): start off by {before[0]:.1f} mm, {before[1]:.2f} deg; "
        f"{estimate.status.value}, [bold]error {after[0]:.1f} mm, {after[1]:.3f} deg[/bold], "
        f"sigma {sigma_mm(estimate.covariance):.1f} mm",
        soft_wrap=True,
    )


def live_part(out: Path, scenes: int) -> bool:
    """The stereo pairs played into the node; whether its poses are good, and true where there is no rclpy."""
    console.rule("Live: the same pairs over ROS 2, into pose_node")
    try:
        from bench.demo.live import run_live
        from bench.live.graph import LiveError
    except ImportError as error:
        console.print(f"skipped: {error} (ROS 2 is not installed; its wheels are for x86_64 only)", soft_wrap=True)
        return True
    console.print(
        f"$ python -m garps_ros.pose_node --ros-args ...; garps-replay {out / 'bag'} --to-ros", soft_wrap=True
    )
    try:
        with console.status("the node starts, then gets a pair per second"):
            poses, code = run_live(out / "bag", out / "live.log")
    except LiveError as error:
        console.print(f"demo: error: {error}", style="red", soft_wrap=True)
        return False
    return report_live(load_pairs()[:scenes], poses) and report_end(code)


def report_live(pairs: list[StereoPair], poses: dict[int, LivePose]) -> bool:
    """Print the poses and their medians; whether there are any and the median baseline error is below the limit."""
    table = Table(title="What came on /pose_node/pose; truth: -75 0 0 mm, 0 deg", box=SIMPLE, padding=(0, 1, 0, 0))
    for heading in ("scene", "x y z\nmm", "error\nmm", "error\ndeg", "baseline\noff by mm", "latency\nms"):
        table.add_column(heading, no_wrap=True, justify="left" if heading == "scene" else "right")
    found = []
    for index, pair in enumerate(pairs):
        pose = poses.get(stamp_ns_of(index))
        if pose is None:
            table.add_row(pair.name, *["-"] * 5)
            continue
        millimetres, degrees = errors(pose.T, pair.T_right_left)
        miss = 1000 * abs(float(np.linalg.norm(pose.T[:3, 3])) - pair.baseline_m)
        found.append((miss, 1000 * pose.latency_s))
        where = " ".join(f"{1000 * x:+.1f}" for x in pose.T[:3, 3])
        numbers = f"{millimetres:.1f}", f"{degrees:.2f}", f"{miss:.1f}", f"{found[-1][1]:.0f}"
        table.add_row(pair.name, where, *numbers)
    console.print(table)
    if not found:
        console.print("[red]no pose came[/red]; see live.log")
        return False
    baseline, latency = (float(value) for value in np.nanmedian(found, axis=0))
    verdict = "[green]good[/green]" if baseline < LIMIT_MM else "[red]too much[/red]"
    if len(found) < len(pairs):
        console.print("No pose: rejected, or the machine was busy with an older pair.")
    console.print(
        f"{len(found)} of {len(pairs)} pairs, median latency {latency:.0f} ms from the first message of a pair, "
        f"median baseline error [bold]{baseline:.1f} mm[/bold] (expected below {LIMIT_MM:g}): {verdict}",
        soft_wrap=True,
    )
    return baseline < LIMIT_MM


def report_end(code: int) -> bool:
    """Say how the node ended."""
    console.print(f"pose_node ended on SIGINT with exit code {code}")
    return code == 0


if __name__ == "__main__":
    app = typer.Typer(add_completion=False, rich_markup_mode=None)
    app.command()(main)
    sys.exit(app(standalone_mode=False))
