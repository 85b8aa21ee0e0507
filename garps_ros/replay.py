# SPDX-License-Identifier: Apache-2.0
"""Command `garps-replay`: relative poses from a recording, without ROS; or the recording into a live ROS 2 graph.

Exit code 0 = at least one pose, 1 = none, 2 = wrong input, 130 = interrupted (what was written is valid).
"""

from __future__ import annotations

import math
import sys
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import Annotated

import typer
from rich.console import Console
from rich.progress import Progress

from garps_core.align import Estimator
from garps_core.config import PRESETS, Config, methods
from garps_core.config.text import configured
from garps_core.errors import GarpsError
from garps_core.models.depth_networks import preset_for
from garps_core.models.in_use import Networks
from garps_ros.estimates.keyframes import KeyframeRule, KeyframeTracker
from garps_ros.estimates.outcomes import Completed, Origin, Outcome, ViewReader, estimate_keyframes, estimate_pairs
from garps_ros.estimates.preparation import (
    check_method,
    completed,
    depth_share,
    load_networks,
    needs_depth,
    settings_of_completed,
)
from garps_ros.frames.frame import CameraTopics
from garps_ros.parameters.settings import RECTIFIED, NodeSettings, current_rectified
from garps_ros.recording.bags import Bag, BagError
from garps_ros.recording.frame_reader import Frames
from garps_ros.recording.outputs import Outputs
from garps_ros.recording.session import record, stop_on_signals
from garps_ros.recording.summary import Summary
from garps_ros.recording.topics import choose_cameras
from msg_adapters import NANOSECONDS

NAME = "garps-replay"
INTERRUPTED = 130
ONE_OF_PAIRING = ("auto", "cameras", "keyframe")
GIVEN = "COMMANDLINE"
LIVE_OPTIONS = {"rate", "loop", "topics", "wait"}
"""Options that need --to-ros."""

# typer 0.29 carries its own copy of click, older ones use the real one: BadParameter, UsageError, ClickException.
ClickException: type[Exception] = typer.BadParameter.__mro__[2]

app = typer.Typer(add_completion=False, rich_markup_mode=None, pretty_exceptions_enable=False, no_args_is_help=True)


def main(arguments: list[str] | None = None) -> int:
    """Run the command line; return the exit code. A user's mistake is one line on stderr and code 2."""
    try:
        code = app(args=arguments, prog_name=NAME, standalone_mode=False)
        return code if isinstance(code, int) else 0
    except (BagError, GarpsError) as error:
        message = str(error)
    except ClickException as error:
        message = error.format_message()  # type: ignore[attr-defined]
        if not message:  # no arguments: the help has been printed
            return 2
    except OSError as error:  # a full disk, a folder that went away; the results so far have been closed
        message = f"cannot go on: {error}"
    except (typer.Abort, KeyboardInterrupt):
        return INTERRUPTED
    print(f"{NAME}: error: {' '.join(message.split())}", file=sys.stderr)
    return 2


HELP = """Metric relative poses from a recording, offline and without ROS.

Two cameras: the pose of the source camera in the target camera's frame, for every pair of images taken together.
One camera: its path in the frame of its first image. Topics that are not given are guessed and printed.
Every camera needs depth registered to its image; or --reconstruction names a network that does without (see
`garps weights`).

\b
Writes into --out:
  trajectory.tum  stamp, position, quaternion of the poses that can be used; frames in its first line
  poses.csv       every pair, also rejected ones, with status, reason, overlap, quality, pose, covariance
  poses/          rosbag2 (MCAP) with /garps/pose and /garps/odometry
\b
With --to-ros nothing is estimated or written: the recording is played into a live ROS 2 graph, with /clock for nodes
whose use_sim_time is true. That needs rclpy, but not rosbag2; ROS 1 recordings are played too.
\b
Examples:
  garps-replay walk/ --out walk_poses
  garps-replay rig.mcap --source-image /right/image_raw --target-image /left/image_raw
  garps-replay old.bag --pairing keyframe --set lifting.stride=4 --limit 20
  garps-replay rgb.mcap --reconstruction depth_anything_v2
  garps-replay walk/ --to-ros --rate 0.5 --loop
  garps-replay rig.mcap --to-ros --topics /left/image_raw --topics /left/camera_info --wait 0
\b
Exit code: 0 = at least one pose, 1 = no pose, 2 = wrong input, 130 = interrupted (what was written is valid).
With --to-ros: 0 = played to the end, 1 = no message could be sent, 2 = wrong input, 130 = interrupted.
"""

