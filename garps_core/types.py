# SPDX-License-Identifier: Apache-2.0
"""The data that crosses a stage: View -> Mixture -> Prior -> PoseEstimate. All frozen, all numpy, all validated.

Frames are OpenCV optical frames: x right, y down, z forward, metres. `T_target_source` maps points of the source
camera into the target camera. A 6x6 covariance is always in the ROS order and meaning: (x, y, z) of the source
camera's origin in the target frame, in m, then small rotations about the target's fixed X, Y, Z axes, in rad.
"""

from __future__ import annotations

import enum
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import numpy.typing as npt

from garps_core.checks import Float32Array, Float64Array, checked_covariance, checked_intrinsics, checked_rigid
from garps_core.errors import InputError
from garps_core.mixture import Frustum, Mixture

__all__ = ["Frustum", "Mixture", "PoseEstimate", "Prior", "Status", "View"]

MAX_IMAGE_PIXELS = 8192 * 8192
MAX_PLAUSIBLE_DEPTH_M = 200.0
MIN_PLAUSIBLE_DEPTH_M = 0.01


@dataclass(frozen=True, eq=False)
class View:
    """One camera's look at the scene.

    Args:
        rgb: HxWx3 uint8, red first.
        K: 3x3 pinhole intrinsics in pixels of this image, no distortion left.
        depth: HxW float32 metres along z, registered to rgb; NaN (also 0 and +-Inf) = no reading; None = no depth.
        stamp_ns: time of acquisition, nanoseconds.
        frame_id: name of the optical frame.
        K_estimated: K is a network's estimate (`focal.estimate_intrinsics`), not a calibration.
    Raises:
        InputError: with what was given, what was expected and what to do.
    """

    rgb: npt.NDArray[np.uint8]
    K: Float64Array
    depth: Float32Array | None = None
    stamp_ns: int = 0
    frame_id: str = ""
    K_estimated: bool = False

    def __post_init__(self) -> None:
        object.__setattr__(self, "rgb", _checked_rgb(self.rgb))
        object.__setattr__(self, "K", checked_intrinsics(self.K))
        if self.depth is not None:
            object.__setattr__(self, "depth", _checked_depth(self.depth, self.rgb.shape[:2]))


def _checked_rgb(rgb: Any) -> npt.NDArray[np.uint8]:
    if not isinstance(rgb, np.ndarray) or rgb.dtype != np.uint8:
        given = f"dtype {rgb.dtype}" if isinstance(rgb, np.ndarray) else type(rgb).__name__
        raise InputError(f"rgb is {given}: expected an HxWx3 uint8 array, values 0..255")
    if rgb.ndim != 3 or rgb.shape[2] != 3:
        raise InputError(f"rgb has shape {rgb.shape}: expected HxWx3. Repeat a grey image over three channels")
    height, width = rgb.shape[:2]
    if height < 16 or width < 16 or height * width > MAX_IMAGE_PIXELS:
        raise InputError(f"rgb is {width}x{height}: expected at least 16x16 and at most {MAX_IMAGE_PIXELS} pixels")
    return rgb


