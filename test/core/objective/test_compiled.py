# SPDX-License-Identifier: Apache-2.0
"""The compiled backend agrees with the plain one to 1e-5, repeats itself to the last bit, and may be missing."""

from __future__ import annotations

import inspect
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace

import numpy as np
import pytest
import torch
from places import ROOT
from scipy.spatial import cKDTree
from surfaces import HALF, TRUTH, disturbed, off, random_mixture, random_pose, two_mixtures

from garps_core import Config, align_mixtures
from garps_core.config import Alignment, Rung
from garps_core.objective import compiled, loops, neighbours, pairs, plain
from garps_core.objective.backend import Backend
from garps_core.objective.packed import moved_rows
from garps_core.objective.pairs import pair_up, thin, to_device, visible, without_floor
from garps_core.objective.shape import evaluate
from garps_core.objective.with_depth_errors import corrected

needs_numba = pytest.mark.skipif(not compiled.AVAILABLE, reason="numba is not installed")
CLOSE = 1e-5
SETTINGS = Alignment(colour_variance=0.05, outlier_floor=0.01)
RUNG = Rung(covariance_scale=4.0, components=4000, neighbours=10, steps=1)
KINDS = ("surface", "scattered")


def clouds(kind, config=None):
    """Rows, partners and the pose between them; a number of rows that is no multiple of a block's 128."""
    if kind == "surface":
        rows, partners = two_mixtures()
        return to_device(rows, config or Config()), to_device(partners, config or Config()), TRUTH
    rows, partners = (
        to_device(random_mixture(seed, count), config or Config()) for seed, count in ((1, 700), (2, 900))
    )
    return rows, partners, random_pose(3, 0.1)


def assert_close(got, expected, name=""):
    """Relative to the largest of the same plane, infinities alike."""
    got, expected = np.asarray(got, np.float64), np.asarray(expected, np.float64)
    np.testing.assert_array_equal(np.isinf(got), np.isinf(expected))
    there = np.isfinite(expected)
    assert there.any() and np.abs(expected[there]).max() > 0, f"{name}: nothing to compare"
    assert np.abs(got - expected)[there].max() <= CLOSE * np.abs(expected[there]).max(), name


def plain_pairs(rows, partners, T, settings=SETTINGS):
    return pair_up(replace(rows, backend=plain), partners, T, RUNG, settings)


def functions_of(module):
    """The public functions that a module defines, with their signatures."""
    return {
        name: inspect.signature(function)
        for name, function in inspect.getmembers(module, inspect.isfunction)
        if function.__module__ == module.__name__ and not name.startswith("_")
    }


def test_both_backends_offer_the_functions_of_the_protocol():
    """With the same signatures, but for `self`."""
    asked = {
        name: signature.replace(parameters=list(signature.parameters.values())[1:])
        for name, signature in (
            (name, inspect.signature(function))
            for name, function in inspect.getmembers(Backend, inspect.isfunction)
            if not name.startswith("_")
        )
    }
    assert {"row_sums", "moments", "log_objective", "nearest", "gathered", "visible"} == set(asked)
    assert functions_of(compiled) == asked
    offered = functions_of(plain)
    assert {name: offered[name] for name in asked} == asked


@pytest.mark.parametrize("dtype", ["float32", "float64"])
def test_the_backend_is_chosen_once_and_carried_along(monkeypatch, dtype):
    mixtures, config = (random_mixture(1, 60), random_mixture(2, 70)), Config(dtype=dtype)
    here = [to_device(mixture, config) for mixture in mixtures]
    chosen = compiled if compiled.AVAILABLE and dtype == "float32" else plain
    monkeypatch.setattr(compiled, "AVAILABLE", not compiled.AVAILABLE)  # nobody asks again
    kept = [here[0], here[0].take(torch.arange(50)), thin(here[0], 20), corrected(here[0], np.full(6, 0.01))]
    assert all(mixture.backend is chosen for mixture in kept)
    assert pair_up(*here, np.eye(4), RUNG, SETTINGS).backend is chosen


@needs_numba
def test_the_exponential_is_that_of_the_library():
    x = np.linspace(-79.9, 79.9, 20_001, dtype=np.float32)
    got = np.array([loops.exponential(value) for value in x])
    np.testing.assert_allclose(got, np.exp(x.astype(np.float64)), rtol=5e-7)


