# SPDX-License-Identifier: Apache-2.0
# pose_node on ROS 2 Jazzy, x86_64, with CUDA through torch's own libraries (the host needs NVIDIA's driver and container
# toolkit). Not built by continuous integration, and not built yet at all; the steps are those of docs/robot.md.
#
#   docker build -t garps .
#   docker run --rm -it --gpus all --net=host --ipc=host garps                                   # pose_node
#   docker run --rm -it --init --gpus all --net=host --ipc=host garps ros2 launch garps_ros garps.launch.py --show-args
#
# `docker stop` ends both in good order: the node itself is process 1, since `ros2 run` passes no signal on, and
# STOPSIGNAL is SIGINT, the one signal on which `ros2 launch` ends its nodes; as process 1 it needs --init.
# --net=host: DDS finds the cameras' drivers. --ipc=host: their images come through shared memory. Without a GPU leave out
# --gpus all; parameter device stays cpu.
FROM ros:jazzy-ros-base

RUN apt-get update \
 && apt-get install -y --no-install-recommends \
      python3-colcon-common-extensions python3-numpy python3-scipy python3-venv ros-jazzy-launch-ros ros-jazzy-tf2-msgs \
 && rm -rf /var/lib/apt/lists/*

ENV PIP_NO_CACHE_DIR=1 PIP_DISABLE_PIP_VERSION_CHECK=1 \
    NVIDIA_VISIBLE_DEVICES=all NVIDIA_DRIVER_CAPABILITIES=compute,utility
WORKDIR /ws

# The environment sees apt's rclpy and NumPy. The package is installed once without its code and taken out again, which
# leaves what it needs: torch (5 GB with CUDA) is then not downloaded anew for every change of the code.
RUN python3 -m venv --system-site-packages venv && touch venv/COLCON_IGNORE
COPY setup.py setup.cfg pyproject.toml package.xml requirements-numpy1.txt needs/
COPY resource needs/resource
RUN venv/bin/pip install -c needs/requirements-numpy1.txt "setuptools<80" "./needs[fast]" \
 && venv/bin/pip uninstall -y garps_ros \
 && rm -rf needs

# python -m colcon of that environment: the executables get its Python.
COPY . src/garps_ros
RUN . /opt/ros/jazzy/setup.sh && venv/bin/python -m colcon build

RUN printf '%s\n' '#!/bin/bash' 'set -e' 'source /ws/install/setup.bash' 'exec "$@"' > /entrypoint.sh \
 && chmod +x /entrypoint.sh
ENTRYPOINT ["/entrypoint.sh"]
STOPSIGNAL SIGINT
CMD ["/ws/install/garps_ros/lib/garps_ros/pose_node"]
