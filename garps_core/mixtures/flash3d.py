# SPDX-License-Identifier: Apache-2.0
"""View -> input of Flash3D -> Gaussians -> Mixture.

The network does not see the intrinsics; they enter after it. `View.K` counts from pixel centres, the network's grid
from pixel edges: half a pixel lies between the two.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
import torch
from scipy.ndimage import distance_transform_edt
from torch import Tensor

from garps_core.checks import Float32Array, Float64Array, IntArray
from garps_core.config.lifting import Lifting
from garps_core.errors import ConfigError, InputError, MissingDepthError, ModelError, ReconstructionError
from garps_core.mixtures.frustum import MIN_COMPONENTS, frustum_of, in_range, z_order
from garps_core.mixtures.splat_writer import SH_CONSTANT
from garps_core.models.depth_anything import DTYPES
from garps_core.models.flash3d import HEIGHT, LAYERS, PAD, PADDED, WIDTH, Flash3D, GaussianMaps
from garps_core.models.resampling import lanczos, nearest_index
from garps_core.types import Mixture, View

MIN_OPACITY = 1 / 255
"""Smallest opacity of a Gaussian; fainter ones do not change an 8-bit picture."""
RELATIVE_FLOOR = 1e-6
ABSOLUTE_FLOOR_M2 = 1e-10

Bool = npt.NDArray[np.bool_]


@dataclass(frozen=True, eq=False)
class Flash3DInput:
    """The input of the network.

    Args:
        picture: 320x448x3 uint8 RGB, black border.
        depth: 320x448 float32 m, no gaps, border repeated.
        known: 320x448, False where depth was filled in from the nearest reading.
        K: 3x3 pixels of the padded picture, pixel (u, v) covering u..u+1, v..v+1.
    """

    picture: npt.NDArray[np.uint8]
    depth: Float32Array
    known: Bool
    K: Float64Array


@dataclass(frozen=True, eq=False)
class Flash3DGaussians:
    """The Gaussians of one view in its optical frame (x right, y down, z forward), layer by layer, row by row.

    Args:
        means: Nx3 float32 m.
        covariances: Nx3x3 float32 m^2; may be flat to the last bit.
        opacities: N float32 0..1; 0 where the view has no depth.
        colours: Nx3 float32 0..1, of the constant harmonic.
        index: N, layer * 320 * 448 + row * 448 + column in the padded picture, ascending.
        depth: 2x320x448 float32 m along z, what the layers stand on.
        K: 3x3 as in `Flash3DInput`.
    """

    means: Float32Array
    covariances: Float32Array
    opacities: Float32Array
    colours: Float32Array
    index: IntArray
    depth: Float32Array
    K: Float64Array


def flash3d_input(view: View) -> Flash3DInput:
    """Bring a view with depth to the network's 256x384 pixels, whatever its aspect, and put a border around it.

    Depth is read at the pixel that holds the centre (`nearest-exact`). Raises MissingDepthError
    without a depth image, ReconstructionError where it has no reading.
    """
    if view.depth is None:
        raise MissingDepthError("the view has no depth: Flash3D needs HxW float32 metres. Run a depth network first")
    height, width = view.depth.shape
    depth = view.depth[np.ix_(nearest_index(height, HEIGHT), nearest_index(width, WIDTH))]
    known = np.isfinite(depth)
    if not known.any():
        raise ReconstructionError(
            f"no reading in the view's {height}x{width} depth: expected metres, NaN where unknown"
        )
    nearest = distance_transform_edt(~known, return_distances=False, return_indices=True)
    picture = np.pad(lanczos(view.rgb, HEIGHT, WIDTH), ((PAD, PAD), (PAD, PAD), (0, 0)))
    return Flash3DInput(
        picture,
        np.pad(depth[tuple(nearest)], PAD, mode="edge"),
        np.pad(known, PAD, mode="edge"),
        padded_intrinsics(view),
    )


def padded_intrinsics(view: View) -> Float64Array:
    """3x3 of the padded picture, counted from pixel edges; the principal point need not be in the middle."""
    height, width = view.rgb.shape[:2]
    K = view.K.copy()
    K[:2, 2] += 0.5
    K[0] *= WIDTH / width
    K[1] *= HEIGHT / height
    K[:2, 2] += PAD
    return K


def predict_gaussians(
    network: Flash3D, view: View, drop_border: bool = False, dtype: torch.dtype = torch.float32
) -> Flash3DGaussians:
    """Run the network on a view with metric depth.

    Args:
        network: on any device.
        view: `depth` may come from a sensor or a network; it is taken as it is.
        drop_border: leave out what stands on the border around the picture: 196 608 instead of 286 720 Gaussians. The
            border is kept by default, as published: its Gaussians stand for surfaces just outside the picture.
        dtype: of the layers that autocast may compute in less than float32; everything behind them never is.
    Raises:
        ReconstructionError: no depth. ConfigError: a dtype that cannot be. ModelError: Gaussians that are not finite,
        too little memory.
    """
    if dtype not in DTYPES:
        raise ConfigError(f"dtype {dtype}: expected one of {', '.join(sorted(map(str, DTYPES)))}")
    given = flash3d_input(view)
    device = next(network.parameters()).device
    try:
        picture = torch.from_numpy(given.picture).to(device).permute(2, 0, 1)[None].float() / 255
        depth = torch.from_numpy(given.depth).to(device)[None, None]
        with torch.inference_mode(), torch.autocast(device.type, dtype, enabled=dtype != torch.float32):
            maps = network(picture, depth)
        gaussians = gaussians_of(maps, given.K, given.known, drop_border)
    except torch.cuda.OutOfMemoryError as error:
        raise ModelError(
            f"out of memory on {device}: Flash3D needs about 1 GB. Free some, or use the CPU ({error})"
        ) from None
    if not (np.isfinite(gaussians.means).all() and np.isfinite(gaussians.covariances).all()):
        raise ModelError(f"the network returned NaN or infinity in {dtype}: expected Gaussians. Is float32 needed?")
    return gaussians


def gaussians_of(maps: GaussianMaps, K: Float64Array, known: Bool, drop_border: bool = False) -> Flash3DGaussians:
    """Maps over pixels -> list of Gaussians. K and known as in `Flash3DInput`."""
    index = np.arange(LAYERS * known.size)
    if drop_border:
        inner = np.zeros(PADDED, bool)
        inner[PAD:-PAD, PAD:-PAD] = True
        index = index[np.tile(inner.ravel(), LAYERS)]
    return Flash3DGaussians(
        means=_listed(unprojected(maps.depth, K) + maps.offset, index),
        covariances=_listed(covariances_of(maps.sigmas, maps.rotation), index).reshape(-1, 3, 3),
        opacities=_listed(maps.opacity, index)[:, 0] * known.ravel()[index % known.size],
        colours=_listed((SH_CONSTANT * maps.harmonics + 0.5).clamp(0, 1), index),
        index=index,
        depth=maps.depth[:, 0].cpu().numpy(),
        K=K,
    )


def unprojected(depth: Tensor, K: Float64Array) -> Tensor:
    """Depth (B, 1, H, W) m along z -> points (B, 3, H, W) m through the pixel centres."""
    height, width = depth.shape[-2:]
    fx, fy, cx, cy = (float(K[i, j]) for i, j in ((0, 0), (1, 1), (0, 2), (1, 2)))
    x = (torch.arange(width, device=depth.device) + (0.5 - cx)) / fx
    y = (torch.arange(height, device=depth.device) + (0.5 - cy)) / fy
    return torch.cat((depth * x, depth * y[:, None], depth), dim=1)


def covariances_of(sigmas: Tensor, rotation: Tensor) -> Tensor:
    """Sigmas (B, 3, H, W) m and unit quaternions w, x, y, z (B, 4, H, W) -> R diag(s^2) R^T (B, 9, H, W), row-major."""
    w, x, y, z = rotation.unbind(1)
    rows = (
        (1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)),
        (2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)),
        (2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)),
    )
    spans = [torch.stack(row, dim=1) * sigmas for row in rows]  # row i of R diag(s)
    return torch.stack([(a * b).sum(dim=1) for a in spans for b in spans], dim=1)


def _listed(maps: Tensor, index: IntArray) -> Float32Array:
    """(2, C, H, W) -> the rows `index` of the list (2HW, C)."""
    return np.asarray(maps.permute(0, 2, 3, 1).flatten(0, 2).cpu().numpy()[index], np.float32)


def gaussians_to_mixture(
    gaussians: Flash3DGaussians,
    view: View,
    lifting: Lifting | None = None,
    labels: IntArray | None = None,
    along_curve: bool = True,
) -> Mixture:
    """Mixture in the view's optical frame, with the view's frustum.

    A weight is the opacity times the area that the pixel covers at the mean, z^2 / (fx fy): as with lifted depth, near
    surfaces do not count more often than far ones. The sigmas are not used, because the network may make one Gaussian
    large to fill a gap. With `lifting.weighting` "equal" a weight is the opacity alone, on which the published method
    has its threshold.

    Args:
        gaussians: of this view.
        view: with the depth that the network was given.
        lifting: means out of its range and Gaussians fainter than 1/255 are left out. Default: `Lifting()`.
        labels: HxW integers on the view's pixels; both Gaussians of a pixel share its label.
        along_curve: list the pixels along a Z-order curve, so that every n-th component is an even subsample; False
            keeps the order of the Gaussians, from which the published method takes every 32nd.
    Raises:
        ReconstructionError: no depth, or fewer than 50 usable Gaussians.
        InputError: labels of another shape or type.
    """
    lifting = lifting or Lifting()
    if view.depth is None:
        raise MissingDepthError("the view has no depth: expected the one that Flash3D was given")
    z = gaussians.means[:, 2]
    usable = (z >= lifting.min_range_m) & (z <= lifting.max_range_m) & (gaussians.opacities >= MIN_OPACITY)
    kept = np.flatnonzero(usable)
    if len(kept) < MIN_COMPONENTS:
        raise ReconstructionError(
            f"{len(kept)} usable Gaussians of {len(z)}: expected at least {MIN_COMPONENTS} with opacity from 1/255 and "
            f"z in {lifting.min_range_m:g}..{lifting.max_range_m:g} m. Check the unit of the depth"
        )
    if along_curve:
        kept = kept[np.argsort(_place_on_curve(gaussians.index[kept]), kind="stable")]
    area = z[kept] ** 2 / np.float32(gaussians.K[0, 0] * gaussians.K[1, 1])
    return Mixture(
        means=gaussians.means[kept],
        covariances=definite(gaussians.covariances[kept]),
        weights=gaussians.opacities[kept] * (area if lifting.weighting == "area" else np.float32(1)),
        colours=gaussians.colours[kept],
        labels=None if labels is None else labels_of(labels, view, gaussians.index[kept]),
        frustum=frustum_of(view, in_range(view.depth, lifting), lifting),
    )


def labels_of(labels: IntArray, view: View, index: IntArray) -> IntArray:
    """HxW labels of the view's pixels -> one per Gaussian `index`. Raises InputError for another shape or type."""
    size = view.rgb.shape[:2]
    if labels.shape != size or labels.dtype.kind not in "iu":
        raise InputError(f"labels are {labels.dtype} of shape {labels.shape}: expected {size} integers, one per pixel")
    small = labels[np.ix_(nearest_index(size[0], HEIGHT), nearest_index(size[1], WIDTH))]
    padded = np.pad(small, PAD, mode="edge").ravel()
    return padded[index % padded.size]


def definite(covariances: Float32Array) -> Float32Array:
    """Add a thousandth of a Gaussian's own size and 0.01 mm to its sigmas, in squares: definite also in float32."""
    floor = RELATIVE_FLOOR * np.trace(covariances, axis1=1, axis2=2) + ABSOLUTE_FLOOR_M2
    return np.asarray(covariances + floor[:, None, None] * np.eye(3, dtype=np.float32), np.float32)


def _place_on_curve(index: IntArray) -> IntArray:
    """Position along the Z-order curve of the padded picture; the layers of a pixel follow each other."""
    rows, columns = z_order(*PADDED)
    place = np.empty(len(rows), np.int64)
    place[rows * PADDED[1] + columns] = np.arange(len(rows))
    layer, pixel = np.divmod(index, len(rows))
    return np.asarray(LAYERS * place[pixel] + layer)
