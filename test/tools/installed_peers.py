# SPDX-License-Identifier: Apache-2.0
"""Peers of the benchmark, skipped where what they need is not installed."""

from __future__ import annotations

import pytest

from bench.peers.methods import METHODS

NEEDS = {
    "small-gicp": ("small_gicp",),
    "sift-pnp": ("poselib",),
    "sift-pnp-oneway": ("poselib",),
    "sift-pnp+small-gicp": ("poselib", "small_gicp"),
    "five-point": ("poselib",),
    "colmap": ("pycolmap",),
    "colmap-relaxed": ("pycolmap",),
    "cpd": ("cpd_pytorch", "open3d"),
    "kiss-matcher+gicp": ("kiss_matcher", "open3d"),
    "mast3r": (),
    "dust3r": (),
}

ON_THE_WALL = [name for name in METHODS if name.startswith(("open3d", "small", "rgbd", "sift", "kiss"))]
"""The others are tried in a room: `test_baselines_sfm.py`."""


def method(name):
    for module in NEEDS.get(name, ("open3d",)):
        pytest.importorskip(module)
    return METHODS[name]
