# SPDX-License-Identifier: Apache-2.0
"""One pair, one kind of start, every method: rows of errors. What every accuracy table is made of."""

from __future__ import annotations

import time
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from bench.pairs.pair import Pair
from bench.pairs.readers.pairs_json import truth_covariance
from bench.pairs.starts import disturbed_prior
from bench.peers.methods import METHODS
from bench.rows.pose_errors import camera_error_m, vcre_px
from bench.rows.row import ERRORS, START, Row
from bench.rows.variants import GARPS, GARPS_NO_FEATURES, VARIANTS, Variant, variant_estimate
from garps_core import Config, GarpsError, PoseEstimate, Prior, Status, estimate_relative_pose, metrics
from garps_core.checks import Float64Array
from garps_core.start.identity_start import identity

STARTS = ("features", "disturbed", "identity", "none")
"""GARPS' own features + PnP; the truth off by 1 deg and 0.12 m, given as a prior; identity; or GARPS starts as it sees
fit, and peers that need a start from the identity."""


def rows_of_pairs(
    config: Config,
    pairs: Sequence[Pair],
    start: str = "disturbed",
    methods: Iterable[str] = (GARPS,),
    seed: int = 0,
) -> list[Row]:
    """Run GARPS and peers on pairs from one kind of start.

    Args:
        config: settings of GARPS; its `start.method` is set here.
        pairs: what `load_pairs` gave; keep the list to evaluate many configurations.
        start: one of `STARTS`.
        methods: names from `bench.rows.variants.VARIANTS` and `bench.peers.methods.METHODS`. GARPS always runs where
            the start comes from it.
        seed: of the disturbance.
    Returns: rows, per pair first "(start)", then the methods in order.
    """
    chosen = list(methods)
    return [row for pair in pairs for row in rows_of_pair(config, pair, start, chosen, seed)]


def rows_of_pair(
    config: Config,
    pair: Pair,
    start: str,
    methods: Sequence[str],
    seed: int = 0,
    known: Mapping[str, Row] | None = None,
) -> list[Row]:
    """`rows_of_pairs` on one pair; peers in `known` are not run, their rows are taken from there.

    `garps-no-features` is left out where no pose is given to start from, and `garps-labels` where there are none.
    """
    case = _Case(config, pair, start, seed)
    prior, own = case.prior, None
    if GARPS in methods or prior is None:
        own = run_garps(config, pair, start, prior)
    start_pose = prior if prior is not None or own is None else own[0].initial
    rows = [_start_row(case, start_pose, None if prior is not None or own is None else own[0])]
    T_start = None if start_pose is None else start_pose.T_target_source
    for name in methods:
        if name == GARPS and own is not None:
            rows.append(_garps_row(case, GARPS, *own))
        elif name in VARIANTS:
            left_out = (name == GARPS_NO_FEATURES and prior is None) or (VARIANTS[name].labels and pair.labels is None)
            rows += [] if left_out else [_garps_row(case, name, *_timed(VARIANTS[name], case))]
        elif known and name in known:
            rows.append(known[name])
        else:
            began = time.perf_counter()
            T, reason = METHODS[name](pair.source, pair.target, np.eye(4) if start == "none" else T_start)
            rows.append(_row(case, name, T, time.perf_counter() - began, reason))
    return rows


def failed_rows(config: Config, pair: Pair, start: str, methods: Sequence[str], reason: str) -> list[Row]:
    """The rows of `rows_of_pair` on a pair that cannot be had, for instance for want of depth: all are failures."""
    case = _Case(config, pair, start, 0)
    return [_row(case, name, None, float("nan"), reason) for name in (START, *methods)]


@dataclass(frozen=True, eq=False)
class _Case:
    """A pair from one kind of start."""

    config: Config
    pair: Pair
    start: str
    seed: int

    @property
    def prior(self) -> Prior | None:
        """The pose that is given, if any."""
        if self.start == "disturbed":
            return disturbed_prior(self.pair, self.seed)
        return identity(self.config, "a guess") if self.start == "identity" else None


def _timed(variant: Variant, case: _Case) -> tuple[PoseEstimate, float]:
    began = time.perf_counter()
    found = variant_estimate(variant, case.pair, _started(case.config, case.start), case.prior)
    return found, time.perf_counter() - began


def _started(config: Config, start: str) -> Config:
    return config.replace({"start.method": "features"}) if start == "features" else config


def run_garps(config: Config, pair: Pair, start: str, prior: Prior | None) -> tuple[PoseEstimate, float]:
    """GARPS from one kind of start: the estimate and its wall time in s."""
    config, began = _started(config, start), time.perf_counter()
    try:
        found = estimate_relative_pose(pair.source, pair.target, config, prior)
    except GarpsError as error:  # an answer about this pair, not about the others
        found = PoseEstimate(Status.NO_INITIAL_POSE, f"{type(error).__name__}: {error}", initial=prior)
    return found, time.perf_counter() - began


def _start_row(case: _Case, start_pose: Prior | None, own: PoseEstimate | None) -> Row:
    """The pose before the alignment; `own` = GARPS' estimate where it chose the pose itself."""
    seconds = float("nan") if own is None else own.seconds.get("initialise", float("nan"))
    if start_pose is None:
        return _row(case, START, None, seconds, "" if own is None else own.reason)
    return _row(case, START, start_pose.T_target_source, seconds, "", start_pose.covariance)


def _garps_row(case: _Case, name: str, found: PoseEstimate, seconds: float) -> Row:
    row = _row(case, name, found.T_target_source, seconds, found.reason, found.covariance)
    return row | {
        "status": found.status.value,
        "origin": "" if found.initial is None else found.initial.origin,
        "overlap": found.overlap,
        "quality": found.quality,
        "iterations": found.iterations,
        "objective": found.objective,
        **{f"seconds_{stage}": value for stage, value in found.seconds.items()},
    }


def _row(
    case: _Case,
    method: str,
    T: Float64Array | None,
    seconds: float,
    reason: str,
    covariance: Float64Array | None = None,
) -> Row:
    pair, truth = case.pair, case.pair.T_target_source
    row: Row = {"set": pair.set, "pair": pair.id, "category": pair.category, "start": case.start, "method": method}
    row |= {"found": T is not None, "seconds": seconds, "reason": reason, "scale": pair.scale}
    row |= {
        "points": len(pair.points),
        "points_from": pair.points_from,
        "true_trans_m": float(np.linalg.norm(truth[:3, 3])),
        "true_rot_deg": metrics.rotation_error_deg(np.eye(4), truth),
    }
    if T is None:
        return row | dict.fromkeys(ERRORS, float("inf"))
    row |= {
        "e_trans_m": metrics.translation_error_m(T, truth),
        "e_rot_deg": metrics.rotation_error_deg(T, truth),
        "e_3d_m": metrics.error_3d_m(T, truth, pair.points),
        "e_c_m": camera_error_m(T, truth),
        "vcre_px": vcre_px(T, truth, pair.target.K, *pair.target.rgb.shape[1::-1]),
        "e_dir_deg": metrics.direction_error_deg(T, truth),
        "scale_ratio": metrics.scale_ratio(T, truth),
        "T": T[:3].ravel().tolist(),
    }
    if covariance is not None:
        row |= {
            "nees": metrics.nees(T, covariance + truth_covariance(pair), truth),
            "covariance": np.asarray(covariance).ravel().tolist(),
        }
    return row
