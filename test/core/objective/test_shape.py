# SPDX-License-Identifier: Apache-2.0
"""The objective equals the full double sum, its derivatives those of automatic differentiation, whatever the layout.

The reference below is written from the paper's eq. 5 with dense (n, m) tensors and shares no code with the package.
"""

from dataclasses import replace

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from problems import INLINE
from surfaces import moved, permuted, random_mixture, random_pose

from garps_core import Config
from garps_core.config import Alignment, Rung
from garps_core.geometry import adjoint, se3_exp, se3_inverse
from garps_core.objective.pairs import pair_up, to_device, without_floor
from garps_core.objective.shape import evaluate
from garps_core.objective.state import State
from garps_core.solver.ladder import two_way

DOUBLE = Config(dtype="float64")
SETTINGS = Alignment(colour_variance=0.3, semantic_discount=0.7, outlier_floor=0.05, max_distance_m=2.0)
ROWS, PARTNERS = random_mixture(1, 60), random_mixture(2, 70)
POSE = random_pose(3)
FORMS = ("log", "sum")
SEEDS = st.integers(0, 10**6)


def all_pairs(rows=ROWS, partners=PARTNERS, T=POSE, scale=2.0, config=DOUBLE, alignment=SETTINGS, k=None, form="log"):
    """The package's pairs, by default every row with every partner; "sum" has no outlier floor."""
    rung = Rung(covariance_scale=scale, components=1000, neighbours=k or len(partners), steps=1)
    pairs = pair_up(to_device(rows, config), to_device(partners, config), T, rung, alignment)
    return without_floor(pairs) if form == "sum" else pairs


def hat(twist):
    """6 -> 4x4, differentiable."""
    v, w = twist[:3], twist[3:]
    zero = torch.zeros((), dtype=twist.dtype)
    return torch.stack(
        [
            torch.stack([zero, -w[2], w[1], v[0]]),
            torch.stack([w[2], zero, -w[0], v[1]]),
            torch.stack([-w[1], w[0], zero, v[2]]),
            torch.zeros(4, dtype=twist.dtype),
        ]
    )


class Dense:
    """The double sum over all pairs, in one (n, m) table."""

    def __init__(self, rows=ROWS, partners=PARTNERS, T=POSE, scale=2.0, alignment=SETTINGS):
        def tensor(values):
            return torch.tensor(np.asarray(values, np.float64))

        self.mu, self.y, self.T = tensor(rows.means), tensor(partners.means), tensor(T)
        self.S_row, self.S = scale * tensor(rows.covariances), scale * tensor(partners.covariances)
        self.weights = tensor(rows.weights) / rows.weights.sum()
        discount = np.where(rows.labels[:, None] == partners.labels[None], 1, alignment.semantic_discount)
        colour = ((tensor(rows.colours)[:, None] - tensor(partners.colours)[None]) ** 2).sum(-1)
        pair_weight = tensor(discount) * tensor(partners.weights)
        pair_weight = pair_weight * torch.exp(-0.5 * colour / (2 * alignment.colour_variance))
        distance = torch.cdist(self.moved(self.T), self.y)
        self.pair_weight = torch.where(distance <= alignment.max_distance_m, pair_weight, 0.0)
        perfect = tensor(partners.weights).mean() / torch.linalg.det(2 * self.S_row).sqrt()
        self.floor = alignment.outlier_floor * perfect

    def moved(self, T):
        return self.mu @ T[:3, :3].T + T[:3, 3]

    def pair_densities(self, means, S_row):
        d = means[:, None] - self.y[None]
        S = S_row[:, None] + self.S[None]
        D = (d * torch.linalg.solve(S, d[..., None])[..., 0]).sum(-1)
        return self.pair_weight * torch.linalg.det(S) ** -0.5 * torch.exp(-0.5 * D)

    def total(self, means, S_row, form):
        s = self.pair_densities(means, S_row).sum(1)
        if form == "log":
            return (self.weights * torch.log(1 + s / self.floor)).sum()
        return torch.log((self.weights * s).sum())

    def value(self, twist, form):
        """Objective at exp(twist) T."""
        T = torch.linalg.matrix_exp(hat(twist)) @ self.T
        R = T[:3, :3]
        return self.total(self.moved(T), R @ self.S_row @ R.T, form)

    def value_and_gradient(self, form):
        x = torch.zeros(6, dtype=torch.float64, requires_grad=True)
        value = self.value(x, form)
        return value.item(), torch.autograd.grad(value, x)[0].numpy()

    def linear_motion(self):
        """Row means as linear functions of the twist, and row covariances frozen at the pose."""
        mu = self.moved(self.T)
        zero = torch.zeros(6, dtype=torch.float64)
        J = torch.autograd.functional.jacobian(
            lambda x: mu @ torch.linalg.matrix_exp(hat(x))[:3, :3].T + torch.linalg.matrix_exp(hat(x))[:3, 3], zero
        )
        R = self.T[:3, :3]
        return lambda x: mu + J @ x, R @ self.S_row @ R.T


