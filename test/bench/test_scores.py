# SPDX-License-Identifier: Apache-2.0
"""Every benchmark score against cases worked out by hand and against its definition written in another way."""

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from bench.rows.pose_errors import camera_error_m, vcre_px
from bench.scoring.scores import VCRE_PX, auc, mean_average_accuracy, pose_error_deg, precision_auc
from garps_core import metrics
from garps_core.geometry import se3_exp

INF, NAN = float("inf"), float("nan")
WIDTH, HEIGHT = 540, 720
K = np.array([[590.0, 0, 268], [0, 592, 355], [0, 0, 1]])
K_WIDE = np.array([[500.0, 0, 5000], [0, 500, 5000], [0, 0, 1]])
WIDE = 10_000
"""An image so wide that nothing is clipped."""
DEPTHS = [1.8 + 0.3 * k for k in range(7)]


def pose(rotvec_deg: Sequence[float] = (0, 0, 0), t: Sequence[float] = (0, 0, 0)) -> np.ndarray:
    T = np.eye(4)
    T[:3, :3] = Rotation.from_rotvec(rotvec_deg, degrees=True).as_matrix()
    T[:3, 3] = t
    return T


def random_poses(seed: int, count: int, spread: float = 1.0) -> list[np.ndarray]:
    return [se3_exp(twist) for twist in np.random.default_rng(seed).normal(0, spread, (count, 6))]


def random_errors(seed: int, ties: bool = True) -> list[float]:
    """Some dozen errors, a part of them infinite; with ties they are whole, so some are just a threshold."""
    rng = np.random.default_rng(seed)
    n = int(rng.integers(1, 40))
    errors = rng.integers(0, 35, n).astype(float) if ties else rng.uniform(0, 35, n)
    return [float(error) for error in np.where(rng.random(n) < 0.2, INF, errors)]


# --- AUC


def auc_by_segments(errors: Sequence[float], threshold: float) -> float:
    """The area trapezoid by trapezoid, from error to error, then the rectangle up to the threshold."""
    area, left, recall = 0.0, 0.0, 0.0
    for k, error in enumerate(sorted(errors), 1):
        if error >= threshold:
            break
        area += (error - left) * (recall + k / len(errors)) / 2
        left, recall = error, k / len(errors)
    return (area + (threshold - left) * recall) / threshold


@pytest.mark.parametrize(
    ("errors", "threshold", "expected"),
    [
        # Recall 0 -> 1/3 on [0, 1], 1/3 -> 2/3 on [1, 2], 2/3 on [2, 5]: 1/6 + 1/2 + 2 = 8/3, over 5.
        ([1, 2, INF], 5, 8 / 15),
        ([INF, 2, 1], 5, 8 / 15),
        # Both at once: recall 0 -> 1/2 on [0, 4], then a step to 1 that lasts to 10: 1 + 6, over 10.
        ([4, 4], 10, 0.7),
        # An error of just the threshold is not below it: 0 -> 1/2 on [0, 1], 1/2 on [1, 5].
        ([1, 5], 5, 2.25 / 5),
        ([5], 5, 0),
        ([INF, INF], 5, 0),
        ([0, 0, 0], 5, 1),
        ([0, INF], 5, 0.5),
    ],
)
def test_auc_of_a_few_errors(errors: list[float], threshold: float, expected: float) -> None:
    assert auc(errors, [threshold]) == (pytest.approx(expected),)


def test_auc_without_errors_is_not_a_number() -> None:
    found = auc([], [5, 10])
    assert len(found) == 2 and np.isnan(found).all()


@pytest.mark.parametrize("seed", range(50))
def test_auc_is_the_sum_of_trapezoids(seed: int) -> None:
    errors = random_errors(seed)
    assert auc(errors) == pytest.approx([auc_by_segments(errors, threshold) for threshold in (5, 10, 20)])


