# SPDX-License-Identifier: Apache-2.0
"""Peers find the pose of a small generated pair, and answer with a reason where there is none to be found."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from installed_peers import ON_THE_WALL, method

from bench.pairs.depths import with_monocular_depth
from bench.pairs.pair import Pair, rng_of, scene_points
from bench.pairs.readers.pairs_json import HALVES, RGBD_SETS, available, ids_of_half, load_pairs
from bench.pairs.starts import disturbed, disturbed_prior
from bench.peers.features_pnp import features_pnp
from bench.peers.methods import METHODS, NEED_NO_START
from bench.peers.odometry import with_intrinsics
from bench.peers.registration import FAST_LEVELS, cloud, without_edges
from bench.report import run_tables
from bench.scoring import summary
from garps_core import View, metrics
from garps_core.geometry import project, se3_exp, transform


def textured_wall(T_target_source=None, shape=(240, 320)):
    """A wavy wall with a smooth random pattern, 2 m ahead; the target's view is traced from the source's frame."""
    K = np.array([[260.0, 0, 159.5], [0, 260.0, 119.5], [0, 0, 1]])
    T = np.eye(4) if T_target_source is None else T_target_source
    v, u = np.mgrid[: shape[0], : shape[1]].astype(float)
    rays = np.stack([(u - K[0, 2]) / K[0, 0], (v - K[1, 2]) / K[1, 1], np.ones_like(u)], -1)
    R, centre = T[:3, :3].T, -T[:3, :3].T @ T[:3, 3]
    directions, depth = rays @ R.T, np.full(shape, 2.0)
    for _ in range(30):  # fixed point of z = wall(x, y) along each ray
        hit = centre + directions * depth[..., None]
        wall = 2 + 0.25 * np.sin(3 * hit[..., 0]) * np.cos(4 * hit[..., 1])
        depth += (wall - hit[..., 2]) / directions[..., 2]
    hit = centre + directions * depth[..., None]
    rng = np.random.default_rng(3)
    grey = np.zeros(shape)
    for frequency in rng.normal(0, 25, size=(60, 2)):
        grey += np.sin(hit[..., :2] @ frequency + rng.uniform(0, 6))
    rgb = np.clip(128 + 18 * grey, 0, 255).astype(np.uint8)
    return View(np.stack([rgb, 255 - rgb, rgb // 2], -1), K, depth.astype(np.float32))


@pytest.fixture(scope="module")
def pair():
    T = se3_exp(np.array([0.08, -0.05, 0.06, 0.02, -0.04, 0.03]))
    source = textured_wall()
    return Pair("wall", "wall", "small", source, textured_wall(T), T, scene_points(source))


def test_the_two_views_agree(pair):
    x = transform(pair.T_target_source, pair.points)
    u, v = np.rint(project(pair.target.K, x)).astype(int).T
    inside = (u >= 0) & (u < 320) & (v >= 0) & (v < 240)
    assert np.abs(pair.target.depth[v[inside], u[inside]] - x[inside, 2]).max() < 0.02


@pytest.mark.parametrize("name", ON_THE_WALL)
def test_peer_finds_the_pose(name, pair):
    start = disturbed(pair.T_target_source, pair.points, rng_of("wall"))
    T, reason = method(name)(pair.source, pair.target, None if name in NEED_NO_START else start)
    assert T is not None, reason
    assert metrics.error_3d_m(T, pair.T_target_source, pair.points) < 0.01


@pytest.mark.parametrize("name", METHODS)
def test_peer_gives_a_reason(name, pair, tmp_path, monkeypatch):
    monkeypatch.setenv("GARPS_WEIGHTS", str(tmp_path))
    run = method(name)
    blank = View(np.zeros((240, 320, 3), np.uint8), pair.source.K, np.full((240, 320), np.nan, np.float32))
    colour_only = dataclasses.replace(pair.source, depth=None)
    for source, target in ((blank, blank), (colour_only, dataclasses.replace(pair.target, depth=None))):
        T, reason = run(source, target, np.eye(4))
        assert T is None
        assert reason
    if name not in NEED_NO_START:
        assert run(pair.source, pair.target, None) == (None, "no start pose")


def test_odometry_sees_a_target_of_another_camera(pair):
    pytest.importorskip("open3d")
    K = pair.target.K @ np.diag([1.1, 1.08, 1]) + np.array([[0, 0, -30.0], [0, 0, 9], [0, 0, 0]])
    other = with_intrinsics(pair.target, dataclasses.replace(pair.target, K=K))
    nearly = pair.target.K + np.array([[0.5, 0, 0.5], [0, 0.5, 0.5], [0, 0, 0]])
    assert with_intrinsics(pair.target, dataclasses.replace(pair.target, K=nearly)) is pair.target
    x = transform(pair.T_target_source, pair.points)
    u, v = np.rint(project(K, x)).astype(int).T
    seen = (u >= 0) & (u < 320) & (v >= 0) & (v < 240)
    off = np.abs(other.depth[v[seen], u[seen]] - x[seen, 2])
    assert np.nanmax(off) < 0.03
    start = disturbed(pair.T_target_source, pair.points, rng_of("wall"))
    T, reason = METHODS["rgbd-hybrid"](pair.source, other, start)
    assert T is not None, reason
    # `other` says its own intrinsics, so it is resampled once more, to the source's.
    assert metrics.error_3d_m(T, pair.T_target_source, pair.points) < 0.02


def test_halves_are_disjoint_stable_and_whole():
    ids = [f"pair{i}" for i in range(11)]
    halves = {name: ids_of_half(ids, name) for name in HALVES}
    assert not halves["dev"] & halves["held-out"]
    assert halves["dev"] | halves["held-out"] == halves["all"] == set(ids)
    assert (len(halves["dev"]), len(halves["held-out"])) == (6, 5)
    assert ids_of_half(ids[::-1], "dev") == halves["dev"]
    assert halves["held-out"] == {"pair0", "pair1", "pair2", "pair7", "pair8"}
    with pytest.raises(ValueError, match="half is 'odd'"):
        ids_of_half(ids, "odd")


def test_features_work_with_depth_on_one_side_only(pair):
    pytest.importorskip("poselib")
    T = features_pnp(dataclasses.replace(pair.source, depth=None), pair.target)
    assert metrics.rotation_error_deg(T, pair.T_target_source) < 0.3


def test_cloud_leaves_out_edges():
    depth = np.full((40, 60), 2.0, np.float32)
    depth[:, 30:] = 3.0
    depth[10, 10] = np.nan
    kept = np.isfinite(without_edges(depth))
    assert not kept[:, 29:31].any()
    assert (~kept).sum() == 2 * 40 + 5
    points, colours = cloud(View(np.full((40, 60, 3), 255, np.uint8), np.diag([50.0, 50, 1]), depth))
    assert len(points) == len(colours)
    assert set(np.unique(points[:, 2])) == {2.0, 3.0}
    assert (colours == 1).all()
    assert [distance for _, distance in FAST_LEVELS] == sorted((d for _, d in FAST_LEVELS), reverse=True)


def test_disturbance_has_its_size_and_its_seed(pair):
    T = pair.T_target_source
    start = disturbed(T, pair.points, rng_of("a"))
    assert metrics.rotation_error_deg(start, T) == pytest.approx(1.0)
    assert metrics.error_3d_m(start, T, pair.points) == pytest.approx(0.12, abs=0.005)
    centre = pair.points.mean(0)
    assert np.linalg.norm(transform(start, centre) - transform(T, centre)) == pytest.approx(0.12)
    np.testing.assert_array_equal(start, disturbed(T, pair.points, rng_of("a")))
    assert np.abs(start - disturbed(T, pair.points, rng_of("b"))).max() > 0.01


def test_disturbed_prior_is_honest(pair):
    values = []
    for seed in range(20):
        prior = disturbed_prior(pair, seed)
        values.append(metrics.nees(prior.T_target_source, prior.covariance, pair.T_target_source))
    # Both parts have exactly the size that their sigmas say: 3 + 3.
    np.testing.assert_allclose(values, 6, atol=0.05)


def test_summary_counts_failures(capsys):
    good = {"found": True, "seconds": 0.1, "e_trans_m": 0.01, "e_rot_deg": 0.1, "e_3d_m": 0.02}
    bad = {"found": False, "seconds": 0.3, "e_trans_m": np.inf, "e_rot_deg": np.inf, "e_3d_m": np.inf}
    off = {**good, "e_trans_m": 0.5, "status": "converged", "nees": 100.0}
    names = {"set": "s", "start": "disturbed", "method": "m"}
    rows = [{**names, "category": c, **r} for c, r in (("small", good), ("large", bad), ("large", off))]
    lines = {line["category"]: line for line in summary.summarise(rows)}
    assert (lines["all"]["p90_e_3d_m"], lines["all"]["map_free"]) == (np.inf, pytest.approx(1 / 3))
    assert lines["small"]["p90_e_3d_m"] == 0.02
    assert list(lines) == ["small", "large", "all"]
    assert lines["all"]["n"] == "2/3"
    assert lines["all"]["success"] == pytest.approx(1 / 3)
    assert lines["all"]["e_trans_m"] == 0.5
    assert lines["large"]["e_trans_m"] == np.inf
    assert lines["all"]["mean_e_trans_m"] == pytest.approx(0.255)
    assert (lines["all"]["nees_95"], lines["all"]["wrong_ok"]) == (0, pytest.approx(1 / 3))
    assert "| all | m | 2/3 | 0.5000 |" in run_tables.markdown(rows, {"cpu": "x"})


def test_written_rows_can_be_read_again(tmp_path):
    row = {"set": "s", "start": "d", "category": "small", "method": "m", "found": False, "seconds": 0.1}
    run_tables.write(tmp_path, [{**row, **dict.fromkeys(("e_trans_m", "e_rot_deg", "e_3d_m"), np.inf)}], {"cores": 2})
    assert {path.name for path in tmp_path.iterdir()} == {"rows.csv", "run.json", "table.md"}
    assert "Infinity" not in (tmp_path / "run.json").read_text()


@pytest.mark.parametrize("name", RGBD_SETS)
def test_data_set_loads(name):
    if name not in available():
        pytest.skip(f"{name} is not at ../shared/data")
    (pair,) = load_pairs(name, limit=1)
    assert pair.category in ("small", "large")
    assert np.nanmedian(pair.source.depth) == pytest.approx(2.5, abs=2)
    spoilt = with_monocular_depth(pair)
    assert np.array_equal(np.isnan(spoilt.source.depth), np.isnan(pair.source.depth))
    assert not np.array_equal(spoilt.source.depth, pair.source.depth, equal_nan=True)
    assert spoilt.points is pair.points