@pytest.mark.parametrize("form", FORMS)
def test_with_all_neighbours_it_is_the_double_sum(form):
    got = evaluate(all_pairs(form=form), POSE, form)
    value, gradient = Dense().value_and_gradient(form)
    assert got.value == pytest.approx(value, rel=1e-10)
    np.testing.assert_allclose(got.gradient, gradient, rtol=1e-9, atol=1e-10 * np.abs(gradient).max())


@pytest.mark.parametrize("form", FORMS)
@settings(max_examples=15)
@given(SEEDS)
def test_gradient_is_that_of_automatic_differentiation_for_any_mixtures_and_pose(form, seed):
    rows, partners, T = random_mixture(seed, 20), random_mixture(seed + 1, 30), random_pose(seed)
    got = evaluate(all_pairs(rows, partners, T, form=form), T, form)
    value, gradient = Dense(rows, partners, T).value_and_gradient(form)
    assert got.value == pytest.approx(value, rel=1e-9, abs=1e-12)
    np.testing.assert_allclose(got.gradient, gradient, rtol=1e-6, atol=1e-6 * np.abs(gradient).max())


@pytest.mark.parametrize("form", FORMS)
def test_gradient_is_that_of_central_differences(form):
    pairs, step = all_pairs(k=12, form=form), 1e-5
    numeric = [
        (evaluate(pairs, se3_exp(step * e) @ POSE, form).value - evaluate(pairs, se3_exp(-step * e) @ POSE, form).value)
        / (2 * step)
        for e in np.eye(6)
    ]
    gradient = evaluate(pairs, POSE, form).gradient
    np.testing.assert_allclose(gradient, numeric, rtol=1e-6, atol=1e-6 * np.abs(gradient).max())


@pytest.mark.parametrize("form", FORMS)
def test_information_is_the_curvature_of_the_surrogate_with_partners_held(form):
    """Expectation maximisation's lower bound: responsibilities and covariances frozen, motion linear."""
    dense = Dense()
    means, S_row = dense.linear_motion()
    zero = torch.zeros(6, dtype=torch.float64)
    g = dense.pair_densities(means(zero), S_row)
    s = g.sum(1)
    denominator = dense.floor + s if form == "log" else (dense.weights * s).sum()
    r = dense.weights[:, None] * g / (denominator[:, None] if form == "log" else denominator)
    inverse = torch.linalg.inv(S_row[:, None] + dense.S[None])

    def surrogate(x):
        d = means(x)[:, None] - dense.y[None]
        return -0.5 * (r * torch.einsum("nmi,nmij,nmj->nm", d, inverse, d)).sum()

    hessian = torch.autograd.functional.hessian(surrogate, zero).numpy()
    information = evaluate(all_pairs(form=form), POSE, form).information
    np.testing.assert_allclose(information, -hessian, rtol=1e-8, atol=1e-8 * np.abs(hessian).max())
    assert np.linalg.eigvalsh(information)[0] > 0


@pytest.mark.parametrize("form", FORMS)
def test_observed_information_is_the_curvature_with_partners_free(form):
    """Only the row covariances are frozen and the motion linear; of "sum" it is that of f, relative to f."""
    dense = Dense()
    means, S_row = dense.linear_motion()
    zero = torch.zeros(6, dtype=torch.float64)
    reference = dense.total(means(zero), S_row, form)

    def function(x):
        value = dense.total(means(x), S_row, form)
        return value if form == "log" else torch.exp(value - reference)

    hessian = torch.autograd.functional.hessian(function, zero).numpy()
    e = evaluate(all_pairs(form=form), POSE, form)
    np.testing.assert_allclose(e.observed, -hessian, rtol=1e-8, atol=1e-8 * np.abs(hessian).max())
    assert np.linalg.eigvalsh(e.information - e.observed)[0] > 0, "uncertain partners take information away"


