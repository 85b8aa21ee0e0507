# SPDX-License-Identifier: Apache-2.0
"""Clips in RealEstate10K's layout, made on the spot."""

from __future__ import annotations

import cv2
import numpy as np
from scipy.spatial.transform import Rotation

from bench.pairs.readers import realestate10k
from garps_core.geometry import se3_inverse, transform

WIDTH, HEIGHT = 64, 36


def motion(degrees=0.0, t=(0.0, 0.0, 0.0), axis=(0.0, 1.0, 0.0)):
    T = np.eye(4)
    T[:3, :3] = Rotation.from_rotvec(np.radians(degrees) * np.array(axis)).as_matrix()
    T[:3, 3] = t
    return T


def track_line(stamp, T, camera=(0.5, 0.9, 0.5, 0.5), distortion=(0, 0)):
    return " ".join(map(str, [stamp, *camera, *distortion, *T[:3].ravel().tolist()]))


def write_track(folder, clip, T_1_0, split="test", T_0_world=None, length=30):
    """A clip whose frame 29 sees what frame 0 sees, moved by T_1_0."""
    T_0_world = motion(20, (1, 2, 3)) if T_0_world is None else T_0_world
    poses = [T_0_world] * (length - 1) + [T_1_0 @ T_0_world]
    path = folder / "cameras" / split / f"{clip}.txt"
    path.parent.mkdir(parents=True, exist_ok=True)
    lines = [track_line(1000 * k, T) for k, T in enumerate(poses)]
    path.write_text("\n".join(["https://example.org/watch?v=1#t", *lines]) + "\n")
    return path


def write_frames(folder, clip, stamps=(0, 29000), ending="png"):
    for stamp in stamps:
        path = folder / "frames" / clip / f"{stamp}.{ending}"
        path.parent.mkdir(parents=True, exist_ok=True)
        cv2.imwrite(str(path), np.full((HEIGHT, WIDTH, 3), (10, 20, 30), np.uint8))


def write_sparse(folder, clip, factor, outliers=0, count=60, seed=0):
    """A wall's sparse points in the clip's world, and the depth of frame 0, in a unit `factor` times smaller."""
    rng = np.random.default_rng(seed)
    K = realestate10k.Camera(0, 0.5, 0.9, 0.5, 0.5, np.eye(4)).K(WIDTH, HEIGHT)
    depth = np.round(1000 * (2 + np.arange(WIDTH) / WIDTH * np.ones((HEIGHT, 1))))
    u, v = rng.integers(0, WIDTH, count), rng.integers(0, HEIGHT, count)
    z = depth[v, u] / 1000 / factor
    z[:outliers] *= rng.uniform(2, 5, outliers)
    camera = np.stack([(u - K[0, 2]) / K[0, 0], (v - K[1, 2]) / K[1, 1], np.ones(count)], 1) * z[:, None]
    world = transform(se3_inverse(motion(20, (1, 2, 3))), camera)
    for name in ("points", f"depth/{clip}"):
        (folder / name).mkdir(parents=True, exist_ok=True)
    np.savez(folder / "points" / f"{clip}.npz", points=world)
    cv2.imwrite(str(folder / "depth" / clip / "0.png"), depth.astype(np.uint16))
    return depth / 1000, K, camera