@pytest.mark.parametrize("seed", range(10))
def test_auc_is_the_mean_height_of_the_recall_curve(seed: int) -> None:
    errors = np.sort(random_errors(seed, ties=False))
    for threshold, found in zip((3, 30), auc(errors, (3, 30)), strict=True):
        below = errors[errors < threshold]
        at = (np.arange(100_000) + 0.5) / 100_000 * threshold
        curve = np.interp(at, [0, *below], np.arange(len(below) + 1) / len(errors))  # constant after the last
        assert found == pytest.approx(curve.mean(), abs=1e-4)


# --- mAA


def test_mean_average_accuracy_of_a_few_errors() -> None:
    # Below k deg, k = 1..30: 0.5 in all 30, 1.0 from k = 2 on (29), 29.5 at 30 (1), and just 30 at the limit (1).
    assert mean_average_accuracy([0.5, 1.0, 29.5, 30, 31, INF]) == pytest.approx((30 + 29 + 1 + 1) / (30 * 6))
    assert mean_average_accuracy([0.0, 0.99]) == 1
    assert mean_average_accuracy([INF, 30.01]) == 0
    assert mean_average_accuracy([2.5], limit_deg=4) == pytest.approx(2 / 4)  # k = 3 and 4
    assert np.isnan(mean_average_accuracy([]))


@pytest.mark.parametrize("ties", [True, False])
def test_mean_average_accuracy_is_the_mean_share_below_whole_degrees(ties: bool) -> None:
    for seed in range(20):
        errors, total = random_errors(seed, ties), 0
        for k in range(1, 31):
            total += sum(error < k or error == k == 30 for error in errors)
        assert mean_average_accuracy(errors) == pytest.approx(total / (30 * len(errors)))


def test_mean_average_accuracy_is_not_the_auc() -> None:
    assert mean_average_accuracy([0.5]) == 1
    assert auc([0.5], [30]) == (pytest.approx((0.25 + 29.5) / 30),)


# --- the error of a pose in degrees


def angles(e_rot: float, e_dir: float, ratio: float = 1.0) -> dict[str, Any]:
    return {"found": True, "e_rot_deg": e_rot, "e_dir_deg": e_dir, "scale_ratio": ratio}


def test_the_pose_error_is_the_larger_angle_and_infinite_for_a_failure() -> None:
    assert pose_error_deg(angles(3, 7)) == 7
    assert pose_error_deg(angles(9, 7)) == 9
    assert pose_error_deg({"found": False, "e_rot_deg": INF}) == INF


@pytest.mark.parametrize(
    ("t_est", "t_true", "expected"),
    [
        ((1, 2, 3), (2, 4, 6), 4),  # the length does not count, the rotation of 4 deg does
        ((-1, -2, -3), (1, 2, 3), 180),
        ((0, 2, 0), (1, 0, 0), 90),
        ((1, 0, 0), (0, 0, 0), 4),  # no true direction
        ((0, 0, 0), (0, 0, 0), 4),
        ((0, 0, 0), (1, 0, 0), INF),  # no estimated direction
    ],
)
def test_the_pose_error_of_translations(t_est: tuple, t_true: tuple, expected: float) -> None:
    T_est, T_true = pose((0, 0, 4), t_est), pose(t=t_true)
    e_rot, e_dir = metrics.rotation_error_deg(T_est, T_true), metrics.direction_error_deg(T_est, T_true)
    assert pose_error_deg(angles(e_rot, e_dir, metrics.scale_ratio(T_est, T_true))) == pytest.approx(expected)


# --- the camera error


def test_the_camera_error_of_a_turn_that_keeps_the_translation() -> None:
    # c = -R^T t is (0, 1, 0) after the quarter turn about z and (-1, 0, 0) without it.
    assert camera_error_m(pose((0, 0, 90), (1, 0, 0)), pose(t=(1, 0, 0))) == pytest.approx(np.sqrt(2))
    # Turned about its own centre (0, 1, 0) a camera stays where it is, though its t moves by sqrt 2.
    T_est, T_true = pose((0, 0, 90), (1, 0, 0)), pose(t=(0, -1, 0))
    assert camera_error_m(T_est, T_true) == pytest.approx(0, abs=1e-15)
    assert metrics.translation_error_m(T_est, T_true) == pytest.approx(np.sqrt(2))