Rectified = Annotated[str, typer.Option(help="Kind of the images: rectified, raw, or auto (by topic name).")]
KeyframeOverlap = Annotated[float, typer.Option(help="New keyframe when the overlap is below.", min=0, max=1)]
KeyframeMotion = Annotated[float, typer.Option(help="New keyframe beyond this distance, metres.", min=0)]
KeyframeRotation = Annotated[float, typer.Option(help="New keyframe beyond this rotation, degrees.", min=0)]
LostAfter = Annotated[
    int, typer.Option(help="New trajectory after this number of frames in a row without a pose.", min=1, max=1000)
]
Preset = Annotated[str | None, typer.Option(help=f"One of {', '.join(PRESETS)}. [default; with a network monocular]")]
Reconstruction = Annotated[
    str | None, typer.Option(help=f"Whose depth, one of {', '.join(methods()[:-1])}. [auto: the depth topics]")
]
ToRos = Annotated[bool, typer.Option("--to-ros", help="Play the recording into a live ROS 2 graph instead.")]
Rate = Annotated[float, typer.Option(help="With --to-ros: seconds of the recording per second.", min=0.001, max=1000)]
Loop = Annotated[bool, typer.Option("--loop", help="With --to-ros: again from the start until stopped.")]
Topics = Annotated[
    list[str] | None,
    typer.Option("--topics", metavar="TOPIC", help="With --to-ros: play this one; repeat at will.  [default: all]"),
]
Wait = Annotated[
    float, typer.Option(help="With --to-ros: longest wait for a subscriber of an image, seconds; 0 = none.", min=0)
]


@app.command(help=HELP)
def replay(
    context: typer.Context,
    bag: Annotated[Path, typer.Argument(help="rosbag2 folder, .mcap, .db3 or ROS 1 .bag file.", metavar="BAG")],
    out: Annotated[Path, typer.Option(help="Folder for the results; must be new or empty.")] = Path("garps_replay"),
    overwrite: Annotated[bool, typer.Option("--overwrite", help="Replace the results of an earlier replay.")] = False,
    source_image: Annotated[str, typer.Option(help="Image topic of the source camera.", metavar="TOPIC")] = "",
    source_info: Annotated[str, typer.Option(help="Its CameraInfo.", metavar="TOPIC")] = "",
    source_depth: Annotated[str, typer.Option(help="Its depth, registered to the image.", metavar="TOPIC")] = "",
    target_image: Annotated[str, typer.Option(help="Image topic of the target camera.", metavar="TOPIC")] = "",
    target_info: Annotated[str, typer.Option(help="Its CameraInfo.", metavar="TOPIC")] = "",
    target_depth: Annotated[str, typer.Option(help="Its depth.", metavar="TOPIC")] = "",
    pairing: Annotated[
        str, typer.Option(help="cameras: two at the same time; keyframe: one over time; auto.")
    ] = "auto",
    slop: Annotated[
        float, typer.Option(help="Largest difference of stamps that belong together, seconds.", min=0, max=10)
    ] = NodeSettings.sync_slop,
    rectified: Rectified = NodeSettings.rectified,
    keyframe_overlap: KeyframeOverlap = NodeSettings.keyframe_overlap,
    keyframe_motion: KeyframeMotion = NodeSettings.keyframe_motion,
    keyframe_rotation: KeyframeRotation = NodeSettings.keyframe_rotation,
    keyframe_lost_after: LostAfter = NodeSettings.keyframe_lost_after,
    limit: Annotated[int | None, typer.Option(help="Stop after this many pairs.", min=1)] = None,
    preset: Preset = None,
    reconstruction: Reconstruction = None,
    set_: Annotated[
        list[str] | None,
        typer.Option("--set", help="Change a setting; may be repeated.", metavar="NAME=VALUE"),
    ] = None,
    settings: Annotated[
        Path | None, typer.Option(help="YAML file of settings; --preset and --set stand above it.", metavar="FILE")
    ] = None,
    to_ros: ToRos = False,
    rate: Rate = 1.0,
    loop: Loop = False,
    topics: Topics = None,
    wait: Wait = 10.0,
) -> int:
    """Replay; see HELP."""
    _check_given(context, to_ros)
    if to_ros:
        return _play(bag, rate, loop, topics or [], wait)
    _check_choice("--pairing", pairing, ONE_OF_PAIRING)
    rectified = current_rectified(rectified)
    _check_choice("--rectified", rectified, RECTIFIED)
    config = _configured(preset, reconstruction, settings, set_ or [])
    rule = KeyframeRule(
        keyframe_overlap, keyframe_motion, math.radians(keyframe_rotation), keyframe_lost_after, depth_share(config)
    )
    source = CameraTopics(source_image, source_info, source_depth)
    target = CameraTopics(target_image, target_info, target_depth)
    with Bag(bag) as recording:
        cameras = choose_cameras(recording, source, target, pairing, needs_depth(config))
        networks = Networks()
        load_networks(config, lambda text: print(text, file=sys.stderr), networks)
        with Outputs(out, overwrite) as outputs:
            estimator = Estimator(config if len(cameras) == 2 else settings_of_completed(config), networks)
            with_depth = partial(completed, config=config, networks=networks)
            slop_ns = round(slop * NANOSECONDS)
            return _run(recording, cameras, outputs, estimator, with_depth, rule, slop_ns, rectified, limit)