def _checked_depth(depth: Any, size: tuple[int, int]) -> Float32Array:
    if not isinstance(depth, np.ndarray) or depth.dtype not in (np.float32, np.float64):
        given = f"dtype {depth.dtype}" if isinstance(depth, np.ndarray) else type(depth).__name__
        raise InputError(
            f"depth is {given}: expected HxW float32 metres; for millimetres use "
            "np.where(mm > 0, mm * 0.001, np.nan).astype(np.float32)"
        )
    if depth.shape != size:
        raise InputError(
            f"depth is {'x'.join(map(str, depth.shape))} but rgb is {size[0]}x{size[1]} (rows x columns): "
            "expected depth registered to the colour image"
        )
    with np.errstate(invalid="ignore"):
        if (depth[np.isfinite(depth)] < 0).any():
            raise InputError("depth holds negative values: expected metres along z, NaN where there is no reading")
        clean = np.where(np.isfinite(depth) & (depth > 0), depth, np.nan).astype(np.float32)
    readings = clean[np.isfinite(clean)]
    if readings.size:
        sample = readings[:: max(1, readings.size // 10_000)]  # enough to tell millimetres from metres
        _check_depth_scale(float(np.median(sample)))
    return clean


def _check_depth_scale(median_m: float) -> None:
    if median_m > MAX_PLAUSIBLE_DEPTH_M:
        raise InputError(
            f"depth has median {median_m:.4g} m: this looks like millimetres; expected metres, multiply by 0.001"
        )
    if median_m < MIN_PLAUSIBLE_DEPTH_M:
        raise InputError(
            f"depth has median {median_m:.4g} m: expected metres. Is it a disparity, normalised or in kilometres?"
        )


@dataclass(frozen=True, eq=False)
class Prior:
    """A pose with its uncertainty: odometry, a calibration guess, or what an initialiser found.

    Args:
        T_target_source: 4x4 rigid motion, source-camera points into the target camera, metres.
        covariance: 6x6 in the ROS order and meaning (module docstring), m^2 and rad^2.
        origin: who made it: "given", "features", "given and features", "identity", or the name of a two-view network or
            of an installed way to start.
        reason: why this one was used, for people.
    Raises:
        InputError: no rigid motion, covariance not positive definite.
    """

    T_target_source: Float64Array
    covariance: Float64Array
    origin: str = "given"
    reason: str = ""

    def __post_init__(self) -> None:
        object.__setattr__(self, "T_target_source", checked_rigid("prior T_target_source", self.T_target_source))
        object.__setattr__(self, "covariance", checked_covariance("prior covariance", self.covariance))


class Status(enum.Enum):
    """Outcome of an estimate. Only `CONVERGED` is meant to be used without further checks."""

    CONVERGED = "converged"
    MAX_ITERATIONS = "max_iterations"  #: a pose is given, the last step was still larger than the tolerance
    DEGENERATE = "degenerate"  #: a pose is given, but the views leave a direction open; see the covariance
    INCONSISTENT = "inconsistent"  #: the data pulls further from the starting pose than its covariance allows
    POOR_FIT = "poor_fit"  #: too few partners, or brightness disagrees: most likely a wrong optimum; a pose is given
    LOW_OVERLAP = "low_overlap"  #: too few components of one view are visible in the other
    NO_MIXTURE = "no_mixture"  #: a view has too little usable depth, or a network failed: no memory, values not finite
    NO_INITIAL_POSE = "no_initial_pose"  #: nothing to start from


@dataclass(frozen=True, eq=False)
class PoseEstimate:
    """Estimated pose with its status, or the reason why there is none.

    `T_target_source` (4x4 float64) and `covariance` (6x6, ROS order and meaning) are None when the status says that
    no pose was found; the identity never stands for a missing pose.
    """

    status: Status
    reason: str
    T_target_source: Float64Array | None = None
    covariance: Float64Array | None = None
    initial: Prior | None = None
    overlap: float = 0.0
    """Share of components (0..1, smaller of the two directions) that the other camera sees under this pose."""
    iterations: int = 0
    objective: float = float("nan")
    """Final value of the objective; comparable only between runs on the same mixtures and Config."""
    quality: float = 0.0
    """Probability (0..1) that the pose is right to 5 cm and 2 deg, from covariance and fit; to gate and to rank by."""
    agreement: float = float("nan")
    """Correlation of the views' brightness under this pose times the share that both see; NaN where unknown."""
    seconds: dict[str, float] = field(default_factory=dict)
    """Wall time per stage: depth (the network's), reconstruct, initialise, align."""
    estimated_fx_px: tuple[float | None, float | None] = (None, None)
    """Focal lengths of source and target where they are a network's estimate; None = the intrinsics were given."""
    depth_from: str = "given"
    """Source of the views' depth, for people; "given" = with the views, or by whoever made the mixtures."""

    @property
    def ok(self) -> bool:
        """True when the pose converged and may be used as it is."""
        return self.status is Status.CONVERGED
