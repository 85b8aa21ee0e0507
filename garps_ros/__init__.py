# SPDX-License-Identifier: Apache-2.0
"""The ROS side of GARPS: the live node (needs rclpy) and the offline replay of recordings (needs no ROS).

pose_node.py   `ros2 run garps_ros pose_node`: starts and ends the node
replay.py      `garps-replay`: poses from a recording, or the recording into a live graph
live/          the node; its docstring lists the path of an image
recording/     recordings: reading, choice of topics, results, playback
estimates/     frames -> estimates: pairs of two cameras, one camera against keyframes
frames/        messages -> frames: image, depth and calibration of one time, joined by their stamps
parameters/    the node's settings, and every ROS parameter made from them

A folder imports from the folders below it in this list; `live` and `recording` do not know each other, and `parameters`
knows the core only.
"""
