# SPDX-License-Identifier: Apache-2.0
"""The synthetic rooms tell the truth, and the same truth every time."""

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

pytest.importorskip("embreex")
rooms = pytest.importorskip("bench.rooms")

SIZE = {"width": 320, "height": 240}


@pytest.fixture(scope="module")
def pair():
    return rooms.make_pair(1, 3, **SIZE)


def project(pair):
    """View 0's pixels in view 1: rows of (v0, u0), pixel (u1, v1) float and z in camera 1, for those inside."""
    height, width = pair.true_depth0.shape
    v, u = np.mgrid[:height, :width]
    pixel = np.stack([u, v, np.ones_like(u)], axis=-1).reshape(-1, 3)
    points = pixel @ np.linalg.inv(pair.K0).T * pair.true_depth0.reshape(-1, 1).astype(float)
    points = points @ pair.T_1_0[:3, :3].T + pair.T_1_0[:3, 3]
    image = points @ pair.K1.T
    uv = image[:, :2] / image[:, 2:]
    inside = (points[:, 2] > 0.1) & (uv >= 0).all(axis=1) & (uv <= (width - 1, height - 1)).all(axis=1)
    return pixel[inside][:, 1::-1], uv[inside], points[inside, 2]


def sample(image, uv):
    at = np.zeros((-(-len(uv) // 1000) * 1000, 2), np.float32)
    at[: len(uv)] = uv
    return cv2.remap(image, at.reshape(-1, 1000, 2), None, cv2.INTER_LINEAR).reshape(len(at), -1)[: len(uv)]


def sift(rgb):
    return cv2.SIFT_create().detectAndCompute(cv2.cvtColor(rgb, cv2.COLOR_RGB2GRAY), None)


def test_same_seed_same_bytes_other_seed_other_room(pair):
    rooms.room_pair._cached_room.cache_clear()
    again = rooms.make_pair(1, 3, **SIZE)
    for name in ("rgb0", "rgb1", "depth0", "depth1", "labels0", "labels1", "K0", "K1", "T_1_0"):
        assert getattr(pair, name).tobytes() == getattr(again, name).tobytes(), name
    other = rooms.make_pair(2, 3, **SIZE)
    assert other.rgb0.tobytes() != pair.rgb0.tobytes()
    assert not np.allclose(other.T_1_0, pair.T_1_0)


def test_types_and_ranges(pair):
    assert pair.rgb0.dtype == np.uint8 and pair.rgb0.shape == (240, 320, 3)
    assert pair.depth0.dtype == np.float32 and np.isfinite(pair.depth0).all(), "no ray leaves a closed room"
    assert pair.depth0.min() > 0.1 and pair.depth0.max() < 10
    assert set(np.unique(pair.labels0)) <= set(range(1, len(rooms.LABELS)))
    assert len(np.unique(pair.labels0)) >= 4
    assert np.array_equal(pair.depth0, pair.true_depth0)


def test_depth_colour_and_labels_agree_between_views(pair):
    at, uv, z = project(pair)
    seen = sample(pair.true_depth1, uv)[:, 0]
    visible = np.abs(seen - z) < 0.03
    assert 0.3 < visible.mean() <= 1
    assert np.median(np.abs(seen - z)[visible]) < 2e-3
    here = pair.rgb0[at[:, 0], at[:, 1]].astype(float)[visible]
    there = sample(pair.rgb1, uv)[visible].astype(float)
    gain = np.median((there + 1) / (here + 1))  # exposures differ
    assert np.median(np.abs(gain * here - there)) < 8
    correlation = np.corrcoef(here.mean(axis=1), there.mean(axis=1))[0, 1]
    assert correlation > 0.9
    nearest = np.round(uv[visible]).astype(int)
    same = pair.labels0[at[visible, 0], at[visible, 1]] == pair.labels1[nearest[:, 1], nearest[:, 0]]
    assert same.mean() > 0.97


@pytest.mark.parametrize("level", sorted(rooms.LEVELS))
def test_levels_have_their_motion_and_overlap(level):
    degrees, metres, low, high = rooms.LEVELS[level]
    pair = rooms.make_pair(1, level, width=64, height=48)
    assert np.rad2deg(Rotation.from_matrix(pair.T_1_0[:3, :3]).magnitude()) == pytest.approx(degrees, abs=1e-6)
    assert np.linalg.norm(pair.T_1_0[:3, 3]) == pytest.approx(metres, abs=1e-9)
    assert low - 0.1 < pair.overlap < high + 0.1
    for depth in (pair.true_depth0, pair.true_depth1):
        assert np.quantile(depth, 0.04) > 0.4 and np.median(depth) > 1.0


def test_unknown_level_and_noise_are_refused():
    with pytest.raises(ValueError, match="level is 6"):
        rooms.make_pair(0, 6)
    with pytest.raises(ValueError, match="depth_noise is 'blur'"):
        rooms.make_pair(0, 1, depth_noise="blur")


def test_texture_changes_features_but_not_shape(pair):
    rich, plain = (rooms.make_pair(2, 3, texture=texture, **SIZE) for texture in (1.0, 0.0))
    assert plain.true_depth0.tobytes() == rich.true_depth0.tobytes()
    assert len(sift(pair.rgb0)[0]) > 300
    # What is left are corners of furniture and shadows.
    assert len(sift(plain.rgb0)[0]) < 0.45 * len(sift(rich.rgb0)[0])


def test_feature_matches_obey_the_truth(pair):
    keys0, desc0 = sift(pair.rgb0)
    keys1, desc1 = sift(pair.rgb1)
    matches = [a for a, b in cv2.BFMatcher().knnMatch(desc0, desc1, k=2) if a.distance < 0.75 * b.distance]
    assert len(matches) > 40
    uv0 = np.array([keys0[m.queryIdx].pt for m in matches])
    uv1 = np.array([keys1[m.trainIdx].pt for m in matches])
    z = sample(pair.true_depth0, uv0).astype(float)
    points = np.column_stack([uv0, np.ones(len(uv0))]) @ np.linalg.inv(pair.K0).T * z
    image = (points @ pair.T_1_0[:3, :3].T + pair.T_1_0[:3, 3]) @ pair.K1.T
    error = np.linalg.norm(image[:, :2] / image[:, 2:] - uv1, axis=1)
    assert np.median(error) < 0.6
    assert (error < 2).mean() > 0.7


def test_render_outside_sees_nothing_behind_and_noise_is_seeded():
    room = rooms.room_pair._cached_room(1, 1.0)
    K = np.array([[60.0, 0, 31.5], [0, 60.0, 23.5], [0, 0, 1]])
    away = rooms.look_at(np.array([-2.0, 1.0, 1.5]), np.array([-9.0, 1.0, 1.0]))
    nothing = room.render(away, K, 64, 48)
    assert np.isnan(nothing.depth_m).all() and (nothing.labels == 0).all()
    inside = rooms.look_at(np.array([0.5, 0.5, 1.5]), np.append(room.size[:2] / 2, 1.0))
    first, again, other = (room.render(inside, K, 64, 48, rng=seed) for seed in (5, 5, 6))
    assert first.rgb.tobytes() == again.rgb.tobytes() != other.rgb.tobytes()
    dark = room.render(inside, K, 64, 48, exposure=0.5)
    assert dark.rgb.mean() < 0.9 * first.rgb.mean()


@pytest.fixture
def holed(pair):
    depth = pair.true_depth0.copy()
    depth[40:80, 60:140] = np.nan
    depth[np.random.default_rng(0).random(depth.shape) < 0.2] = np.nan
    depth[:, -3:] = np.nan
    return depth


def test_monocular_depth_keeps_holes_and_stays_in_bounds(holed):
    out = rooms.monocular_depth(holed, np.random.default_rng(1))
    assert out.dtype == np.float32 and np.array_equal(np.isnan(out), np.isnan(holed))
    ratio = (out / holed)[np.isfinite(out)]
    assert 0.9 < np.median(ratio) < 1.1
    same_scale = np.log(ratio / np.median(ratio))
    assert np.quantile(np.abs(same_scale), 0.75) < 0.05
    assert np.array_equal(out, rooms.monocular_depth(holed, np.random.default_rng(1)), equal_nan=True)


def test_monocular_blur_reaches_only_edges_and_ignores_holes():
    depth = np.full((96, 128), 2.0, np.float32)
    depth[:, 64:] = 4.0
    depth[30:60, 20:40] = np.nan
    out = rooms.monocular_depth(depth, np.random.default_rng(0), scale=0.0, warp=0.0)
    flat = np.ones(depth.shape, bool)
    flat[:, 52:76] = False
    error = np.abs(out / depth - 1)[flat & np.isfinite(depth)]
    assert error.max() < 0.04, "0.5 % pixel noise only, also beside the hole"
    assert np.abs(out[:, 63] / 2 - 1).mean() > 0.1


def test_sensor_depth_noise_steps_and_holes(pair, holed):
    out = rooms.sensor_depth(holed, np.random.default_rng(2))
    assert np.isnan(out[np.isnan(holed)]).all()
    got = np.isfinite(out)
    assert 0.6 < got.sum() / np.isfinite(holed).sum() < 1.0
    error = (out - holed)[got] / (1e-3 + 2e-3 * holed[got] ** 2)
    assert 0.7 < np.std(error) < 1.3
    assert np.allclose(out[got] * 1000, np.round(out[got] * 1000), atol=1e-3)
    far = rooms.sensor_depth(np.full((48, 64), 7.0, np.float32), np.random.default_rng(0))
    assert np.isnan(far).all()


@pytest.mark.parametrize("corrupt", [rooms.monocular_depth, rooms.sensor_depth])
def test_corruption_takes_empty_maps_and_zeros(corrupt):
    for nothing in (np.nan, 0.0, np.inf, -1.0):
        assert np.isnan(corrupt(np.full((24, 32), nothing, np.float32), np.random.default_rng(0))).all()
