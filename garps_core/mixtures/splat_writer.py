# SPDX-License-Identifier: Apache-2.0
"""A mixture as a 3D Gaussian Splatting PLY file, the form public splat viewers open.

Layout of Kerbl et al., "3D Gaussian Splatting" (arXiv:2308.04079): per component x y z, nx ny nz (unused, zero),
f_dc_0..2 (colour as the constant spherical harmonic), opacity (logit), scale_0..2 (log of the sigmas, metres),
rot_0..3 (quaternion w, x, y, z); little-endian float32. Coordinates stay those of the mixture: x right, y down,
z forward.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import Rotation

from garps_core.checks import Float64Array, FloatArray
from garps_core.errors import InputError
from garps_core.geometry import transform
from garps_core.types import Mixture

SH_CONSTANT = 0.28209479177387814
"""Y_0^0 = 1 / (2 sqrt(pi)); a colour c is stored as (c - 0.5) / SH_CONSTANT."""

DEFAULT_OPACITY = 0.95
FIELDS = (
    *("x", "y", "z", "nx", "ny", "nz"),
    *("f_dc_0", "f_dc_1", "f_dc_2"),
    "opacity",
    *("scale_0", "scale_1", "scale_2"),
    *("rot_0", "rot_1", "rot_2", "rot_3"),
)


def write_splats(mixture: Mixture, path: str | Path, opacities: FloatArray | None = None) -> Path:
    """Write a mixture as binary splat PLY; returns the path.

    Args:
        mixture: N components, metres.
        path: the file to write; its folder must exist.
        opacities: N in 0..1, for reconstructors whose components have one. By default all get 0.95: the weights of a
            mixture say how much surface a component stands for, which is not how opaque it is.
    Raises:
        InputError: no components, opacities of the wrong shape or range, or a file that cannot be written.
    """
    path = Path(path)
    if len(mixture) == 0:
        raise InputError(f"mixture for {path} is empty: expected at least one component")
    table = splat_table(mixture, opacities)
    header = ["ply", "format binary_little_endian 1.0", f"element vertex {len(table)}"]
    header += [f"property float {name}" for name in FIELDS]
    try:
        with path.open("wb") as file:
            file.write(("\n".join([*header, "end_header"]) + "\n").encode("ascii"))
            file.write(table.tobytes())
    except OSError as error:
        raise InputError(f"cannot write {path} ({error.strerror}): expected a writable file name") from None
    return path


def write_aligned(source: Mixture, target: Mixture, T_target_source: Float64Array, folder: str | Path) -> list[Path]:
    """Write source.ply and target.ply in their own cameras' frames, and aligned.ply: both in the target's.

    Raises:
        InputError: a folder that cannot be made, or what `write_splats` refuses.
    """
    folder = Path(folder)
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError(f"cannot make the folder {folder} ({error.strerror}): expected a writable place") from None
    R = T_target_source[:3, :3]
    both = Mixture(
        np.concatenate([transform(T_target_source, source.means.astype(np.float64)), target.means]),
        np.concatenate([R @ source.covariances @ R.T, target.covariances]),
        np.concatenate([source.weights, target.weights]),
        np.concatenate([source.colours, target.colours]),
    )
    parts = {"source": source, "target": target, "aligned": both}
    return [write_splats(mixture, folder / f"{name}.ply") for name, mixture in parts.items()]


def splat_table(mixture: Mixture, opacities: FloatArray | None = None) -> npt.NDArray[np.float32]:
    """The file's rows: N x 17 little-endian float32 in the order of `FIELDS`."""
    n = len(mixture)
    sigmas, quaternions = scale_rotation(mixture.covariances)
    if opacities is None:
        opacities = np.full(n, DEFAULT_OPACITY)
    if opacities.shape != (n,) or not ((opacities >= 0) & (opacities <= 1)).all():
        raise InputError(f"opacities have shape {opacities.shape}: expected {n} numbers in 0..1")
    alpha = np.clip(opacities.astype(np.float64), 1e-4, 1 - 1e-4)  # the logit of 0 and 1 is infinite
    columns = (
        mixture.means,
        np.zeros((n, 3)),
        (mixture.colours - 0.5) / SH_CONSTANT,
        np.log(alpha / (1 - alpha))[:, None],
        np.log(sigmas),
        quaternions,
    )
    return np.concatenate(columns, axis=1).astype("<f4")


def scale_rotation(covariances: FloatArray) -> tuple[Float64Array, Float64Array]:
    """Nx3x3 covariances -> sigmas Nx3 (m, ascending) and unit quaternions Nx4 (w, x, y, z) of their axes."""
    variances, axes = np.linalg.eigh(covariances.astype(np.float64))
    # Eigenvectors come with either handedness; a mirrored axis spans the same ellipsoid.
    axes[:, :, 0] *= np.sign(np.linalg.det(axes))[:, None]
    xyzw = Rotation.from_matrix(axes).as_quat()
    return np.sqrt(np.maximum(variances, 1e-20)), np.asarray(xyzw[:, [3, 0, 1, 2]])
