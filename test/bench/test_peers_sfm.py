# SPDX-License-Identifier: Apache-2.0
"""Peers in a generated room, mostly those that need matches, structure from motion or a network; twice the same."""

import dataclasses
import sys
from functools import cache, partial

import numpy as np
import pytest

pytest.importorskip("embreex")

from installed_peers import ON_THE_WALL, method
from network_weights import install_reduced
from point_map_cases import point_maps

from bench.pairs.pair import Pair, rng_of, scene_points
from bench.pairs.starts import disturbed
from bench.peers import metres
from bench.peers.colmap import colmap_relaxed
from bench.peers.features_pnp import Failure, features_pnp_oneway
from bench.peers.five_point import five_point
from bench.peers.methods import METHODS, NEED_NO_START, NONDETERMINISTIC
from bench.rooms import make_pair
from garps_core import View, metrics
from garps_core.geometry import transform
from garps_core.models import two_view_in_use
from garps_core.models.in_use import Networks

pytestmark = pytest.mark.usefixtures("one_thread")
WITHIN_M = {
    "icp": 0.03,
    "cpd": 0.15,
    "sift-pnp-oneway": 0.01,
    "five-point": 0.03,
    "colmap": 0.03,
    "colmap-relaxed": 0.03,
}
"""Mean distance of the points of the scene, 3 m away, from where they should be."""
NETWORKS = ("mast3r", "dust3r")


@pytest.fixture(scope="module")
def pair() -> Pair:
    made = make_pair(3, 2, width=320, height=240)
    source, target = View(made.rgb0, made.K0, made.depth0), View(made.rgb1, made.K1, made.depth1)
    return Pair("rooms", "room3", "small", source, target, made.T_1_0, scene_points(source))


@pytest.fixture(scope="module")
def answer(pair: Pair):
    """The first answer of a peer, by name; kept, because some take seconds."""

    @cache
    def of(name: str):
        return method(name)(pair.source, pair.target, None if name in NEED_NO_START else start_of(pair))

    return of


def start_of(pair: Pair):
    return disturbed(pair.T_target_source, pair.points, rng_of(pair.id))


def e_3d_m(T, pair: Pair) -> float:
    return metrics.error_3d_m(T, pair.T_target_source, pair.points)


def test_every_method_is_tried_somewhere() -> None:
    assert {*ON_THE_WALL, *WITHIN_M, *NETWORKS} == set(METHODS) >= NONDETERMINISTIC
    blind = ("sift", "five", "colmap", "kiss", *NETWORKS)
    assert {name for name in METHODS if name.startswith(blind)} == set(NEED_NO_START)


@pytest.mark.parametrize("name", WITHIN_M)
def test_peer_finds_the_pose_in_a_room(name: str, pair: Pair, answer) -> None:
    T, reason = answer(name)
    assert T is not None, reason
    assert e_3d_m(T, pair) < WITHIN_M[name]
    np.testing.assert_allclose(T[:3, :3] @ T[:3, :3].T, np.eye(3), atol=1e-9)


@pytest.mark.parametrize("name", [name for name in METHODS if name not in NETWORKS])
def test_two_calls_give_the_same_bits(name: str, pair: Pair, answer) -> None:
    first, second = answer(name), method(name)(pair.source, pair.target, start_of(pair))
    assert first.T is not None, first.reason
    assert name in NONDETERMINISTIC or np.array_equal(first.T, second.T)


def test_colmap_gives_up_on_short_baselines_unless_told_not_to(pair: Pair) -> None:
    pytest.importorskip("pycolmap")
    made = make_pair(3, 1, width=320, height=240)
    views = View(made.rgb0, made.K0, made.depth0), View(made.rgb1, made.K1, made.depth1)
    T, reason = METHODS["colmap"](*views, None)
    assert T is None and reason.startswith("COLMAP made no model of both images (") and "(0 " not in reason
    assert metrics.rotation_error_deg(colmap_relaxed(*views), made.T_1_0) < 1


def test_the_length_is_that_of_the_depth(pair: Pair, monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("poselib")
    found = five_point(pair.source, pair.target)
    twice = [dataclasses.replace(view, depth=2 * view.depth) for view in (pair.source, pair.target)]
    np.testing.assert_allclose(five_point(*twice)[:3, 3], 2 * found[:3, 3], rtol=1e-6)
    one_sided = five_point(pair.source, dataclasses.replace(pair.target, depth=None))
    assert metrics.scale_ratio(one_sided, found) == pytest.approx(1, abs=0.05)
    monkeypatch.setattr(metres, "LENGTH", "none")
    blind = [dataclasses.replace(view, depth=None) for view in (pair.source, pair.target)]
    free = five_point(*blind)
    assert np.linalg.norm(free[:3, 3]) == pytest.approx(1)
    np.testing.assert_array_equal(free[:3, :3], found[:3, :3])
    monkeypatch.setattr(metres, "LENGTH", "depth")
    with pytest.raises(Failure, match="0 triangulated points with depth, 8 needed"):
        five_point(*blind)


def test_one_way_needs_depth_of_the_source_alone(pair: Pair) -> None:
    pytest.importorskip("poselib")
    whole = features_pnp_oneway(pair.source, pair.target)
    np.testing.assert_array_equal(whole, features_pnp_oneway(pair.source, dataclasses.replace(pair.target, depth=None)))
    with pytest.raises(Failure, match="no pose with 8 inliers"):
        features_pnp_oneway(dataclasses.replace(pair.source, depth=None), pair.target)


def test_cpd_finds_a_cloud_again(pair: Pair) -> None:
    T, reason = method("cpd")(pair.source, pair.source, disturbed(np.eye(4), pair.points, rng_of("again")))
    assert T is not None, reason
    assert np.linalg.norm(transform(T, pair.points) - pair.points, axis=1).mean() < 1e-3


@pytest.mark.parametrize("name", NETWORKS)
def test_a_network_that_is_not_installed_is_a_reason(name, pair, tmp_path, monkeypatch) -> None:
    monkeypatch.setenv("GARPS_WEIGHTS", str(tmp_path))
    T, reason = METHODS[name](pair.source, pair.target, None)
    assert T is None and reason.startswith(f"weights are not installed: no {name} weights in ")


@pytest.mark.parametrize("name", NETWORKS)
def test_a_network_of_random_parameters_knows_no_pose(name, pair, tmp_path, monkeypatch) -> None:
    install_reduced(tmp_path, "mast3r", "dust3r-dpt")
    monkeypatch.setenv("GARPS_WEIGHTS", str(tmp_path))
    monkeypatch.setattr(two_view_in_use, "NaverModel", partial(two_view_in_use.NaverModel, long_side=128))
    T, reason = METHODS[name](pair.source, pair.target, None)
    assert T is None and "trusted pixels fit one pose: expected at least 20%" in reason


@pytest.mark.parametrize("name", NETWORKS)
def test_a_network_that_tells_the_truth_is_believed(name, pair, monkeypatch) -> None:
    maps = point_maps((pair.source, pair.target), pair.T_target_source)
    told = dataclasses.replace(maps, metric=name == "mast3r")
    monkeypatch.setattr(Networks, "pair_maps", lambda *_: told)
    T, reason = METHODS[name](pair.source, pair.target, None)
    assert T is not None, reason
    assert e_3d_m(T, pair) < 0.01


def test_a_library_that_is_missing_is_a_reason(pair: Pair, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "pycolmap", None)
    T, reason = METHODS["colmap"](pair.source, pair.target, None)
    assert T is None and "pycolmap" in reason
