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

from garps_core.errors import InputError
from garps_core.geometry import nearest_rotation

FloatArray = npt.NDArray[np.floating[Any]]
Float32Array = npt.NDArray[np.float32]
Float64Array = npt.NDArray[np.float64]
IntArray = npt.NDArray[np.integer[Any]]

MAX_IMAGE_PIXELS = 8192 * 8192
MAX_PLAUSIBLE_DEPTH_M = 200.0
MIN_PLAUSIBLE_DEPTH_M = 0.01


def checked_intrinsics(K: Any) -> Float64Array:
    """Return K as 3x3 float64, pixels. Raises InputError unless it is a finite pinhole matrix with positive focals."""
    K = _numeric("K", K).astype(np.float64)
    if K.shape != (3, 3):
        raise InputError(f"K has shape {K.shape}: expected 3x3, [[fx, 0, cx], [0, fy, cy], [0, 0, 1]] in pixels")
    if not np.isfinite(K).all():
        raise InputError("K holds NaN or infinity: expected finite pixels; check the camera calibration")
    if K[0, 0] <= 0 or K[1, 1] <= 0:
        raise InputError(
            f"K has focal lengths fx={K[0, 0]:g}, fy={K[1, 1]:g}: expected both positive, in pixels; "
            "an uncalibrated camera publishes zeros, calibrate it first"
        )
    if np.abs(K[2] - (0, 0, 1)).max() > 1e-9 or K[1, 0] != 0:
        raise InputError(f"K has last row {K[2].tolist()}: expected [0, 0, 1] and K[1,0] = 0; is it transposed?")
    if K[0, 1] != 0:
        raise InputError(f"K has skew {K[0, 1]:g}: expected 0; rectify the image first")
    return K


def checked_rigid(name: str, T: Any) -> Float64Array:
    """Return T as 4x4 float64 with an exact rotation. Raises InputError unless it is a rigid motion to 1e-3."""
    T = _numeric(name, T).astype(np.float64)
    if T.shape != (4, 4):
        raise InputError(f"{name} has shape {T.shape}: expected a 4x4 rigid transform")
    if not np.isfinite(T).all():
        raise InputError(f"{name} holds NaN or infinity: expected a finite 4x4 rigid transform")
    if np.abs(T[3] - (0, 0, 0, 1)).max() > 1e-9:
        raise InputError(f"{name} has last row {T[3].tolist()}: expected [0, 0, 0, 1]")
    R = T[:3, :3]
    off = np.abs(R.T @ R - np.eye(3)).max()
    if off > 1e-3 or np.linalg.det(R) < 0:
        raise InputError(
            f"{name} is no rigid motion: R^T R differs from identity by {off:.2g}, det R = {np.linalg.det(R):.3g}; "
            "expected a right-handed rotation without scale"
        )
    T = T.copy()
    T[:3, :3] = nearest_rotation(R)
    return T


def checked_covariance(name: str, covariance: Any) -> Float64Array:
    """Return a 6x6 float64 covariance. Raises InputError unless finite, symmetric and positive definite."""
    C = _numeric(name, covariance).astype(np.float64)
    if C.shape != (6, 6):
        raise InputError(f"{name} has shape {C.shape}: expected 6x6 (x, y, z in m; rotations about X, Y, Z in rad)")
    if not np.isfinite(C).all():
        raise InputError(f"{name} holds NaN or infinity: expected finite variances; use a large one for unknown")
    if np.abs(C - C.T).max() > 1e-6 * np.abs(C).max():
        raise InputError(f"{name} is not symmetric: largest difference {np.abs(C - C.T).max():.3g}")
    smallest = float(np.linalg.eigvalsh(0.5 * (C + C.T))[0])
    if smallest <= 0:
        raise InputError(
            f"{name} is not positive definite: smallest eigenvalue {smallest:.3g}; "
            "zeros do not mean unknown, give every direction a positive variance"
        )
    return 0.5 * (C + C.T)


def _numeric(name: str, value: Any) -> npt.NDArray[Any]:
    try:
        array = np.asarray(value)
    except (ValueError, TypeError) as error:
        raise InputError(f"{name} is no array ({error}): expected numbers") from None
    if array.dtype.kind not in "fiu":
        raise InputError(f"{name} has dtype {array.dtype}: expected real numbers")
    return array


@dataclass(frozen=True, eq=False)
class View:
    """One camera's look at the scene.

    Args:
        rgb: HxWx3 uint8, red first.
        K: 3x3 pinhole intrinsics in pixels of this image, no distortion left.
        depth: HxW float32 metres along z, registered to rgb; NaN (also 0 and +-Inf) = no reading; None = no depth.
        stamp_ns: time of acquisition, nanoseconds.
        frame_id: name of the optical frame.
    Raises:
        InputError: with what was given, what was expected and what to do.
    """

    rgb: npt.NDArray[np.uint8]
    K: Float64Array
    depth: Float32Array | None = None
    stamp_ns: int = 0
    frame_id: str = ""

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
        raise InputError(f"rgb has shape {rgb.shape}: expected HxWx3; repeat a grey image over three channels")
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
        _check_depth_scale(float(np.median(readings)))
    return clean


def _check_depth_scale(median_m: float) -> None:
    if median_m > MAX_PLAUSIBLE_DEPTH_M:
        raise InputError(
            f"depth has median {median_m:.4g} m: this looks like millimetres; expected metres, multiply by 0.001"
        )
    if median_m < MIN_PLAUSIBLE_DEPTH_M:
        raise InputError(
            f"depth has median {median_m:.4g} m: expected metres; is it a disparity, normalised or in kilometres?"
        )


