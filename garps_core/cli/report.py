# SPDX-License-Identifier: Apache-2.0
"""PoseEstimate -> JSON types for machines, and text for people."""

from __future__ import annotations

from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from garps_core.checks import Float64Array
from garps_core.types import PoseEstimate


def as_json(estimate: PoseEstimate) -> dict[str, Any]:
    """Return everything in a PoseEstimate as JSON types; a missing pose is null."""
    initial = estimate.initial
    return {
        "status": estimate.status.value,
        "ok": estimate.ok,
        "reason": estimate.reason,
        **_pose_json(estimate.T_target_source, estimate.covariance),
        "initial": initial
        and {
            "origin": initial.origin,
            "reason": initial.reason,
            **_pose_json(initial.T_target_source, initial.covariance),
        },
        "overlap": float(estimate.overlap),
        "quality": float(estimate.quality),
        "agreement": float(estimate.agreement) if np.isfinite(estimate.agreement) else None,
        "depth_from": estimate.depth_from,
        "estimated_fx_px": list(estimate.estimated_fx_px),
        "iterations": int(estimate.iterations),
        "objective": float(estimate.objective) if np.isfinite(estimate.objective) else None,
        "seconds": {name: float(value) for name, value in estimate.seconds.items()},
    }


def _pose_json(T: Float64Array | None, covariance: Float64Array | None) -> dict[str, Any]:
    return {
        "T_target_source": None if T is None else T.tolist(),
        "translation_m": None if T is None else T[:3, 3].tolist(),
        "quaternion_xyzw": None if T is None else _quaternion(T).tolist(),
        "covariance": None if covariance is None else covariance.tolist(),
    }


def _quaternion(T: Float64Array) -> Float64Array:
    q = np.asarray(Rotation.from_matrix(T[:3, :3]).as_quat())
    return q if q[3] >= 0 else -q


def as_text(estimate: PoseEstimate) -> str:
    """Return a summary of several lines for people."""
    lines = [f"status       {estimate.status.value}" + (f": {estimate.reason}" if estimate.reason else "")]
    T, covariance = estimate.T_target_source, estimate.covariance
    if T is None:
        lines.append("pose         none")
    else:
        angle = np.degrees(Rotation.from_matrix(T[:3, :3]).magnitude())
        lines.append(f"translation  {_triple(T[:3, 3])} m  (length {np.linalg.norm(T[:3, 3]):.4f} m)")
        if covariance is not None:
            sigmas = np.sqrt(np.diag(covariance))
            lines.append(f"       sigma {_triple(sigmas[:3])} m")
        lines.append(f"rotation     {angle:.3f} deg, quaternion xyzw {_triple(_quaternion(T), 5)}")
        if covariance is not None:
            lines.append(f"       sigma {_triple(np.degrees(sigmas[3:]), 3)} deg about x, y, z")
    if estimate.initial is not None:
        why = f" ({estimate.initial.reason})" if estimate.initial.reason else ""
        lines.append(f"start        {estimate.initial.origin}{why}")
    if estimate.depth_from != "given":
        lines.append(f"depth        by {estimate.depth_from}")
    if any(estimate.estimated_fx_px):
        told = " and ".join("as given" if fx is None else f"{fx:.1f} px" for fx in estimate.estimated_fx_px)
        lines.append(f"intrinsics   estimated: focal lengths {told}, principal point in the middle")
    lines.append(f"overlap      {100 * estimate.overlap:.0f} %, quality {estimate.quality:.2f} of 1")
    spent = ", ".join(f"{name} {value:.2f} s" for name, value in estimate.seconds.items())
    lines.append(f"time         {spent} ({estimate.iterations} iterations)")
    return "\n".join(lines)


def _triple(values: Any, digits: int = 4) -> str:
    return " ".join(f"{float(value):+.{digits}f}" for value in values)
