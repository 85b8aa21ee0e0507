# SPDX-License-Identifier: Apache-2.0
"""Matches between two cameras that look at points 2 to 5 m away, made without an image, and wrong as asked for."""

import numpy as np
from surfaces import TRUTH, flat, grey_at, look

from garps_core import Config
from garps_core.geometry import pixel_rays, project, transform
from garps_core.start.features import Matches
from garps_core.start.match_pose import pose_from_matches

HD = (240, 320)
CAMERA = np.array([[280.0, 0, 159.5], [0, 280.0, 119.5], [0, 0, 1]])
BLANK = look(surface=flat, colours=grey_at, camera=CAMERA, size=HD)


def exact_matches(seed=0, count=80, pixel_noise=0.0, outliers=0, relative_depth_noise=0.0, truth=TRUTH):
    """Points 2 to 5 m away, matched between two cameras without an image."""
    rng = np.random.default_rng(seed)
    px_s = rng.uniform((40, 30), (280, 210), (count, 2))
    points = pixel_rays(CAMERA, px_s[:, 0], px_s[:, 1]) * rng.uniform(2, 5, (count, 1))
    there = transform(truth, points)
    px_t = project(CAMERA, there)
    px_t[:outliers] = rng.uniform((0, 0), (319, 239), (outliers, 2))
    there[:outliers] = pixel_rays(CAMERA, *px_t[:outliers].T) * rng.uniform(2, 5, (outliers, 1))
    gains = 1 + relative_depth_noise * rng.normal(size=(2, count, 1))
    shift = pixel_noise * rng.normal(size=(2, count, 2))
    return Matches(px_s + shift[0], px_t + shift[1], points * gains[0], there * gains[1])


def pose_from(matches, config=None):
    return pose_from_matches(matches, BLANK, BLANK, config or Config())


def one_place(seed, copies=8, **noise):
    """The same match many times over, a billionth of a pixel apart: any number of poses fits it."""
    single = exact_matches(seed, count=1, **noise)
    repeated = {name: np.repeat(part, copies, axis=0) for name, part in vars(single).items()}
    apart = 1e-9 * np.arange(copies)[:, None]
    return Matches(**repeated | {name: repeated[name] + apart for name in ("source_px", "target_px")})
