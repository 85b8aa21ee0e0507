# SPDX-License-Identifier: Apache-2.0
"""The scores of the benchmarks that others report on, in float64: AUC, mAA(30), and those of Map-free.

Poses are 4x4, source-camera points into the target camera. Distances and angles are in `garps_core.metrics`; a failure
is an error of infinity and lowers every score here.

References: AUC: SuperGlue (Sarlin et al., CVPR 2020) and its evaluation code, as LoFTR and others took it over; mAA:
histogram of PoseDiffusion and VGGT; camera error, VCRE and precision-recall: Map-free relocalisation (Arnold et al.,
ECCV 2022) and its benchmark code.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import numpy.typing as npt
from scipy.integrate import trapezoid

from garps_core.checks import Float64Array

INF, NAN = float("inf"), float("nan")
THRESHOLDS_DEG = (5.0, 10.0, 20.0)
VCRE_PX = 90.0
"""Below it Map-free accepts a pose: 10 % of the diagonal of its 540x720 images."""


def pose_error_deg(row: Mapping[str, Any]) -> float:
    """Pose error max(E_rot, E_dir) of a row, deg; 0..180, or infinity for a failure.

    Where the true translation is zero it has no direction and E_rot counts alone; an estimate of zero where the true
    one is not names no direction and is a failure. The sign of a translation counts: 180 deg is opposite, not right.
    """
    if not row["found"]:
        return INF
    if np.isnan(row["e_dir_deg"]):
        return float(row["e_rot_deg"]) if np.isnan(row["scale_ratio"]) else INF
    return float(max(row["e_rot_deg"], row["e_dir_deg"]))


def auc(errors_deg: npt.ArrayLike, thresholds: Sequence[float] = THRESHOLDS_DEG) -> tuple[float, ...]:
    """Area under recall(error) on [0, threshold], over the threshold: one share 0..1 for each threshold.

    Recall is k/n at the k-th smallest error, linear between them from (0, 0) on, and constant from the last error below
    the threshold up to it.

    Args:
        errors_deg: n errors, as `pose_error_deg` gives them; infinity for a failure.
        thresholds: deg.
    Returns:
        As many as thresholds; NaN without errors.
    Raises:
        ValueError: errors that are negative or NaN, or a threshold that is not positive.
    """
    errors = np.sort(_errors(errors_deg))
    if not all(0 < threshold < INF for threshold in thresholds):
        raise ValueError(f"thresholds are {thresholds}: expected positive, finite ones, deg")
    if not len(errors):
        return (NAN,) * len(thresholds)
    x, recall = np.r_[0.0, errors], np.arange(len(errors) + 1) / len(errors)
    found = []
    for threshold in thresholds:
        n = int(np.searchsorted(x, threshold))
        area = trapezoid(np.r_[recall[:n], recall[n - 1]], np.r_[x[:n], threshold])
        found.append(float(area / threshold))
    return tuple(found)


def mean_average_accuracy(errors_deg: npt.ArrayLike, limit_deg: int = 30) -> float:
    """Mean average accuracy, mAA(limit): mean over k = 1..limit of the share of errors below k deg, 0..1.

    NaN without errors.

    Often called AUC@30, but not the number that `auc` gives: recall is read at whole degrees. As in the code it is
    from, an error of just k deg counts from k + 1 deg on, one of just the limit at the limit.

    Raises:
        ValueError: errors that are negative or NaN.
    """
    errors = _errors(errors_deg)
    if not len(errors):
        return NAN
    counts = np.histogram(errors, bins=np.arange(limit_deg + 1))[0]
    return float(np.cumsum(counts).mean() / len(errors))


def _errors(values: npt.ArrayLike) -> Float64Array:
    errors = np.asarray(values, np.float64)
    if errors.ndim != 1 or not (errors >= 0).all():
        raise ValueError(f"errors of shape {errors.shape}: expected a list of numbers from 0, infinity for a failure")
    return errors


def precision_auc(confidence: npt.ArrayLike, accepted: npt.ArrayLike, failures: int = 0) -> float:
    """Map-free's area under precision and recall, 0..1, when frames are taken in order of falling confidence.

    Precision is the share of accepted ones among the frames taken, recall the share of frames taken among all query
    frames, those without an estimate too; so it ends before 1 where there are failures. The area is the sum of
    precision times step of recall, with equal confidences taken at once.

    Args:
        confidence: n numbers of the frames with an estimate, any scale.
        accepted: n, whether their error is below the threshold (0.25 m and 5 deg, or `VCRE_PX`).
        failures: frames without an estimate.
    Returns:
        NaN without any frame, 0 where all are failures.
    Raises:
        ValueError: lengths that differ, confidences that are NaN, or a negative number of failures.
    """
    scores, right = np.asarray(confidence, np.float64), np.asarray(accepted, bool)
    if scores.ndim != 1 or scores.shape != right.shape or np.isnan(scores).any() or failures < 0:
        raise ValueError(
            f"{scores.shape} confidences, {right.shape} accepted, {failures} failures: "
            "expected as many numbers as answers, none NaN, and failures from 0"
        )
    if not len(scores):
        return 0.0 if failures else NAN
    order = np.argsort(-scores, kind="stable")
    falls = scores[order][1:] != scores[order][:-1]
    taken = np.append(np.flatnonzero(falls), len(scores) - 1) + 1  # the last of each run of equal confidences
    precision = np.cumsum(right[order])[taken - 1] / taken
    return float((precision * np.diff(taken, prepend=0)).sum() / (len(scores) + failures))
