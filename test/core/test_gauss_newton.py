# SPDX-License-Identifier: Apache-2.0
"""The three refinements of a pose: zero at the truth, derivatives against differences, and a cost that falls."""

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from itertools import pairwise

import numpy as np
import pytest
from made_matches import CAMERA, exact_matches
from surfaces import TRUTH, look

from garps_core.config.lifting import Lifting
from garps_core.gauss_newton import Linearise, gauss_newton
from garps_core.geometry import point_jacobian, project, se3_exp, se3_inverse, transform
from garps_core.mixtures.frustum import frustum_of, in_range
from garps_core.objective.brightness import _compared, _overlaid, comparisons, grid_of, summed
from garps_core.start.match_pose import TwoWayReprojection
from garps_core.start.point_map_pose import OneWayReprojection
from garps_core.start.reprojection import OneWay, reprojected

EXACT = Lifting(noise_floor_m=0.0, noise_linear=0.0)
"""Depth without noise, so that the weights of reprojection errors are those of the pixels alone."""
NEAR = se3_exp(np.array([0.004, -0.003, 0.002, 0.002, -0.001, 0.003]))
"""A pose error of some millimetres and milliradians."""


@dataclass
class Refinement:
    """Normal equations of a refinement with fixed weights, and its cost by an independent formula."""

    linearise: Linearise
    cost: Callable[[np.ndarray], float]
    truth: np.ndarray
    zero: float
    """Largest gradient at the truth, as a share of that at `NEAR`."""
    tolerance: float
    """Relative error of the gradient against differences; brightness is sampled from pixels."""


def reprojection_cost(ways: list[tuple[OneWay, bool]], T: np.ndarray) -> float:
    total = 0.0
    for way, inverse in ways:
        moved = transform(se3_inverse(T) if inverse else T, way.points)
        total += 0.5 * float(np.square(project(way.K, moved) - way.px).sum())
    return total


