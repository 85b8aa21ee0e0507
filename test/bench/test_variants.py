# SPDX-License-Identifier: Apache-2.0
"""A variant leaves its part out of GARPS and nothing else; a pair without a pose is a row."""

from dataclasses import replace

import numpy as np
import pytest

pytest.importorskip("embreex")

from bench.pairs.pair import Pair, scene_points
from bench.pairs.starts import disturbed_prior
from bench.rooms import make_pair
from bench.rows.pair_rows import START, rows_of_pair
from bench.rows.variants import VARIANTS, isotropic, last_rung, variant_estimate, without_frustum
from garps_core import Config, View, estimate_relative_pose, reconstruct

pytestmark = pytest.mark.usefixtures("one_thread")


@pytest.fixture(scope="module")
def pair() -> Pair:
    made = make_pair(7, 2, width=320, height=240, depth_noise="sensor")
    views = View(made.rgb0, made.K0, made.depth0), View(made.rgb1, made.K1, made.depth1)
    points = scene_points(View(made.rgb0, made.K0, made.true_depth0))
    return Pair("rooms", "room7", "small", *views, made.T_1_0, points, labels=(made.labels0, made.labels1))


def test_as_it_is_it_is_garps(pair: Pair) -> None:
    prior = disturbed_prior(pair)
    ours = variant_estimate(VARIANTS["garps"], pair, Config(), prior)
    assert np.array_equal(
        ours.T_target_source, estimate_relative_pose(pair.source, pair.target, Config(), prior).T_target_source
    )


def test_balls_have_the_volume_of_what_they_replace(pair: Pair) -> None:
    mixture = reconstruct(pair.source)
    balls = isotropic(mixture)
    np.testing.assert_allclose(
        np.linalg.det(balls.covariances.astype(float)), np.linalg.det(mixture.covariances.astype(float)), rtol=1e-3
    )
    assert (balls.covariances[:, 0, 1] == 0).all() and np.array_equal(balls.means, mixture.means)
    assert without_frustum(mixture).frustum is None and mixture.frustum is not None


def test_only_the_finest_rung_is_left() -> None:
    config = Config.preset("monocular")
    found = last_rung(config).alignment
    assert found.effective_measurements == config.alignment.effective_measurements
    assert found.ladder == config.alignment.ladder[-1:] and found.search_ladder == config.alignment.search_ladder[-1:]


@pytest.mark.parametrize("name", list(VARIANTS))
def test_every_variant_runs_and_changes_something(pair: Pair, name: str) -> None:
    prior = disturbed_prior(pair)
    changes = {"reconstruction.method": "rgbd", "alignment.semantic_discount": 0.5}
    if name != "garps-no-features":  # a start as good as theirs begins on the last rung anyway
        changes["start.features"] = False
    config = Config.preset("monocular").replace(changes)
    full, found = (variant_estimate(VARIANTS[one], pair, config, prior) for one in ("garps", name))
    assert found.T_target_source is not None, found.reason
    assert np.array_equal(found.T_target_source, full.T_target_source) == (name == "garps")
    assert np.linalg.norm(found.T_target_source[:3, 3] - pair.T_target_source[:3, 3]) < 0.3


def test_variants_are_rows_beside_garps(pair: Pair) -> None:
    rows = rows_of_pair(Config(), pair, "disturbed", ["garps", "garps-labels", "garps-no-features"])
    assert [row["method"] for row in rows] == [START, "garps", "garps-labels", "garps-no-features"]
    plain = rows_of_pair(Config(), replace(pair, labels=None), "none", ["garps", "garps-labels", "garps-no-features"])
    assert [row["method"] for row in plain] == [START, "garps"]
    assert all(row["scale"] == "metres" and row["true_trans_m"] == pytest.approx(0.25) for row in rows)


def test_a_pair_without_depth_is_a_row(pair: Pair) -> None:
    blind = replace(pair, source=replace(pair.source, depth=None))
    rows = rows_of_pair(Config(), blind, "disturbed", ["garps", "garps-isotropic", "small-gicp", "sift-pnp"])
    failed = {row["method"]: row["reason"] for row in rows if not row["found"]}
    assert {"garps", "garps-isotropic", "small-gicp"} <= set(failed) and "depth" in failed["garps"]
    assert all(row["e_3d_m"] == np.inf for row in rows if not row["found"])