@dataclass(frozen=True, eq=False)
class Frustum:
    """What the camera behind a mixture could see: image bounds and a coarse depth map.

    Args:
        K: 3x3 pixels of the depth map's own grid.
        depth: hxw float32 metres, NaN = unknown (then nothing is called hidden there).
    """

    K: Float64Array
    depth: Float32Array


@dataclass(frozen=True, eq=False)
class Mixture:
    """A 3D Gaussian mixture in the frame of the camera that saw it.

    Args:
        means: Nx3 m.
        covariances: Nx3x3 m^2, symmetric positive definite.
        weights: N, non-negative, not all zero (relative; any scale).
        colours: Nx3 in 0..1.
        labels: N integers (semantic class), or None.
        frustum: what the camera could see; None turns the visibility test off.
    Raises:
        InputError: wrong shape, dtype, NaN, indefinite covariance.
    """

    means: FloatArray
    covariances: FloatArray
    weights: FloatArray
    colours: FloatArray
    labels: IntArray | None = None
    frustum: Frustum | None = None

    def __post_init__(self) -> None:
        n = len(_numeric("means", self.means))
        for name, shape in (("means", (n, 3)), ("covariances", (n, 3, 3)), ("weights", (n,)), ("colours", (n, 3))):
            object.__setattr__(self, name, _checked_component(name, getattr(self, name), shape))
        if self.labels is not None:
            labels = _numeric("labels", self.labels)
            if labels.shape != (n,) or labels.dtype.kind not in "iu":
                raise InputError(f"labels have shape {labels.shape}, {labels.dtype}: expected {n} integers")
            object.__setattr__(self, "labels", labels)
        _check_component_values(self)

    def __len__(self) -> int:
        return len(self.means)

    def subset(self, index: npt.NDArray[Any]) -> Mixture:
        """Components `index` (integers or a boolean mask), same camera."""
        labels = None if self.labels is None else self.labels[index]
        return Mixture._trusted(
            self.means[index], self.covariances[index], self.weights[index], self.colours[index], labels, self.frustum
        )

    @classmethod
    def _trusted(cls, *values: Any) -> Mixture:
        """Build from parts that are known to be valid, without checking them again."""
        mixture = object.__new__(cls)
        names = ("means", "covariances", "weights", "colours", "labels", "frustum")
        for name, value in zip(names, values, strict=True):
            object.__setattr__(mixture, name, value)
        return mixture


def _checked_component(name: str, value: Any, shape: tuple[int, ...]) -> FloatArray:
    array = _numeric(name, value)
    if array.shape != shape:
        raise InputError(f"{name} have shape {array.shape}: expected {shape} for {shape[0]} components")
    if array.dtype not in (np.float32, np.float64):
        array = array.astype(np.float64)
    if not np.isfinite(array).all():
        raise InputError(f"{name} hold NaN or infinity: drop those components first")
    return array


def _check_component_values(mixture: Mixture) -> None:
    if len(mixture) == 0:
        return
    if mixture.weights.min() < 0 or mixture.weights.max() <= 0:
        raise InputError("weights are negative or all zero: expected non-negative, at least one positive")
    if mixture.colours.min() < -1e-6 or mixture.colours.max() > 1 + 1e-6:
        raise InputError(
            f"colours span {mixture.colours.min():.3g}..{mixture.colours.max():.3g}: expected 0..1; divide bytes by 255"
        )
    S = mixture.covariances.astype(np.float64)
    if np.abs(S - S.transpose(0, 2, 1)).max() > 1e-5 * np.abs(S).max():
        raise InputError("covariances are not symmetric: expected Nx3x3 symmetric positive definite, m^2")
    smallest = np.linalg.eigvalsh(S)[:, 0]
    if smallest.min() <= 0:
        bad = int(smallest.argmin())
        raise InputError(
            f"covariances are indefinite: component {bad} has eigenvalue {smallest[bad]:.3g} m^2; "
            "expected positive definite, add a small variance to the diagonal"
        )


@dataclass(frozen=True, eq=False)
class Prior:
    """A pose with its uncertainty: odometry, a calibration guess, or what an initialiser found.

    Args:
        T_target_source: 4x4 rigid motion, source-camera points into the target camera, metres.
        covariance: 6x6 in the ROS order and meaning (module docstring), m^2 and rad^2.
        origin: who made it: "given", "features", "identity".
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
    """How an estimate ended. Only `CONVERGED` is meant to be used without a second look."""

    CONVERGED = "converged"
    MAX_ITERATIONS = "max_iterations"  #: a pose is given, the last step was still larger than the tolerance
    DEGENERATE = "degenerate"  #: a pose is given, but the views leave a direction open; see the covariance
    INCONSISTENT = "inconsistent"  #: the data pulls further from the initial pose than its covariance allows
    LOW_OVERLAP = "low_overlap"  #: too few components of one view are visible in the other
    NO_INITIAL_POSE = "no_initial_pose"  #: nothing to start from


@dataclass(frozen=True, eq=False)
class PoseEstimate:
    """The answer, or why there is none.

    `T_target_source` (4x4 float64) and `covariance` (6x6, ROS order and meaning) are None when the status says
    that no pose could be had: there is no identity in disguise.
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
    seconds: dict[str, float] = field(default_factory=dict)
    """Wall time per stage: reconstruct, initialise, align."""

    @property
    def ok(self) -> bool:
        """True when the pose converged and may be used as it is."""
        return self.status is Status.CONVERGED