def of_one_pixel_noise(equations: OneWayReprojection | TwoWayReprojection) -> Linearise:
    def linearise(T: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        equations.pixel_sigma = 1.0
        return equations(T)

    return linearise


def one_way() -> Refinement:
    matches = exact_matches()
    way = OneWay(matches.source_points, matches.target_px, CAMERA)
    cost = partial(reprojection_cost, [(way, False)])
    return Refinement(of_one_pixel_noise(OneWayReprojection(way, EXACT)), cost, TRUTH, 1e-9, 1e-6)


def two_ways() -> Refinement:
    matches = exact_matches()
    forward = OneWay(matches.source_points, matches.target_px, CAMERA)
    backward = OneWay(matches.target_points, matches.source_px, CAMERA)
    cost = partial(reprojection_cost, [(forward, False), (backward, True)])
    return Refinement(of_one_pixel_noise(TwoWayReprojection(forward, backward, EXACT)), cost, TRUTH, 1e-9, 1e-6)


def brightness() -> Refinement:
    """One view against itself: what it sees is equally bright under no motion at all."""
    view = look()
    assert view.depth is not None
    grid = grid_of(frustum_of(view, in_range(view.depth, Lifting()), Lifting()), 1)

    def linearise(T: np.ndarray) -> tuple[np.ndarray, np.ndarray] | None:
        both = comparisons(grid, grid, T)
        if both is None:
            return None
        H, score = summed(*both, T)
        return H, -score

    def mean_cost(T: np.ndarray) -> float:
        """Mean square of the residuals of both directions after the best gain and offset."""
        total = 0.0
        for pose in (T, se3_inverse(T)):
            overlay = _overlaid(grid, grid, pose)
            exposure = np.stack([overlay.own, np.ones_like(overlay.own)], axis=1)
            error = overlay.theirs - exposure @ np.linalg.lstsq(exposure, overlay.theirs, rcond=None)[0]
            total += float(np.square(error).mean())
        return total

    return Refinement(linearise, mean_cost, np.eye(4), 0.05, float("nan"))


REFINEMENTS = {"point maps": one_way, "matches": two_ways, "brightness": brightness}


@pytest.fixture(params=REFINEMENTS)
def refinement(request: pytest.FixtureRequest) -> Refinement:
    return REFINEMENTS[request.param]()


def test_residual_and_gradient_are_zero_at_the_truth(refinement: Refinement) -> None:
    (_, at_truth), (_, near) = refinement.linearise(refinement.truth), refinement.linearise(NEAR @ refinement.truth)
    assert refinement.cost(refinement.truth) < 1e-12 * max(1.0, refinement.cost(NEAR @ refinement.truth))
    assert np.linalg.norm(at_truth) < refinement.zero * np.linalg.norm(near)


@pytest.mark.parametrize("name", ["point maps", "matches"])
def test_the_gradient_is_that_of_the_cost(name: str) -> None:
    """Below two sigmas the robust loss is the square, so the cost has no weights that could change with the pose."""
    refinement, size = REFINEMENTS[name](), 1e-6
    T = se3_exp(np.array([0.002, 0.001, -0.002, 0.0005, -0.001, 0.0005])) @ refinement.truth
    H, g = refinement.linearise(T)
    numeric = [
        (refinement.cost(se3_exp(size * e) @ T) - refinement.cost(se3_exp(-size * e) @ T)) / (2 * size)
        for e in np.eye(6)
    ]
    np.testing.assert_allclose(g, numeric, rtol=refinement.tolerance, atol=1e-6 * np.abs(numeric).max())
    assert np.linalg.eigvalsh(H).min() > 0


def test_the_jacobian_of_reprojection_is_that_of_differences() -> None:
    matches, size = exact_matches(), 1e-6
    way = OneWay(matches.source_points, matches.target_px, CAMERA)
    none = np.zeros(len(way.points))
    at = reprojected(way, TRUTH, 1.0, none)
    J = at.by_point @ point_jacobian(at.moved)
    for k, e in enumerate(np.eye(6)):
        ahead, behind = (reprojected(way, se3_exp(s * size * e) @ TRUTH, 1.0, none).residual for s in (1, -1))
        np.testing.assert_allclose(J[:, :, k], (ahead - behind) / (2 * size), rtol=1e-6, atol=1e-5)


def test_the_hessian_of_brightness_is_positive_and_its_own_jacobian_predicts_the_residuals() -> None:
    """J x of the normal equations: H x is the change of the gradient, to first order, where weights hardly change."""
    view, size = look(), 2e-4
    grid = grid_of(frustum_of(view, in_range(view.depth, Lifting()), Lifting()), 1)
    at = _compared(grid, grid, np.eye(4))
    assert np.linalg.eigvalsh(at.information).min() > 0
    for e in np.eye(6):
        ahead = _compared(grid, grid, se3_exp(size * e))
        change = -ahead.gradient / size
        cosine = change @ (at.information @ e) / np.linalg.norm(change) / np.linalg.norm(at.information @ e)
        assert cosine > 0.9


def test_the_cost_falls_with_every_step(refinement: Refinement) -> None:
    T = NEAR @ refinement.truth
    costs = [refinement.cost(T)]
    for _ in range(4):
        T = gauss_newton(T, refinement.linearise, 1)
        costs.append(refinement.cost(T))
    floor = 1e-10 * costs[0]
    assert all(after < before or before < floor for before, after in pairwise(costs)), costs
    assert costs[-1] < 1e-2 * costs[0]


def test_it_stops_where_nothing_can_be_compared() -> None:
    asked: list[np.ndarray] = []
    assert gauss_newton(TRUTH, lambda T: asked.append(T), 5) is TRUTH and len(asked) == 1


def test_a_quadratic_cost_takes_one_step() -> None:
    """Twists about the start: g = H (x - x0) has its minimum at x0."""
    x0, H = np.array([0.1, -0.2, 0.3, 0.0, 0.0, 0.0]), np.diag(np.arange(1.0, 7.0))
    T = gauss_newton(np.eye(4), lambda T: (H, H @ (np.concatenate([T[:3, 3], np.zeros(3)]) - x0)), 1)
    np.testing.assert_allclose(T[:3, 3], x0[:3], atol=1e-15)
