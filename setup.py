# SPDX-License-Identifier: Apache-2.0
"""The ament_python package `garps_ros`: one wheel for pip, one package for colcon."""

from pathlib import Path

from setuptools import find_packages, setup

NAME = "garps_ros"
SHARE = f"share/{NAME}"


def present(pattern: str) -> list[str]:
    """Files below this folder that match, relative as setuptools wants them."""
    return sorted(str(path) for path in Path().glob(pattern))


FIGURE = ["matplotlib>=3.6"]
WEIGHTS = ["huggingface_hub>=1.20"]  # for `garps weights fetch` alone; before, a broken connection was the end of it
TEST = ["pytest", "pytest-cov", "hypothesis", "plyfile"]
BENCH = [
    "trimesh",
    "embreex",
    "open3d-cpu",
    "small-gicp",
    "kiss-matcher",
    "pycolmap>=4",
    "cpd-pytorch",
    "optuna",
    "distributed",
]

setup(
    name=NAME,
    version="0.1.0",
    description="Metric relative pose of two cameras by aligning two 3D Gaussian mixtures, with ROS 2 nodes",
    long_description="See README.md in the source tree.",
    license="Apache-2.0",
    author="GARPS maintainers",
    python_requires=">=3.10",
    packages=find_packages(
        include=["garps_ros", "garps_ros.*", "garps_core", "garps_core.*", "msg_adapters", "msg_adapters.*"]
    ),
    package_data={"garps_core.models": ["demo_net.safetensors"]},
    data_files=[
        ("share/ament_index/resource_index/packages", [f"resource/{NAME}"]),
        (SHARE, ["package.xml"]),
        (f"{SHARE}/launch", present("launch/*.launch.py")),
        (f"{SHARE}/config", present("config/*.yaml") + present("config/*.xml")),
        (f"{SHARE}/rviz", present("rviz/*.rviz")),
    ],
    # rclpy and the message packages come with ROS (apt), never from pip: see requirements-ros.txt.
    install_requires=[
        "numpy>=1.26",
        "opencv-python-headless>=4.6",
        "poselib",
        "rich",
        "rosbags>=0.10",
        "ruamel.yaml>=0.17",
        "safetensors>=0.4",
        "scipy>=1.11",
        "torch>=2.1",
        "typer>=0.12",
    ],
    extras_require={
        "fast": ["numba>=0.59"],
        "figure": FIGURE,
        "weights": WEIGHTS,
        "test": TEST + FIGURE + WEIGHTS,
        "bench": BENCH + FIGURE,
    },
    entry_points={
        "console_scripts": [
            "garps = garps_core.cli:main",
            "garps-replay = garps_ros.replay:main",
            # The names that `ros2 run garps_ros ...` shows.
            "pose_node = garps_ros.pose_node:main",
            "replay = garps_ros.replay:main",
        ],
    },
    zip_safe=True,
)