@needs_numba
@pytest.mark.parametrize("kind", KINDS)
def test_sums_over_partners_are_torch_s(kind):
    rows, partners, T = clouds(kind)
    pairs = plain_pairs(rows, partners, T, replace(SETTINGS, max_distance_m=0.3))
    assert torch.isinf(pairs.log_weights).any(), "partners that are none"
    planes = (*moved_rows(pairs.means, pairs.covariances, T), *pairs.partners)
    fast, slow = (backend.row_sums(*planes).numpy() for backend in (compiled, plain))
    double = [part.double() for part in pairs.partners]
    exact = plain.row_sums(*moved_rows(pairs.means.double(), pairs.covariances.double(), T), *double).numpy()
    assert fast.tobytes() != slow.tobytes(), "or one was not used"
    for plane in range(16):
        assert_close(fast[plane], slow[plane], plane)
        error = [np.abs(sums[plane] - exact[plane]).max() for sums in (fast, slow)]
        assert error[0] <= 2 * error[1] + 1e-6 * np.abs(exact[plane]).max(), "no worse than torch"


@needs_numba
@pytest.mark.parametrize("form", ["log", "sum"])
@pytest.mark.parametrize("kind", KINDS)
def test_evaluations_are_torch_s(kind, form):
    rows, partners, T = clouds(kind)
    pairs = plain_pairs(rows, partners, T)
    pairs = without_floor(pairs) if form == "sum" else pairs
    fast, slow = (evaluate(replace(pairs, backend=backend), T, form) for backend in (compiled, plain))
    assert fast.value == pytest.approx(slow.value, rel=CLOSE) and fast.support == pytest.approx(slow.support, rel=CLOSE)
    for name in ("information", "observed"):
        assert_close(getattr(fast, name), getattr(slow, name), name)
    scale = np.sqrt(np.diag(slow.information))
    assert np.abs((fast.gradient - slow.gradient) / scale).max() < CLOSE * np.sqrt(len(rows)), "in its own sigmas"


@needs_numba
@pytest.mark.parametrize("kind", KINDS)
def test_moments_are_torch_s(kind):
    """From the same sums, so that nothing but the summation differs."""
    rows, partners, T = clouds(kind)
    pairs = plain_pairs(rows, partners, T)
    mu, S = moved_rows(pairs.means, pairs.covariances, T)
    sums = plain.row_sums(mu, S, *pairs.partners)
    weights = pairs.weights.double()
    c, per_weight = weights / (1 + sums[0].double()), 1 / weights
    fast, slow = (backend.moments(c, per_weight, sums, mu, S) for backend in (compiled, plain))
    for got, expected in zip(fast, slow, strict=True):
        assert_close(got, expected)


@needs_numba
@pytest.mark.parametrize("kind", KINDS)
def test_gathered_partners_are_torch_s(kind):
    rows, partners, _ = clouds(kind)
    index = torch.from_numpy(np.random.default_rng(0).integers(0, len(partners), (len(rows), 7)))
    fast, slow = (
        pairs._gathered(replace(rows, backend=backend), partners, index, RUNG, SETTINGS)
        for backend in (compiled, plain)
    )
    for got, expected, name in zip(fast, slow, ("means", "covariances", "log weights"), strict=True):
        assert got.shape == expected.shape and got.dtype == expected.dtype
        np.testing.assert_allclose(got.numpy(), expected.numpy(), rtol=CLOSE, atol=1e-6, err_msg=name)


@needs_numba
@pytest.mark.parametrize("ratio", [0.0, 0.1, 100.0])
def test_visible_components_are_torch_s(ratio):
    """Points within rounding of a pixel's border or of the depth may differ."""
    (source, target), seen_shares = two_mixtures(), []
    holes = target.frustum.depth.copy()
    holes[5:9, 10:20] = np.nan
    frustum = replace(target.frustum, depth=holes)
    cloud = to_device(source, Config())
    turned = np.diag([-1.0, 1, -1, 1])
    for T in (TRUTH, np.eye(4), random_pose(1, 0.4), random_pose(2, 0.4), turned):
        fast, slow = (
            visible(replace(cloud, backend=backend), T, frustum, ratio).numpy() for backend in (compiled, plain)
        )
        assert fast.dtype == slow.dtype == np.bool_ and (fast != slow).mean() < (2e-3 if ratio else 0.02)
        seen_shares.append(slow.mean())
    assert seen_shares[-1] == 0 < max(seen_shares)


def neighbours_of(kind, where):
    """Rows in the partners' frame, and partners."""
    rows, partners, T = clouds(kind)
    moved = rows.means[:: 3 if kind == "surface" else 1] @ torch.as_tensor(T[:3, :3].T).float()
    shift = {"among them": (0, 0, 0), "beside": (6, -4, 0), "far": (0.5, 0, 60), "behind": (0.3, 0.1, -6)}[where]
    return (moved + torch.tensor(shift, dtype=torch.float32)).contiguous(), partners.means.contiguous()


