# SPDX-License-Identifier: Apache-2.0
"""The preset "paper" is the published method: its numbers, its objective and every step of its optimiser.

The reference, `bench.peers.autograd`, is written from the paper's eq. 5 with automatic differentiation and torch's
Adam, its candidate pairs here from section 3.2; it shares no code with the package.
"""

from dataclasses import replace

import numpy as np
import pytest
import torch
from surfaces import FREE, TRUTH, disturbed, off, random_pose, two_mixtures

from bench.peers.autograd import PlainObjective, rotation
from garps_core import Config, Mixture, Prior, Status, align_mixtures
from garps_core.geometry import se3_inverse, transform
from garps_core.objective.pairs import to_device
from garps_core.solver import paper

STEPS = 25
PAPER = Config.preset("paper").replace({"dtype": "float64"})
START = random_pose(4, 0.05)


def opaque_mixture(seed, count=4500):
    """Components as a network gives them: opacities 0..1 (about three quarters above a half), 20 classes."""
    rng = np.random.default_rng(seed)
    A = rng.normal(size=(count, 3, 3)) * 0.02
    return Mixture(
        rng.uniform((-2, -1.5, 1), (2, 1.5, 6), (count, 3)),
        A @ A.transpose(0, 2, 1) + 1e-4 * np.eye(3),
        np.sqrt(rng.uniform(0, 1, count)),
        rng.uniform(0, 1, (count, 3)),
        rng.integers(0, 20, count),
    )


SOURCE, TARGET = opaque_mixture(1), opaque_mixture(2)


def quaternion(R):
    """3x3 with a positive trace -> (w, x, y, z)."""
    w = np.sqrt(1 + np.trace(R)) / 2
    vector = np.array([R[2, 1] - R[1, 2], R[0, 2] - R[2, 0], R[1, 0] - R[0, 1]]) / (4 * w)
    return torch.tensor([w, *vector], dtype=torch.float64)


def matrix(q, t):
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = rotation(q).detach().numpy(), t.detach().numpy()
    return T


class Published:
    """Eq. 5 over the candidate pairs of section 3.2: opacity, stride, nearest neighbours, distance."""

    def __init__(self, source, target, T, neighbours=30):
        mu_x, S_x, phi_x, c_x, l_x = self._salient(source)
        mu_y, S_y, phi_y, c_y, l_y = self._salient(target)
        distance = np.linalg.norm(transform(T, mu_x)[:, None] - mu_y[None], axis=-1)
        nearest = np.argsort(distance, axis=1)[:, :neighbours]
        i, j = np.repeat(np.arange(len(mu_x)), nearest.shape[1]), nearest.ravel()
        near = distance[i, j] <= 2.5
        i, j = i[near], j[near]
        colour = ((c_x[i] - c_y[j]) ** 2 / (0.4 + 0.4)).sum(1)
        weight = np.where(l_x[i] == l_y[j], 1, 0.92) * phi_x[i] * phi_y[j] * np.exp(-0.5 * colour)
        parts = (mu_x[i], 90 * S_x[i], mu_y[j], 90 * S_y[j], weight)
        self.objective = PlainObjective(*(torch.tensor(part) for part in parts))
        self.pairs = len(i)

    @staticmethod
    def _salient(mixture):
        kept = np.flatnonzero(mixture.weights >= 0.5)[::32]
        phi = mixture.weights[kept] / np.abs(mixture.weights[kept]).sum()
        return mixture.means[kept], mixture.covariances[kept], phi, mixture.colours[kept], mixture.labels[kept]

    def value(self, q, t):
        return self.objective.value(q, t)

    def path(self, T, steps):
        """Poses and values of f on the way."""
        visited = self.objective.path(quaternion(T[:3, :3]), torch.tensor(T[:3, 3]), steps)
        return [matrix(q, t) for q, t in visited], [self.value(q, t).item() for q, t in visited]


