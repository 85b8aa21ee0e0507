# SPDX-License-Identifier: Apache-2.0
"""Launch file of the pose node for one pair of cameras. Arguments: ros2 launch garps_ros garps.launch.py --show-args.

Example: ros2 launch garps_ros garps.launch.py source_image:=/left/image_rect source_depth:=/left/depth_registered
         target_image:=/right/image_rect target_depth:=/right/depth_registered target_frame:=right_optical rviz:=true
"""

from __future__ import annotations

from pathlib import Path

from launch.actions import DeclareLaunchArgument, LogInfo, OpaqueFunction
from launch_ros.actions import Node

from launch import LaunchContext, LaunchDescription

SHARE = Path(__file__).absolute().parent.parent  # share/garps_ros; in the source tree it looks the same from here
LARGE_IMAGES = {"FASTRTPS_DEFAULT_PROFILES_FILE": str(SHARE / "config" / "fastdds_large_images.xml")}
AS_IN_FILE = "as in params_file"
YES_NO = ("true", "false")

ARGUMENTS: tuple[tuple[str, str, tuple[str, ...], str], ...] = (
    ("source_image", "source/image", (), "colour or grey image of the camera whose pose is wanted"),
    (
        "source_info",
        "",
        (),
        "its CameraInfo; empty: camera_info beside the image (/left/image_rect: /left/camera_info)",
    ),
    (
        "source_depth",
        "source/depth",
        (),
        "its depth, registered to the image: 16UC1 in mm or 32FC1 in m; not used with a network",
    ),
    (
        "target_image",
        "target/image",
        (),
        "image of the camera in whose frame the pose is given; not for pairing:=keyframe",
    ),
    ("target_info", "", (), "its CameraInfo; empty: camera_info beside the image"),
    ("target_depth", "target/depth", (), "its depth, registered to the image"),
    (
        "reconstruction",
        "",
        (),
        "reconstruction.method: auto and rgbd take the depth topics; depth_anything_v2, demo_net, flash3d, two_view "
        "and installed depth networks (`garps doctor` lists them) do without; give them "
        f"preset:=monocular, and two_view a start.method; preset:=mast3r has both; empty: {AS_IN_FILE}",
    ),
    ("image_transport", "", ("", "raw", "compressed"), f"compressed: subscribe IMAGE/compressed; empty: {AS_IN_FILE}"),
    ("pairing", "", ("", "cameras", "keyframe"), f"two cameras, or one against its keyframe; empty: {AS_IN_FILE}"),
    (
        "preset",
        "",
        (
            "",
            "default",
            "sensor",
            "time_of_flight",
            "structured_light",
            "stereo",
            "monocular",
            "mast3r",
            "demo_net",
            "paper",
            "paper_full",
        ),
        f"estimator settings that the file does not give: sensor depth or a network's; empty: {AS_IN_FILE}",
    ),
    ("target_frame", "", (), "name of the frame the pose is given in; empty: frame_id of the target's images"),
    ("publish_tf", "", ("", *YES_NO), f"also publish the pose as a transform; empty: {AS_IN_FILE}"),
    ("params_file", str(SHARE / "config" / "garps.yaml"), (), "parameters of the node, YAML"),
    ("use_sim_time", "false", YES_NO, "take time from /clock: simulation, ros2 bag play --clock"),
    ("namespace", "", (), "of the node; topics without a leading slash are below it"),
    (
        "large_images",
        "false",
        YES_NO,
        "images over 0.5 MB with Fast DDS: give the node shared memory of 32 MiB; their publishers must run with "
        f"FASTRTPS_DEFAULT_PROFILES_FILE={LARGE_IMAGES['FASTRTPS_DEFAULT_PROFILES_FILE']} too",
    ),
    ("respawn", "true", YES_NO, "start the node again 2 s after it ends by itself; false shows a wrong setting once"),
    ("rviz", "false", YES_NO, "also start RViz with images, clouds and pose; give target_frame with it"),
)


def generate_launch_description() -> LaunchDescription:
    """Return the description that `ros2 launch` runs."""
    declared = [
        DeclareLaunchArgument(name, default_value=default, description=text, choices=list(choices) or None)
        for name, default, choices, text in ARGUMENTS
    ]
    return LaunchDescription([*declared, OpaqueFunction(function=start)])


def start(context: LaunchContext) -> list[Node | LogInfo]:
    """Return the node, and RViz if it is wanted, from the arguments as they were given."""
    given = {name: context.launch_configurations[name] for name, *_ in ARGUMENTS}
    node = Node(
        package="garps_ros",
        executable="pose_node",
        namespace=given["namespace"],
        parameters=[given["params_file"], parameters(given)],
        remappings=remappings(given),
        additional_env=environment(given),
        output="screen",
        emulate_tty=True,
        respawn=given["respawn"] == "true",
        respawn_delay=2.0,
    )
    return [node] if given["rviz"] == "false" else [node, *viewer(given)]


def remappings(given: dict[str, str]) -> list[tuple[str, str]]:
    """Return pairs of a name in the node and the topic that was asked for."""
    pairs = []
    for camera in ("source", "target"):
        image = given[f"{camera}_image"]
        folder, slash, _ = image.rpartition("/")
        pairs += [
            (f"{camera}/image", image),
            (f"{camera}/camera_info", given[f"{camera}_info"] or f"{folder}{slash}camera_info"),
            (f"{camera}/depth", given[f"{camera}_depth"]),
        ]
    return pairs


def parameters(given: dict[str, str]) -> dict[str, str | bool]:
    """Return the parameters that were given; the parameter file decides on all others."""
    texts = {name: given[name] for name in ("image_transport", "pairing", "preset", "target_frame") if given[name]}
    if given["reconstruction"]:
        texts["reconstruction.method"] = given["reconstruction"]
    flags = {name: given[name] == "true" for name in ("publish_tf", "use_sim_time") if given[name]}
    return {**texts, **flags}


def environment(given: dict[str, str]) -> dict[str, str]:
    """Return environment variables of the processes started here, in addition to the shell's."""
    return LARGE_IMAGES if given["large_images"] == "true" else {}


def viewer(given: dict[str, str]) -> list[Node | LogInfo]:
    """Return RViz, with the names of rviz/garps.rviz remapped to the topics of this launch."""
    frame = given["target_frame"]
    base = "/" + given["namespace"].strip("/") if given["namespace"].strip("/") else ""
    images = [(f"/{name}", to if to.startswith("/") else f"{base}/{to}") for name, to in remappings(given)]
    results = [(f"/pose_node/{name}", f"{base}/pose_node/{name}") for name in ("pose", "source_cloud", "target_cloud")]
    rviz = Node(
        package="rviz2",
        executable="rviz2",
        name="garps_rviz",
        arguments=["-d", str(SHARE / "rviz" / "garps.rviz"), *(["-f", frame] if frame else [])],
        parameters=[{"use_sim_time": given["use_sim_time"] == "true"}],
        remappings=images + results,
        additional_env=environment(given),
        output="log",
    )
    hint = "RViz: set Global Options / Fixed Frame to the frame_id of the target's images, or give target_frame:=NAME"
    return [rviz] if frame else [LogInfo(msg=hint), rviz]
