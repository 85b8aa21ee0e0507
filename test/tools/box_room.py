# SPDX-License-Identifier: Apache-2.0
"""A small pair of pictures for the command: a textured box room, ray cast exactly."""

from __future__ import annotations

import numpy as np

from garps_core.geometry import se3_exp

K = np.array([[150.0, 0, 79.5], [0, 150.0, 59.5], [0, 0, 1]])
K_WORDS = ["--K", "150", "150", "79.5", "59.5"]
TRUTH = se3_exp(np.array([0.06, -0.02, 0.05, 0.01, 0.05, -0.02]))
START = "0.06 -0.01 0.03 0.005 0.03 -0.01 0.9995"


def room(T_camera_room: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """A textured box room, ray cast exactly: rgb HxWx3 uint8 and depth HxW metres."""
    v, u = np.mgrid[0:120, 0:160].astype(float)
    rays = np.stack([(u - K[0, 2]) / K[0, 0], (v - K[1, 2]) / K[1, 1], np.ones_like(u)], -1)
    R, t = T_camera_room[:3, :3], T_camera_room[:3, 3]
    origin, directions = -R.T @ t, rays @ R
    low, high = np.array([-0.6, -0.45, -1.0]), np.array([0.55, 0.4, 1.8])
    with np.errstate(divide="ignore"):
        bound = np.where(directions > 0, high, low)
        distance = np.where(directions != 0, (bound - origin) / directions, np.inf)
    depth = distance.min(-1)
    points = origin + directions * depth[..., None]
    waves = [np.sin(points @ w + i) for i, w in enumerate(((19.0, 3, 2), (2, 21, -4), (-9, 4, 15)))]
    rgb = np.clip(128 + 90 * np.stack(waves, -1), 0, 255).astype(np.uint8)
    return rgb, depth.astype(np.float32)
