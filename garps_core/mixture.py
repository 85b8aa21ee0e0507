# SPDX-License-Identifier: Apache-2.0
"""The 3D Gaussian mixture of one view, and the frustum of its camera."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from garps_core.checks import Float32Array, Float64Array, FloatArray, IntArray, numeric
from garps_core.errors import InputError


@dataclass(frozen=True, eq=False)
class Frustum:
    """The part of space that the camera of a mixture saw: image bounds, coarse depth map and brightness.

    Args:
        K: 3x3 pixels of the depth map's own grid.
        depth: hxw float32 metres, NaN = unknown (then nothing is called hidden there).
        brightness: hxw float32 0..1 on the same grid; None = unknown, then the pose is not fitted to it.
        patch_sigma: relative error of the depth that differs from place to place (`lifting.patch_sigma`).
    """

    K: Float64Array
    depth: Float32Array
    brightness: Float32Array | None = None
    patch_sigma: float = 0.0


@dataclass(frozen=True, eq=False)
class Mixture:
    """A 3D Gaussian mixture in the frame of the camera that saw it.

    Args:
        means: Nx3 m.
        covariances: Nx3x3 m^2, symmetric positive definite.
        weights: N, non-negative, not all zero (relative; any scale).
        colours: Nx3 in 0..1.
        labels: N integers (semantic class), or None.
        frustum: what the camera saw; None turns the visibility test off.
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
        means = numeric("means", self.means)
        if means.ndim != 2:
            raise InputError(f"means have shape {means.shape}: expected Nx3 m")
        n = len(means)
        for name, shape in (("means", (n, 3)), ("covariances", (n, 3, 3)), ("weights", (n,)), ("colours", (n, 3))):
            object.__setattr__(self, name, _checked_component(name, getattr(self, name), shape))
        if self.labels is not None:
            labels = numeric("labels", self.labels)
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
    array = numeric(name, value)
    if array.shape != shape:
        raise InputError(f"{name} have shape {array.shape}: expected {shape} for {shape[0]} components")
    if array.dtype not in (np.float32, np.float64):
        array = array.astype(np.float64)
    if not np.isfinite(array).all():
        raise InputError(f"{name} hold NaN or infinity: expected finite numbers; drop those components first")
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
            f"covariances are indefinite: component {bad} has eigenvalue {smallest[bad]:.3g} m^2: "
            "expected positive definite. Add a small variance to the diagonal"
        )