@pytest.fixture(scope="module")
def published():
    return Published(SOURCE, TARGET, START)


@pytest.fixture(scope="module")
def pairs():
    return paper.paper_pairs(to_device(SOURCE, PAPER), to_device(TARGET, PAPER), START, PAPER.paper)


def test_the_numbers_are_the_published_ones():
    settings = PAPER.paper
    assert (settings.semantic_discount, settings.covariance_scale, settings.colour_variance) == (0.92, 90, 0.4)
    assert (settings.opacity_threshold, settings.component_stride) == (0.5, 32)
    assert (settings.neighbours, settings.max_distance_m) == (30, 2.5)
    assert (settings.rate_translation, settings.rate_rotation, settings.steps) == (9e-5, 3e-6, 1000)
    assert PAPER.method == "paper" and PAPER.lifting.weighting == "equal"


def test_candidate_pairs_are_the_published_ones(pairs, published):
    kept = int(torch.isfinite(pairs.log_weights).sum())
    assert kept == published.pairs
    assert 0 < kept < 30 * len(pairs.means), "or the distance cut was not tried"


@pytest.mark.parametrize("seed", range(3))
def test_value_and_gradient_are_those_of_the_published_objective(seed, pairs, published):
    """Also at quaternions that are not of unit length: Adam does not keep them so."""
    rng = np.random.default_rng(seed)
    q = (quaternion(START[:3, :3]) * rng.uniform(0.5, 2) + torch.tensor(0.02 * rng.normal(size=4))).requires_grad_()
    t = torch.tensor(START[:3, 3] + 0.02 * rng.normal(size=3)).requires_grad_()
    f = published.value(q, t)
    dq, dt = torch.autograd.grad(f, (q, t))
    got_f, got_dq, got_dt = paper.value_and_gradient(pairs, q.detach().numpy(), t.detach().numpy())
    assert got_f == pytest.approx(f.item(), rel=1e-11)
    np.testing.assert_allclose(got_dq, dq, atol=1e-10 * float(dq.abs().max()))
    np.testing.assert_allclose(got_dt, dt, atol=1e-10 * float(dt.abs().max()))


def test_every_step_is_that_of_adam_on_the_published_objective(pairs, published):
    expected, values = published.path(START, STEPS)
    got = paper.adam_path(pairs, START, PAPER.paper, STEPS)
    assert len(got) == STEPS + 1
    for step, (a, b) in enumerate(zip(got, expected, strict=True)):
        np.testing.assert_allclose(a, b, rtol=0, atol=1e-10, err_msg=f"step {step}")
    assert np.linalg.norm(expected[-1][:3, 3] - START[:3, 3]) > 5e-4, "or nothing moved"
    assert (np.diff(values) > 0).all()


def test_the_whole_estimate_ends_where_the_reference_does(published):
    estimate = align_mixtures(SOURCE, TARGET, Prior(START, FREE), PAPER.replace({"paper.steps": STEPS}))
    expected, values = published.path(START, STEPS)
    np.testing.assert_allclose(estimate.T_target_source, expected[-1], rtol=0, atol=1e-10)
    assert np.exp(estimate.objective) == pytest.approx(values[-1], rel=1e-10)
    assert estimate.iterations == STEPS


def aligned(twist):
    """The paper's estimate of two views of the wavy surface, from a start that is off by a twist."""
    config = Config.preset("paper").replace({"paper.component_stride": 4, "paper.steps": 100})
    start = disturbed(twist=np.asarray(twist), covariance=FREE)
    return align_mixtures(*two_mixtures(config=config), start, config)


def test_a_good_start_gives_a_converged_pose():
    estimate = aligned([0.01, -0.01, 0.01, 0.002, -0.002, 0.002])
    assert estimate.ok and off(estimate.T_target_source, TRUTH)[0] < 0.03
    assert "the paper's fixed number of steps, 100" in estimate.reason