def _configured(preset: str | None, method: str | None, file: Path | None, changes: list[str]) -> Config:
    """Return the settings; where no preset is given, those of a network start from the preset for its depth."""
    changes = [*changes, *([f"reconstruction.method={method}"] if method else [])]
    config = configured(
        preset, file, changes, lambda asked: preset_for(asked.reconstruction.method, needs_depth(asked))
    )
    check_method(config)
    return config


def _check_given(context: typer.Context, to_ros: bool) -> None:
    """Refuse options of the offline replay with --to-ros, and the other way round."""
    given = {name for name in context.params if getattr(context.get_parameter_source(name), "name", "") == GIVEN}
    wrong = given - LIVE_OPTIONS - {"bag", "to_ros"} if to_ros else given & LIVE_OPTIONS
    if wrong:
        names = ", ".join(f"--{name.strip('_').replace('_', '-')}" for name in sorted(wrong))
        allowed = ", ".join(f"--{name}" for name in sorted(LIVE_OPTIONS))
        problem = f"cannot be used with --to-ros: expected only {allowed}" if to_ros else "needs --to-ros"
        raise BagError(f"{names} {problem}")


def _play(bag: Path, rate: float, loop: bool, topics: list[str], wait: float) -> int:
    try:
        from garps_ros.recording.playback import play  # imports rclpy, which offline replay does without
    except ImportError as error:
        raise BagError(
            f"--to-ros needs ROS 2 with rclpy ({error}): source it (source /opt/ros/jazzy/setup.bash), or without ROS, "
            "on x86_64, pip install -r requirements-ros.txt"
        ) from None
    return play(bag, rate, loop, topics, wait)


def _run(
    bag: Bag,
    cameras: list[CameraTopics],
    outputs: Outputs,
    estimator: Estimator,
    with_depth: Completed,
    rule: KeyframeRule,
    slop_ns: int,
    rectified: str,
    limit: int | None,
) -> int:
    summary = Summary()
    frames = Frames(bag, cameras, slop_ns, summary.refuse)
    with stop_on_signals() as stopped:
        # Plain text: "p[3]" in a reason is no markup, and a topic must not be broken over two lines.
        console = Console(stderr=True, markup=False, emoji=False, highlight=False, soft_wrap=True)
        with Progress(console=console, transient=True) as progress:
            say = console.print
            _say_choice(cameras, say)
            outcomes = _outcomes(frames, ViewReader(rectified, say), estimator, with_depth, rule, len(cameras))
            expected = min(bag.counts[cameras[0].image], limit or sys.maxsize)
            record(progress.track(outcomes, expected, description="frames"), outputs, summary, stopped, limit)
        summary.unpaired, summary.broken_end = frames.unpaired(), bag.broken_end
        Console(markup=False, emoji=False).print(summary.table())
        return INTERRUPTED if stopped() else 0 if summary.used else 1


def _outcomes(
    frames: Frames,
    reader: ViewReader,
    estimator: Estimator,
    with_depth: Completed,
    rule: KeyframeRule,
    cameras: int,
) -> Iterator[Origin | Outcome]:
    if cameras == 2:
        return estimate_pairs(frames.pairs(), reader, estimator.estimate)
    return estimate_keyframes(frames.singles(), reader, KeyframeTracker(estimator.estimate, rule), with_depth)


def _say_choice(cameras: list[CameraTopics], say: Callable[[str], None]) -> None:
    for name, camera in zip(("source", "target"), cameras, strict=False):
        say(f"{name}: {camera}")
    say("pose of source in target, pair by pair" if len(cameras) == 2 else "one camera against its keyframes")


def _check_choice(option: str, value: str, choices: tuple[str, ...]) -> None:
    if value not in choices:
        raise BagError(f"{option} is {value!r}: expected one of {', '.join(choices)}")


if __name__ == "__main__":
    sys.exit(main())