@needs_numba
@pytest.mark.parametrize("where", ["among them", "beside", "far", "behind"])
@pytest.mark.parametrize("kind", KINDS)
def test_neighbours_are_those_of_the_tree(kind, where):
    rows, partners = neighbours_of(kind, where)
    index, distance = neighbours.nearest(rows.numpy(), partners.numpy(), 12)
    rows, partners = rows.double().numpy(), partners.double().numpy()
    expected, _ = cKDTree(partners).query(rows, k=12)
    scale = np.abs(rows).max()  # differences of float32 coordinates
    np.testing.assert_allclose(distance, expected, rtol=CLOSE, atol=1e-6 * scale)
    own = np.linalg.norm(rows[:, None] - partners[index], axis=2)
    np.testing.assert_allclose(own, expected, rtol=CLOSE, atol=1e-6 * scale, err_msg="and these are they")
    assert all(len(set(row)) == 12 for row in index), "each of them once"


@needs_numba
def test_all_partners_are_neighbours_where_all_are_asked_for():
    rows, partners = (part[:60].contiguous() for part in neighbours_of("scattered", "among them"))
    index, distance = neighbours.nearest(rows.numpy(), partners.numpy(), 60)
    np.testing.assert_array_equal(np.sort(index, axis=1), np.tile(np.arange(60), (60, 1)))
    assert (np.diff(distance, axis=1) >= 0).all()
    one, none = neighbours.nearest(rows.numpy(), partners[:1].numpy(), 1)
    assert not one.any() and (none > 0).all()


@needs_numba
def test_partners_behind_their_camera_are_left_to_the_tree():
    """Cells of an image cannot hold them; the answer is right all the same."""
    rows, partners, T = clouds("scattered")
    behind = replace(partners, means=partners.means - torch.tensor([0, 0, 3.0]))
    _, distance = pairs._nearest(rows, behind, T, 5)
    moved = rows.means.double().numpy() @ T[:3, :3].T + T[:3, 3]
    expected, _ = cKDTree(behind.means.double().numpy()).query(moved, k=5)
    np.testing.assert_allclose(distance.numpy(), expected, rtol=CLOSE, atol=1e-6)


@needs_numba
@pytest.mark.parametrize("preset", ["default", "monocular"])
def test_a_whole_alignment_is_the_same_with_and_without(monkeypatch, preset):
    config = Config.preset(preset)
    mixtures = two_mixtures(config=config)
    fast = align_mixtures(*mixtures, disturbed(), config)
    monkeypatch.setattr(compiled, "AVAILABLE", False)
    slow = align_mixtures(*mixtures, disturbed(), config)
    assert fast.status is slow.status and fast.overlap == pytest.approx(slow.overlap, abs=1e-3)
    assert fast.T_target_source.tobytes() != slow.T_target_source.tobytes(), "or one was not used"
    assert max(off(fast.T_target_source, slow.T_target_source)) < CLOSE
    np.testing.assert_allclose(fast.covariance, slow.covariance, atol=0.01 * np.abs(slow.covariance).max())


@pytest.mark.parametrize("preset", ["default", "monocular"])
def test_threads_and_repetitions_give_the_same_bits(preset):
    config = Config.preset(preset)
    mixtures = two_mixtures(config=config, **HALF)

    def bits(_):
        estimate = align_mixtures(*mixtures, disturbed(), config)
        return estimate.T_target_source.tobytes() + estimate.covariance.tobytes()

    alone = bits(0)
    with ThreadPoolExecutor(2) as pool:
        assert set(pool.map(bits, range(10))) == {alone}


def test_without_numba_everything_works():
    """In a process that cannot import it, on the same views."""
    program = """
import sys
sys.modules["numba"] = None
from surfaces import HALF, disturbed, two_mixtures
from garps_core import Config, align_mixtures
from garps_core.objective import compiled, loops
assert not compiled.AVAILABLE and loops.exponential(0.0) == 1.0
for preset in ("default", "monocular"):
    config = Config.preset(preset)
    estimate = align_mixtures(*two_mixtures(config=config, **HALF), disturbed(), config)
    print(estimate.status.value, *map(repr, map(float, estimate.T_target_source.ravel())))
"""
    path = [f"import sys; sys.path[:0] = {[str(ROOT), str(ROOT / 'test' / 'tools')]!r}\n", program]
    ran = subprocess.run([sys.executable, "-c", "".join(path)], capture_output=True, text=True, timeout=120)
    assert ran.returncode == 0, ran.stderr
    for line, preset in zip(ran.stdout.splitlines(), ("default", "monocular"), strict=True):
        status, *numbers = line.split()
        config = Config.preset(preset)
        here_too = align_mixtures(*two_mixtures(config=config, **HALF), disturbed(), config)
        assert status == here_too.status.value == "converged"
        assert max(off(np.array(numbers, float).reshape(4, 4), here_too.T_target_source)) < CLOSE
