# SPDX-License-Identifier: Apache-2.0
"""Command `ros2 run garps_ros pose_node`: starts the node, and ends it in good order on SIGINT and SIGTERM.

Exit code 0 = asked to stop, 1 = stalled (see STALL_S), 2 = wrong parameters, weights that are missing, or no rclpy;
128 + n on a second signal.
"""

from __future__ import annotations

import faulthandler
import os
import signal
import sys
import time
import traceback
from types import FrameType
from typing import Any

NAME = "pose_node"
SPIN_S = 0.2
"""Longest wait of the executor, s; Python's signal handlers do not run meanwhile."""
PATIENCE_S = 3.0
"""Time that a computation may go on after a signal before the process ends without it, s."""
STALL_S = 20.0
"""Time without a turn of the loop after which the process prints its traceback and ends, s; a launch file restarts it.

Callbacks take milliseconds, so the node is not the cause: a reader of Fast DDS 2.14 can loop for ever inside
the call that takes a message, where neither Python's threads nor its signal handlers run. The watch is in C.
"""

HELP = """The pose of one camera in another, in metres with covariance, from two cameras; or the path of one.

Depth comes from a topic of each camera, or from a network: -p reconstruction.method:=depth_anything_v2 (or flash3d)
-p preset:=monocular, with weights that `garps weights fetch` has installed.

usage: pose_node [--help] [--ros-args ...]

Subscribes (remap with -r source/image:=/left/image_rect ...)
  source/image, target/image              sensor_msgs/Image, or CompressedImage with -p image_transport:=compressed
  source/camera_info, target/camera_info  sensor_msgs/CameraInfo
  source/depth, target/depth              depth registered to the image: 16UC1 millimetres or 32FC1 metres; not with
                                          a network
  ~/prior                                 geometry_msgs/PoseWithCovarianceStamped: source in target, if known (optional)
Publishes
  ~/pose          geometry_msgs/PoseStamped: pose of the source camera in the target's optical frame
  ~/odometry      nav_msgs/Odometry: the same with covariance and both frame names
  ~/source_cloud, ~/target_cloud  sensor_msgs/PointCloud2 in the target frame, while subscribed to
  /diagnostics    diagnostic_msgs/DiagnosticArray, once a second: what is missing, rejected, how long it takes
Services
  ~/reset (std_srvs/Trigger), ~/enable (std_srvs/SetBool)
Parameters: docs/parameters.md, config/garps.yaml, or `ros2 param describe /pose_node NAME`; numbers with a point: 5.0

examples:
  ros2 run garps_ros pose_node --ros-args -r source/image:=/right/image_rect -r target/image:=/left/image_rect \\
      -r source/camera_info:=/right/camera_info -r target/camera_info:=/left/camera_info \\
      -r source/depth:=/right/depth -r target/depth:=/left/depth
  ros2 run garps_ros pose_node --ros-args -p reconstruction.method:=depth_anything_v2 -p preset:=monocular \\
      -r source/image:=/right/image_rect -r source/camera_info:=/right/camera_info \\
      -r target/image:=/left/image_rect -r target/camera_info:=/left/camera_info
  ros2 run garps_ros pose_node --ros-args -p pairing:=keyframe -r source/image:=/camera/color/image_raw ...
"""


def main(arguments: list[str] | None = None) -> int:
    """Run the node until a signal; return the exit code."""
    words = sys.argv if arguments is None else [NAME, *arguments]
    if {"-h", "--help"} & set(words[1:]):
        print(HELP, end="")
        return 0
    stopped = _stop_on_signals()  # before anything heavy is imported: a signal may come at any time
    try:
        import rclpy
    except ImportError as error:
        return _refuse(f"rclpy is not there ({error}): source /opt/ros/jazzy/setup.bash, or see requirements-ros.txt")
    try:
        started = _start(words)
    except Exception as error:
        if stopped:
            return 0
        if not _is_users(error):
            raise
        return _refuse(str(error))
    try:
        return _run(*started, stopped)
    finally:
        rclpy.try_shutdown()


def _start(words: list[str]) -> tuple[Any, Any, Any]:
    """Return the executor, the rclpy node and the PoseNode in it."""
    import rclpy
    from rclpy.executors import SingleThreadedExecutor
    from rclpy.node import Node

    from garps_core.errors import ConfigError
    from garps_ros.live.node import PoseNode

    rclpy.init(args=words, signal_handler_options=rclpy.signals.SignalHandlerOptions.NO)
    unknown = rclpy.utilities.remove_ros_args(words)[1:]
    if unknown:
        raise ConfigError(f"unknown argument {unknown[0]!r}: expected --help or --ros-args ...")
    executor, ros = SingleThreadedExecutor(), Node(NAME)
    node = PoseNode(ros)
    executor.add_node(ros)
    return executor, ros, node


def _is_users(error: Exception) -> bool:
    """Tell whether an error at the start is about something that the user gave: arguments, parameters, names."""
    from rclpy import exceptions

    from garps_core.errors import ConfigError

    theirs = (ConfigError, exceptions.ParameterException, exceptions.NameValidationException)
    return isinstance(error, theirs) or type(error).__name__ in ("RCLError", "UnknownROSArgsError")


def _run(executor: Any, ros: Any, node: Any, stopped: list[int]) -> int:
    watched_s = -STALL_S
    while not (stopped or node.start_error):
        if time.monotonic() - watched_s > 1.0:
            watched_s = time.monotonic()
            faulthandler.dump_traceback_later(STALL_S, exit=True)
        try:
            executor.spin_once(timeout_sec=SPIN_S)
        except Exception as error:
            node.failed(error, traceback.format_exc())
    faulthandler.dump_traceback_later(STALL_S, exit=True)
    code = _refuse(node.start_error) if node.start_error and not stopped else 0
    if not node.stop(PATIENCE_S):  # it goes on in native code; the interpreter cannot be taken down under it
        sys.stdout.flush()
        sys.stderr.flush()
        os._exit(code)
    executor.shutdown()
    ros.destroy_node()
    return code


def _stop_on_signals() -> list[int]:
    """Return a list that notes the first SIGINT or SIGTERM from now on; the second ends the process at once."""
    received: list[int] = []

    def note(number: int, _: FrameType | None) -> None:
        if received:
            os._exit(128 + number)
        received.append(number)

    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, note)
    return received


def _refuse(reason: str) -> int:
    print(f"{NAME}: error: {' '.join(reason.split())}", file=sys.stderr)
    return 2


if __name__ == "__main__":
    sys.exit(main())