def test_support_is_the_share_of_rows_that_have_partners():
    far = replace(ROWS, means=np.where(np.arange(60)[:, None] < 45, ROWS.means, ROWS.means + 50))
    pairs = all_pairs(far, far, np.eye(4), scale=0.1, alignment=replace(SETTINGS, outlier_floor=1e-6))
    lonely = replace(pairs, log_weights=pairs.log_weights.masked_fill(pairs.means[:, 0] > 20, -torch.inf))
    expected = far.weights[:45].sum() / far.weights.sum()
    assert evaluate(lonely, np.eye(4), "log").support == pytest.approx(expected, abs=1e-4)
    assert evaluate(pairs, np.eye(4), "log").support == pytest.approx(1, abs=1e-4)


@pytest.mark.parametrize("form", FORMS)
def test_float32_agrees_with_float64(form):
    double = evaluate(all_pairs(form=form), POSE, form)
    single = evaluate(all_pairs(config=Config(), form=form), POSE, form)
    assert single.value == pytest.approx(double.value, rel=1e-5)
    for name in ("gradient", "information", "observed"):
        a, b = getattr(single, name), getattr(double, name)
        assert np.abs(a - b).max() < 3e-5 * np.abs(b).max(), name
    assert single.value != double.value, "or float32 was not used"


@pytest.mark.parametrize("ratio", [10, 100, 1000])
def test_long_thin_components_survive_float32(ratio):
    """Rays of monocular depth at full resolution: hundreds of times longer than their footprint is wide."""
    rays = ROWS.means / np.linalg.norm(ROWS.means, axis=1, keepdims=True)
    rows = replace(ROWS, covariances=0.01 * (np.eye(3) / ratio**2 + rays[:, :, None] * rays[:, None, :]))
    single, double = (
        evaluate(all_pairs(rows, rows, np.eye(4), scale=1.0, config=config), np.eye(4), "log")
        for config in (Config(), DOUBLE)
    )
    assert single.value == pytest.approx(double.value, rel=1e-3)
    np.testing.assert_allclose(single.information, double.information, atol=1e-3 * np.abs(double.information).max())
    assert np.isfinite(single.gradient).all()


@pytest.mark.parametrize("form", FORMS)
@settings(max_examples=15)
@given(SEEDS)
def test_order_of_components_does_not_matter(form, seed):
    plain = evaluate(all_pairs(k=9, form=form), POSE, form)
    mixed = evaluate(all_pairs(permuted(ROWS, seed), permuted(PARTNERS, seed + 1), k=9, form=form), POSE, form)
    assert_same(mixed, plain, 1e-10)


def assert_same(a, b, tolerance):
    assert a.value == pytest.approx(b.value, rel=tolerance)
    assert a.support == pytest.approx(b.support, rel=tolerance)
    for name in ("gradient", "information", "observed"):
        x, y = getattr(a, name), getattr(b, name)
        assert np.abs(x - y).max() <= tolerance * np.abs(y).max(), name


@pytest.mark.parametrize("form", FORMS)
@pytest.mark.parametrize("chunk", [1, 7, 100, 1 << 22])
def test_size_of_the_chunks_does_not_matter(form, chunk, monkeypatch):
    pairs = all_pairs(k=9, form=form)
    plain = evaluate(pairs, POSE, form)
    monkeypatch.setattr("garps_core.objective.plain.CHUNK_PAIRS", chunk)
    assert_same(evaluate(pairs, POSE, form), plain, 1e-10)


@pytest.mark.parametrize("form", FORMS)
@settings(max_examples=15)
@given(SEEDS)
def test_moving_both_frames_moves_the_pose(form, seed):
    """Rows seen from A, partners from B: the pose becomes B T A^-1, the value stays, the twist goes through Ad(B)."""
    A, B = random_pose(seed, 1.0), random_pose(seed + 1, 1.0)
    there = B @ POSE @ se3_inverse(A)
    plain = evaluate(all_pairs(k=9, form=form), POSE, form)
    other = evaluate(all_pairs(moved(ROWS, A), moved(PARTNERS, B), there, k=9, form=form), there, form)
    Ad = adjoint(B)
    assert other.value == pytest.approx(plain.value, rel=1e-8)
    np.testing.assert_allclose(Ad.T @ other.gradient, plain.gradient, atol=1e-8 * np.abs(plain.gradient).max())
    for name in ("information", "observed"):
        x, y = Ad.T @ getattr(other, name) @ Ad, getattr(plain, name)
        assert np.abs(x - y).max() < 1e-8 * np.abs(y).max(), name