@pytest.mark.parametrize("twist", [[0, 0, 0.2, 0, 0, 0], [0.2, 0, 0, 0, 0, 0], [0.2, 0.1, 0, 0.02, -0.06, 0]])
def test_a_wrong_start_gives_no_converged_pose(twist):
    """Adam moves by centimetres, so the pose is as wrong as the start."""
    estimate = aligned(twist)
    assert off(estimate.T_target_source, TRUTH)[0] > 0.1
    assert estimate.status is Status.POOR_FIT and "of the components found a partner" in estimate.reason


def test_a_wrong_start_with_small_sigmas_is_inconsistent_once_the_pose_moves_away():
    config = Config.preset("paper").replace({"paper.component_stride": 4, "paper.steps": 100})
    start = disturbed(twist=np.array([0.05, 0, 0.05, 0, 0, 0]), covariance=1e-4 * FREE)
    estimate = align_mixtures(*two_mixtures(config=config), start, config)
    assert estimate.status is Status.INCONSISTENT and "sigmas away from the start" in estimate.reason


def test_views_that_share_little_have_no_pose():
    estimate = aligned([0, 0, 0, 0, 1.5, 0])
    assert estimate.status is Status.LOW_OVERLAP and estimate.T_target_source is None


def test_only_its_own_settings_count():
    """The ladder and the pairing of the default method have no effect on the published one."""
    changed = {"alignment.ladder": Config().alignment.ladder[:1], "alignment.colour_variance": 100.0}
    short = PAPER.replace({"paper.steps": 3})
    one, other = (align_mixtures(SOURCE, TARGET, Prior(START, FREE), c) for c in (short, short.replace(changed)))
    assert one.T_target_source.tobytes() == other.T_target_source.tobytes()


def test_neighbours_leave_out_only_what_is_small(published):
    """The sparse sum is the double sum less the pairs left out, all of them far in terms of their distance."""
    full = Published(SOURCE, TARGET, START, neighbours=10_000)
    q, t = quaternion(START[:3, :3]), torch.tensor(START[:3, 3])
    sparse_f, full_f = published.value(q, t).item(), full.value(q, t).item()
    assert full.pairs > 1.5 * published.pairs
    assert 0.9 * full_f < sparse_f < full_f


def test_the_threshold_counts_before_the_stride():
    chosen = paper.salient(to_device(SOURCE, PAPER), PAPER.paper)
    kept = np.flatnonzero(SOURCE.weights >= 0.5)[::32]
    np.testing.assert_array_equal(chosen.means.numpy(), SOURCE.means[kept])
    assert chosen.weights.sum().item() == pytest.approx(1)


def test_too_few_salient_components_are_no_pose_and_say_so():
    faint = replace(SOURCE, weights=SOURCE.weights * 0.5)
    estimate = align_mixtures(faint, TARGET, Prior(START, FREE), PAPER)
    assert estimate.status is Status.LOW_OVERLAP and estimate.T_target_source is None
    assert "fewer than 50 components" in estimate.reason


def test_without_labels_every_pair_counts_in_full(pairs):
    plain = [to_device(replace(mixture, labels=None), PAPER) for mixture in (SOURCE, TARGET)]
    more = paper.paper_pairs(*plain, START, PAPER.paper)
    gain = (more.log_weights - pairs.log_weights)[torch.isfinite(pairs.log_weights)].numpy()
    same = np.abs(gain) < 1e-12
    np.testing.assert_allclose(gain[~same], -np.log(0.92), atol=1e-12)
    assert 0 < same.sum() < 0.2 * len(gain)


def test_the_start_is_where_the_path_starts(pairs):
    np.testing.assert_allclose(paper.adam_path(pairs, START, PAPER.paper, 0)[0], START)
    back = se3_inverse(START)
    assert not np.allclose(paper.adam_path(pairs, back, PAPER.paper, 1)[1], START)
