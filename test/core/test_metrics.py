# SPDX-License-Identifier: Apache-2.0
"""Pose metrics against cases worked out by hand."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from scipy.stats import chi2

from garps_core import metrics
from garps_core.geometry import se3_exp


def pose(rotvec_deg=(0, 0, 0), t=(0, 0, 0)):
    T = np.eye(4)
    T[:3, :3] = Rotation.from_rotvec(rotvec_deg, degrees=True).as_matrix()
    T[:3, 3] = t
    return T


@pytest.mark.parametrize("angle", [0.0, 1e-6, 1.0, 90.0, 179.0, 180.0])
def test_rotation_error_is_the_angle(angle):
    a = pose((10, -20, 30))
    b = pose(np.array([2, -1, 2]) / 3 * angle) @ a
    assert metrics.rotation_error_deg(b, a) == pytest.approx(angle, rel=1e-7, abs=1e-9)


def test_translation_error_is_the_distance():
    assert metrics.translation_error_m(pose(t=(1, 2, 3)), pose((0, 0, 50), t=(1, -2, 6))) == pytest.approx(5)


def test_error_3d_equals_translation_error_without_rotation():
    points = np.random.default_rng(0).normal(size=(50, 3))
    assert metrics.error_3d_m(pose((9, 0, 0), (0.3, 0, 0)), pose((9, 0, 0), (0, 0.4, 0)), points) == pytest.approx(0.5)


def test_error_3d_of_a_quarter_turn():
    # Turned by 90 deg about z, (1,0,0) lands on (0,1,0), sqrt 2 away; a point on the axis stays.
    points = [(1, 0, 0), (0, 0, 5)]
    assert metrics.error_3d_m(pose((0, 0, 90)), pose(), points) == pytest.approx(np.sqrt(2) / 2)
    assert np.isnan(metrics.error_3d_m(pose(), pose(), np.zeros((0, 3))))


def test_direction_error_and_scale_ratio():
    estimate, truth = pose(t=(0, 2, 0)), pose((5, 5, 5), t=(0.5, 0, 0))
    assert metrics.direction_error_deg(estimate, truth) == pytest.approx(90)
    assert metrics.direction_error_deg(pose(t=(-1, 0, 0)), truth) == pytest.approx(180)
    assert metrics.scale_ratio(estimate, truth) == pytest.approx(4)
    assert np.isnan(metrics.direction_error_deg(pose(), truth))
    assert np.isnan(metrics.scale_ratio(estimate, pose()))


def test_nees_of_uncorrelated_errors():
    truth, estimate = pose((0, 0, np.degrees(0.02)), (0.1, 0.2, 0)), pose(t=(0.1, 0, 0))
    covariance = np.diag([1, 0.01, 1, 1, 1, 1e-4])
    # 0.2 m is two sigmas in y, 0.02 rad two sigmas about z.
    assert metrics.nees(estimate, covariance, truth) == pytest.approx(8)


def test_pose_error_turns_about_the_target_axes():
    # The estimate looks along another direction; a turn about the target's Z axis stays a turn about Z.
    estimate = pose((0, 90, 0), (1, 2, 3))
    truth = pose((0, 0, 1)) @ estimate
    truth[:3, 3] = (1.5, 2, 3)
    expected = [0.5, 0, 0, 0, 0, np.radians(1)]
    np.testing.assert_allclose(metrics.pose_error(estimate, truth), expected, atol=1e-12)


def test_metrics_do_not_change_with_the_target_frame():
    rng = np.random.default_rng(1)
    estimate, truth, move = (se3_exp(rng.normal(size=6)) for _ in range(3))
    points = rng.normal(size=(20, 3))
    for metric, extra in ((metrics.rotation_error_deg, ()), (metrics.error_3d_m, (points,))):
        assert metric(move @ estimate, move @ truth, *extra) == pytest.approx(metric(estimate, truth, *extra))
    A = rng.normal(size=(6, 6))
    C, turn = A @ A.T + np.eye(6), pose((20, 30, -40))
    M = np.kron(np.eye(2), turn[:3, :3])
    expected = metrics.nees(estimate, C, truth)
    assert metrics.nees(turn @ estimate, M @ C @ M.T, turn @ truth) == pytest.approx(expected)


def test_honest_covariance_gives_95_per_cent():
    assert chi2.ppf(0.95, 6) == pytest.approx(metrics.CHI2_6_95)
    rng = np.random.default_rng(2)
    A = rng.normal(size=(6, 6))
    C = (A @ A.T + 0.1 * np.eye(6)) * 1e-6
    estimate, inside, values = se3_exp(rng.normal(size=6)), 0, []
    for error in rng.multivariate_normal(np.zeros(6), C, size=2000):
        truth = estimate.copy()
        truth[:3, 3] += error[:3]
        truth[:3, :3] = Rotation.from_rotvec(error[3:]).as_matrix() @ estimate[:3, :3]
        values.append(metrics.nees(estimate, C, truth))
        inside += values[-1] < metrics.CHI2_6_95
    assert inside / 2000 == pytest.approx(0.95, abs=0.015)
    assert np.mean(values) == pytest.approx(6, abs=0.3)