@pytest.mark.parametrize("seed", range(10))
def test_the_camera_error_is_the_distance_in_the_inverse_matrices(seed: int) -> None:
    T_est, T_true = random_poses(seed, 2)
    apart = np.linalg.inv(T_est)[:3, 3] - np.linalg.inv(T_true)[:3, 3]
    found = camera_error_m(T_est, T_true)
    assert found == pytest.approx(np.sqrt(np.sum(apart**2)))
    turned = 2 * np.sin(np.radians(metrics.rotation_error_deg(T_est, T_true)) / 2) * np.linalg.norm(T_true[:3, 3])
    assert abs(found - metrics.translation_error_m(T_est, T_true)) <= turned + 1e-12


# --- VCRE


def vcre_of_camera_to_world(T_est: np.ndarray, T_true: np.ndarray, K: np.ndarray, width: float, height: float) -> float:
    """Map-free's own formulation, point by point: C_est^-1 C_true X against X, with poses of camera to world."""
    C_est, C_true = np.linalg.inv(T_est), np.linalg.inv(T_true)
    D, total = np.linalg.inv(C_est) @ C_true, 0.0
    for i in range(7):
        for j in range(4):
            for z in DEPTHS:
                pixels = []
                for x, y, depth, _ in (X := np.array([0.3 * (i - 3), 0.3 * (j - 1.5), z, 1]), D @ X):
                    u, v = K[0, 0] * x / depth + K[0, 2], K[1, 1] * y / depth + K[1, 2]
                    pixels.append((min(max(u, 0), width), min(max(v, 0), height)))
                total += np.hypot(pixels[0][0] - pixels[1][0], pixels[0][1] - pixels[1][1])
    return total / (7 * 4 * 7)


@pytest.mark.parametrize("seed", range(3))
def test_vcre_of_the_truth_is_zero(seed: int) -> None:
    (T,) = random_poses(seed, 1)
    assert vcre_px(T, T, K, WIDTH, HEIGHT) == pytest.approx(0, abs=1e-9)


@pytest.mark.parametrize(
    ("error", "expected"),
    [
        # A shift of the camera's points by dx moves a pixel by f dx / z, whatever x and y are.
        (pose(t=(0.2, 0, 0)), np.mean([500 * 0.2 / z for z in DEPTHS])),
        (pose(t=(0.3, -0.4, 0)), np.mean([500 * 0.5 / z for z in DEPTHS])),
        # A half turn about the axis moves a pixel by twice its distance from the centre.
        (
            pose((0, 0, 180)),
            np.mean(
                [1000 * np.hypot(0.3 * i, 0.15 * j) / z for i in range(-3, 4) for j in (-3, -1, 1, 3) for z in DEPTHS]
            ),
        ),
        # A half turn about y puts (x, y, z) at (-x, y, -z), behind: over its depth x / z stays, y / z is mirrored,
        # and |y| is 0.15 or 0.45 m, 0.3 m in the mean.
        (pose((0, 180, 0)), np.mean([1000 * 0.3 / z for z in DEPTHS])),
    ],
)
def test_vcre_where_nothing_is_clipped(error: np.ndarray, expected: float) -> None:
    (T_true,) = random_poses(1, 1)
    assert vcre_px(error @ T_true, T_true, K_WIDE, WIDE, WIDE) == pytest.approx(expected)


@pytest.mark.parametrize("spread", [0.02, 0.2, 2.0])
def test_vcre_is_that_of_the_benchmark(spread: float) -> None:
    for seed in range(5):
        error, T_true = random_poses(seed, 1, spread)[0], random_poses(100 + seed, 1)[0]
        args = error @ T_true, T_true, K, WIDTH, HEIGHT
        assert vcre_px(*args) == pytest.approx(vcre_of_camera_to_world(*args))


