# SPDX-License-Identifier: Apache-2.0
"""Depth edges: the test by neighbourhood is the test written out, and every caller's ratio has its meaning."""

import numpy as np
import pytest

from garps_core.edges import away_from_edges, one_surface


def written_out(depth, ratio):
    """Loop over the pixels; neighbours without depth, or beyond the border, are ignored."""
    mask = np.zeros(depth.shape, bool)
    for v, u in np.ndindex(depth.shape):
        block = depth[max(v - 1, 0) : v + 2, max(u - 1, 0) : u + 2]
        near, far = np.nanmin(block) if np.isfinite(block).any() else 1, np.nanmax(block, initial=0)
        mask[v, u] = np.isfinite(depth[v, u]) and far - near < np.float32(ratio) * near
    return mask


@pytest.mark.parametrize("ratio", [0.03, 0.08, 0.12])
def test_a_pixel_is_away_from_edges_when_its_neighbourhood_is_one_surface(ratio):
    rng = np.random.default_rng(0)
    depth = rng.uniform(2.0, 2.2, (20, 30)).astype(np.float32)
    depth[:, 15:] += 1
    depth[rng.uniform(size=depth.shape) < 0.05] = np.nan
    got = away_from_edges(depth, ratio)
    np.testing.assert_array_equal(got, written_out(depth, ratio))
    assert 0 < got.mean() < 0.95


def test_the_slack_is_added_to_the_share():
    near, far = np.array([1.0, 1.0, 1.0]), np.array([1.02, 1.034, 1.036])
    assert one_surface(near, far, 0.03).tolist() == [True, False, False]
    assert one_surface(near, far, 0.03, 0.005).tolist() == [True, True, False]