def test_swapping_the_views_inverts_the_pose():
    back = se3_inverse(POSE)
    forward, backward = all_pairs(k=9), all_pairs(PARTNERS, ROWS, back, k=9)
    e, swapped = two_way(forward, backward, State(POSE), INLINE), two_way(backward, forward, State(back), INLINE)
    A = -adjoint(back)  # the left twist of T^-1 that a left twist of T makes
    assert swapped.value == pytest.approx(e.value, rel=1e-12)
    np.testing.assert_allclose(A.T @ swapped.gradient, e.gradient, atol=1e-12 * np.abs(e.gradient).max())
    for name in ("information", "observed"):
        x, y = A.T @ getattr(swapped, name) @ A, getattr(e, name)
        assert np.abs(x - y).max() < 1e-12 * np.abs(y).max(), name


def test_gradient_of_both_directions_is_that_of_central_differences():
    forward, backward = all_pairs(k=9), all_pairs(PARTNERS, ROWS, se3_inverse(POSE), k=9)

    def value(twist):
        return two_way(forward, backward, State(se3_exp(twist) @ POSE), INLINE).value

    numeric = [(value(1e-5 * e) - value(-1e-5 * e)) / 2e-5 for e in np.eye(6)]
    gradient = two_way(forward, backward, State(POSE), INLINE).gradient
    np.testing.assert_allclose(gradient, numeric, atol=1e-6 * np.abs(gradient).max())


def test_pairs_with_other_labels_count_by_the_discount():
    same, other = replace(ROWS, labels=np.zeros(60, int)), replace(PARTNERS, labels=np.ones(70, int))
    agree = evaluate(all_pairs(same, replace(PARTNERS, labels=np.zeros(70, int)), form="sum"), POSE, "sum")
    differ = evaluate(all_pairs(same, other, form="sum"), POSE, "sum")
    unknown = evaluate(all_pairs(replace(ROWS, labels=None), other, form="sum"), POSE, "sum")
    assert np.exp(differ.value - agree.value) == pytest.approx(SETTINGS.semantic_discount, rel=1e-12)
    assert unknown.value == pytest.approx(agree.value, rel=1e-12)


def test_partners_beyond_the_largest_distance_do_not_count():
    reach = replace(SETTINGS, max_distance_m=0.8)
    cut = evaluate(all_pairs(alignment=reach), POSE, "log")
    assert cut.value == pytest.approx(Dense(alignment=reach).value_and_gradient("log")[0], rel=1e-10)
    assert cut.value < 0.99 * evaluate(all_pairs(), POSE, "log").value


@pytest.mark.parametrize("form", FORMS)
def test_masked_partners_have_no_effect(form):
    pairs = all_pairs(k=9, form=form)
    mask = torch.zeros_like(pairs.log_weights, dtype=torch.bool)
    mask[4:] = True
    masked = replace(pairs, log_weights=pairs.log_weights.masked_fill(mask, -torch.inf))
    elsewhere = pairs.partner_means + 30 * mask
    gone = replace(
        pairs,
        partner_means=pairs.partner_means[:, :4].contiguous(),
        partner_covariances=pairs.partner_covariances[:, :4].contiguous(),
        log_weights=pairs.log_weights[:4].contiguous(),
    )
    assert_same(evaluate(masked, POSE, form), evaluate(gone, POSE, form), 1e-12)
    assert_same(evaluate(replace(masked, partner_means=elsewhere), POSE, form), evaluate(gone, POSE, form), 1e-12)


def test_nearest_neighbours_are_the_nearest():
    pairs = all_pairs(k=5)
    moved_rows = ROWS.means @ POSE[:3, :3].T + POSE[:3, 3]
    distance = np.linalg.norm(moved_rows[:, None] - PARTNERS.means[None], axis=-1)
    expected = PARTNERS.means[np.argsort(distance, axis=1)[:, :5]]
    np.testing.assert_allclose(pairs.partner_means.permute(2, 1, 0).numpy(), expected, atol=1e-15)


@pytest.mark.parametrize("form", FORMS)
def test_scale_of_the_weights_does_not_matter(form):
    heavy = replace(ROWS, weights=1000 * ROWS.weights)
    plain = evaluate(all_pairs(form=form), POSE, form)
    assert_same(evaluate(all_pairs(heavy, form=form), POSE, form), plain, 1e-12)
    if form == "log":  # the outlier density follows the partners' weights
        partners = replace(PARTNERS, weights=1000 * PARTNERS.weights)
        assert_same(evaluate(all_pairs(partners=partners), POSE, form), plain, 1e-12)