def test_vcre_does_not_depend_on_the_source_frame_but_on_the_target_frame() -> None:
    T_est, T_true, M = pose((2, 1, 0), (0.1, 0, 0.2)), pose((0, 30, 0), (1, 0, 0)), pose((0, 20, 0), (0.5, 0, 0))
    found = vcre_px(T_est @ T_true, T_true, K, WIDTH, HEIGHT)
    assert vcre_px(T_est @ T_true @ M, T_true @ M, K, WIDTH, HEIGHT) == pytest.approx(found)
    assert vcre_px(M @ T_est @ T_true, M @ T_true, K, WIDTH, HEIGHT) != pytest.approx(found, abs=1)


def test_vcre_is_never_above_the_diagonal_and_reaches_it() -> None:
    assert pytest.approx(0.1 * np.hypot(WIDTH, HEIGHT)) == VCRE_PX
    for error in random_poses(7, 50, spread=4):
        assert 0 < vcre_px(error, np.eye(4), K, WIDTH, HEIGHT) <= np.hypot(WIDTH, HEIGHT)
    # All points left above the image, drawn right below it.
    K_beside = np.array([[500.0, 0, -1e6], [0, 500, -1e6], [0, 0, 1]])
    found = vcre_px(pose(t=(1e5, 1e5, 0)), np.eye(4), K_beside, WIDTH, HEIGHT)
    assert found == pytest.approx(np.hypot(WIDTH, HEIGHT))


# --- precision over recall


def precision_auc_by_thresholds(confidence: Sequence[float], accepted: Sequence[bool], failures: int) -> float:
    area, recall = 0.0, 0.0
    for least in sorted(set(confidence), reverse=True):
        taken = [right for score, right in zip(confidence, accepted, strict=True) if score >= least]
        reached = len(taken) / (len(confidence) + failures)
        area += sum(taken) / len(taken) * (reached - recall)
        recall = reached
    return area


@pytest.mark.parametrize(
    ("confidence", "accepted", "failures", "expected"),
    [
        ([0.9, 0.8, 0.7], [True, False, True], 0, (1 + 1 / 2 + 2 / 3) / 3),
        ([0.7, 0.9, 0.8], [True, True, False], 1, (1 + 1 / 2 + 2 / 3) / 4),
        ([0.5, 0.5], [True, False], 0, 1 / 2),
        ([0.5, 0.5], [False, True], 0, 1 / 2),
        # One of two at first, then two of three.
        ([3, 3, -1], [True, False, True], 1, (1 / 2 * 2 + 2 / 3) / 4),
        # Without a confidence it is the precision, accepted of all.
        ([0, 0, 0, 0], [True, True, True, False], 4, 3 / 8),
        ([1, 2], [True, True], 0, 1),
        ([1, 2], [False, False], 3, 0),
        ([], [], 2, 0),
    ],
)
def test_precision_auc_of_a_few_frames(confidence: list, accepted: list, failures: int, expected: float) -> None:
    assert precision_auc(confidence, accepted, failures) == pytest.approx(expected)


@pytest.mark.parametrize("levels", [3, 1000])
def test_precision_auc_is_the_sum_over_thresholds(levels: int) -> None:
    for seed in range(20):
        rng = np.random.default_rng(seed)
        n, failures = int(rng.integers(1, 30)), int(rng.integers(0, 5))
        confidence, accepted = rng.integers(0, levels, n).tolist(), (rng.random(n) < 0.6).tolist()
        expected = precision_auc_by_thresholds(confidence, accepted, failures)
        assert precision_auc(confidence, accepted, failures) == pytest.approx(expected)


def test_precision_auc_without_frames_is_not_a_number() -> None:
    assert np.isnan(precision_auc([], []))


# --- E_3D


