# SPDX-License-Identifier: Apache-2.0
"""The ROS side of GARPS: offline replay of recordings (needs no ROS) and the live nodes (need rclpy)."""
