# SPDX-License-Identifier: Apache-2.0
"""Generated pairs with hardly anything to match: seeded, kept on disk, and as dark as they say."""

import numpy as np
import pytest

from bench.pairs import bare_rooms
from bench.pairs.bare_rooms import LEVELS, SPLITS, Split
from bench.pairs.pair import Pair, rng_of, scene_points
from bench.pairs.starts import disturbed
from bench.peers.methods import METHODS
from garps_core import metrics

WIDTH, HEIGHT = 160, 120


@pytest.fixture
def small_split(monkeypatch):
    monkeypatch.setitem(SPLITS, "tiny", Split(range(20, 30), 1))
    monkeypatch.setattr(bare_rooms, "LEVELS", (1, 2))
    return "tiny"


@pytest.fixture(scope="module")
def textured():
    """A well lit room at a size at which every method has something to hold on to."""
    from bench.rooms import make_pair
    from garps_core import View

    made = make_pair(3, 1, width=320, height=240, depth_noise="sensor")
    source, target = View(made.rgb0, made.K0, made.depth0), View(made.rgb1, made.K1, made.depth1)
    points = scene_points(View(made.rgb0, made.K0, made.true_depth0))
    return Pair("room", "room3", "small", source, target, made.T_1_0, points)


@pytest.mark.parametrize("name", ["rgbd-hybrid", "rgbd-intensity", "sift-pnp+small-gicp", "kiss-matcher+gicp"])
def test_peer_finds_the_pose_of_a_room(name, textured):
    for module in ("open3d", "small_gicp", "poselib", "kiss_matcher"):
        pytest.importorskip(module)
    start = disturbed(textured.T_target_source, textured.points, rng_of("room3"))
    T, reason = METHODS[name](textured.source, textured.target, start)
    assert T is not None, reason
    error = metrics.error_3d_m(T, textured.T_target_source, textured.points)
    assert error < 0.4 * metrics.error_3d_m(start, textured.T_target_source, textured.points)


def test_splits_share_no_seed_and_hold_every_level():
    tune, report = SPLITS["tune"], SPLITS["report"]
    assert not set(tune.seeds) & set(report.seeds)
    assert (tune.size, report.size) == (16, 48)
    assert list(bare_rooms.candidates(report))[:5] == [(2000, 1), (2001, 2), (2002, 3), (2003, 4), (2004, 1)]
    for split in (tune, report):
        seeds = [seed for seed, _ in bare_rooms.candidates(split)]
        assert len(seeds) == len(set(seeds))
        assert all(sum(level == k for _, level in bare_rooms.candidates(split)) >= 2 * split.per_level for k in LEVELS)


def test_pairs_are_kept_on_disk_and_stay_the_same(small_split, tmp_path):
    shown = []
    first = bare_rooms.load(small_split, tmp_path, lambda *counts: shown.append(counts), WIDTH, HEIGHT)
    assert [pair.id for pair in first.pairs] == ["room0020_level1", "room0021_level2"]
    assert shown[-1] == (2, 2)
    assert all(bare_rooms.match_count(pair) < bare_rooms.MAX_MATCHES for pair in first.pairs)
    (tmp_path / "room0021_level2.npz").unlink()  # as after an interruption
    kept = (tmp_path / "room0020_level1.npz").stat().st_mtime_ns
    again = bare_rooms.load(small_split, tmp_path, width=WIDTH, height=HEIGHT)
    assert (tmp_path / "room0020_level1.npz").stat().st_mtime_ns == kept
    for a, b in zip(first.pairs, again.pairs, strict=True):
        for view in ("source", "target"):
            for name in bare_rooms.VIEW_ARRAYS:
                np.testing.assert_array_equal(getattr(getattr(a, view), name), getattr(getattr(b, view), name))
        np.testing.assert_array_equal(a.T_target_source, b.T_target_source)
        np.testing.assert_array_equal(a.points, b.points)
    with pytest.raises(ValueError, match="empty the folder"):
        bare_rooms.load(small_split, tmp_path, width=WIDTH + 4, height=HEIGHT)


def test_candidates_with_matches_are_rejected_and_counted(small_split, tmp_path, monkeypatch):
    monkeypatch.setattr(bare_rooms, "MAX_MATCHES", 0)
    monkeypatch.setitem(SPLITS, "tiny", Split(range(20, 21), 1))
    with pytest.raises(ValueError, match="gave 0 pairs of 2"):
        bare_rooms.load(small_split, tmp_path, width=WIDTH, height=HEIGHT)
    with np.load(tmp_path / "room0020_level1.npz", allow_pickle=False) as file:
        assert sorted(file.files) == ["matches", "recipe"]
    assert bare_rooms.BareRooms([], 5).rejected == 5


def test_true_points_lie_in_the_target_as_its_depth_says():
    pair = bare_rooms.room_pair(22, 1, WIDTH, HEIGHT)
    from garps_core.geometry import project, transform

    seen = transform(pair.T_target_source, pair.points)
    u, v = np.rint(project(pair.target.K, seen)).astype(int).T
    inside = (u >= 0) & (u < WIDTH) & (v >= 0) & (v < HEIGHT)
    ratio = pair.target.depth[v[inside], u[inside]] / seen[inside, 2]
    assert np.median(ratio) == pytest.approx(1, abs=0.09)  # monocular: 5 % of scale, 3 % of warp
    assert pair.category == "small"


def test_dark_images_are_dark_noisy_and_seeded():
    rgb = np.full((60, 80, 3), 200, np.uint8)
    made = [bare_rooms.in_the_dark(rgb, np.random.default_rng(seed)) for seed in (1, 1, 2)]
    np.testing.assert_array_equal(made[0], made[1])
    assert (made[0] != made[2]).any()
    expected = 200 * bare_rooms.EXPOSURE ** (1 / bare_rooms.GAMMA)
    assert made[0].mean() == pytest.approx(expected, rel=0.03)
    electrons = (200 / 255) ** bare_rooms.GAMMA * bare_rooms.EXPOSURE * bare_rooms.WHITE_ELECTRONS
    relative = np.sqrt(electrons + bare_rooms.READ_ELECTRONS**2) / electrons / bare_rooms.GAMMA
    assert made[0].std() / made[0].mean() == pytest.approx(relative, rel=0.15)