def turned(q: np.ndarray, point: np.ndarray) -> np.ndarray:
    """A point turned by a unit quaternion (x, y, z, w)."""
    vector, w = q[:3], q[3]
    return point + 2 * np.cross(vector, np.cross(vector, point) + w * point)


@pytest.mark.parametrize("seed", range(5))
def test_e_3d_is_the_mean_displacement_by_quaternions(seed: int) -> None:
    T_est, T_true = random_poses(seed, 2)
    points = np.random.default_rng(seed).normal(0, 3, (30, 3))
    q_est, q_true = (Rotation.from_matrix(T[:3, :3]).as_quat() for T in (T_est, T_true))
    total = 0.0
    for point in points:
        total += np.linalg.norm(turned(q_est, point) + T_est[:3, 3] - turned(q_true, point) - T_true[:3, 3])
    assert metrics.error_3d_m(T_est, T_true, points) == pytest.approx(total / len(points))


@pytest.mark.parametrize("spread", [1e-3, 0.1, 1.0])
def test_e_3d_and_e_trans_differ_by_no_more_than_the_rotation_moves(spread: float) -> None:
    for seed in range(10):
        error, T_true = random_poses(seed, 1, spread)[0], random_poses(50 + seed, 1)[0]
        T_est, points = error @ T_true, np.random.default_rng(seed).normal(0, 3, (30, 3))
        e_3d, e_trans = metrics.error_3d_m(T_est, T_true, points), metrics.translation_error_m(T_est, T_true)
        half = np.radians(metrics.rotation_error_deg(T_est, T_true)) / 2
        assert abs(e_3d - e_trans) <= np.mean(2 * np.sin(half) * np.linalg.norm(points, axis=1)) + 1e-12
        T_est[:3, :3] = T_true[:3, :3]
        e_trans = metrics.translation_error_m(T_est, T_true)
        assert metrics.error_3d_m(T_est, T_true, points) == pytest.approx(e_trans)


def test_e_3d_reaches_the_bound_for_points_square_to_the_axis() -> None:
    points = [(1, 0, 0), (0, 3, 0)]
    expected = 2 * np.sin(np.radians(25)) * (1 + 3) / 2
    assert metrics.error_3d_m(pose((0, 0, 50), (1, 2, 3)), pose(t=(1, 2, 3)), points) == pytest.approx(expected)


# --- what is refused


@pytest.mark.parametrize("score", [auc, mean_average_accuracy])
@pytest.mark.parametrize("errors", [[1.0, -0.1], [NAN, 1.0], [[1.0, 2.0]], 3.0])
def test_errors_that_are_none_are_refused(score: Callable[..., Any], errors: Any) -> None:
    with pytest.raises(ValueError, match="expected a list of numbers from 0, infinity for a failure"):
        score(errors)


@pytest.mark.parametrize("threshold", [0.0, -5.0, NAN, INF])
def test_thresholds_that_are_not_positive_are_refused(threshold: float) -> None:
    for errors in ([1.0], []):
        with pytest.raises(ValueError, match="expected positive, finite ones, deg"):
            auc(errors, [5.0, threshold])


@pytest.mark.parametrize(
    ("confidence", "accepted", "failures"),
    [([0.5], [True, False], 0), ([NAN], [True], 0), ([0.5], [True], -1), ([[0.5]], [[True]], 0)],
)
def test_frames_that_do_not_fit_together_are_refused(confidence: list, accepted: list, failures: int) -> None:
    with pytest.raises(ValueError, match="expected as many numbers as answers, none NaN, and failures from 0"):
        precision_auc(confidence, accepted, failures)


def test_vcre_of_a_point_in_the_plane_of_the_lens_is_a_number() -> None:
    T = np.eye(4)
    T[2, 3] = -1.8  # the first plane of points ends up at depth zero, its middle ones on the axis
    found = vcre_px(T, np.eye(4), [[500, 0, 270], [0, 500, 360], [0, 0, 1]], 540, 720)
    assert 0 < found <= np.hypot(540, 720)
