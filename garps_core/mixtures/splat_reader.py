# SPDX-License-Identifier: Apache-2.0
"""Reader of 3D Gaussian Splatting PLY files, by `splat_writer.py` or by other programs, into mixtures.

Per component x y z, f_dc_0..2 (colour as the constant spherical harmonic), opacity (logit), scale_0..2 (log of the
sigmas), rot_0..3 (quaternion w, x, y, z, any length); other properties are ignored. The coordinates must be those
of the camera: x right, y down, z forward, metres. Some programs add the camera as the elements `intrinsic` (3x3
numbers) and `image_size` (width, height): then the mixture gets a frustum.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import Rotation

from garps_core.checks import Float32Array, Float64Array, checked_intrinsics
from garps_core.errors import InputError
from garps_core.mixtures.splat_writer import SH_CONSTANT
from garps_core.types import MAX_IMAGE_PIXELS, Frustum, Mixture

MAX_HEADER_BYTES = 65536
TYPES = {
    **{"char": "i1", "int8": "i1", "uchar": "u1", "uint8": "u1", "short": "<i2", "int16": "<i2"},
    **{"ushort": "<u2", "uint16": "<u2", "int": "<i4", "int32": "<i4", "uint": "<u4", "uint32": "<u4"},
    **{"float": "<f4", "float32": "<f4", "double": "<f8", "float64": "<f8"},
}
MEANS, COLOURS = ("x", "y", "z"), ("f_dc_0", "f_dc_1", "f_dc_2")
SCALES, ROTATION = ("scale_0", "scale_1", "scale_2"), ("rot_0", "rot_1", "rot_2", "rot_3")
NEEDED = (*MEANS, *COLOURS, "opacity", *SCALES, *ROTATION)

RELATIVE_FLOOR = 1e-3
"""Smallest sigma as a share of a component's largest; thinner components would not be definite in float32."""
SIGMA_FLOOR_M = 1e-5
SOLID_OPACITY = 0.5
"""Smallest opacity of a component that occludes others."""
FRUSTUM_CELLS = 320
"""Cells of the coarse depth map along the longer side of the picture."""

Table = npt.NDArray[Any]


@dataclass(frozen=True)
class _Element:
    """A table of the file; fields None = it has lists, so its length in bytes is not known."""

    name: str
    count: int
    fields: np.dtype[Any] | None
    start: int | None

    @property
    def end(self) -> int | None:
        if self.fields is None or self.start is None:
            return None
        return self.start + self.count * self.fields.itemsize


def read_splats(path: str | Path, min_opacity: float = 0.0, weighting: str = "area") -> Mixture:
    """Read a binary little-endian splat PLY file.

    A weight is the opacity times the product of the two larger sigmas: the surface that a splat covers, which for files
    of `write_splats` is again the area that the component stood for. With `weighting` "equal" it is the opacity alone.

    Args:
        path: the file.
        min_opacity: components below, 0..1, are left out.
        weighting: "area" or "equal".
    Returns:
        Mixture of float32 arrays in the order of the file; frustum None unless the file has a camera.
    Raises:
        InputError: another kind of PLY, a missing property, a file that is too short, NaN, no components.
    """
    path = Path(path)
    if not 0 <= min_opacity <= 1 or weighting not in ("area", "equal"):
        raise InputError(
            f"min_opacity is {min_opacity!r}, weighting {weighting!r}: expected 0..1, and 'area' or 'equal'"
        )
    elements = _read_header(path)
    rows = _read_table(path, _vertex_of(path, elements))
    opacities = _opacities(path, rows["opacity"])
    kept = opacities >= min_opacity
    if not kept.any():
        raise InputError(
            f"{path}: none of {len(rows)} components has opacity from {min_opacity:g}: expected a lower one"
        )
    rows, opacities = rows[kept], opacities[kept]
    means = _columns(path, rows, MEANS)
    sigmas, covariances = _covariances(path, rows)
    area = sigmas[:, 1] * sigmas[:, 2]
    try:
        return Mixture(
            means=means.astype(np.float32),
            covariances=covariances,
            weights=(opacities * (area if weighting == "area" else 1.0)).astype(np.float32),
            colours=np.clip(0.5 + SH_CONSTANT * _columns(path, rows, COLOURS), 0, 1).astype(np.float32),
            frustum=_frustum(path, elements, means[opacities >= SOLID_OPACITY]),
        )
    except InputError as error:
        raise InputError(f"{path}: {error}") from None


def _covariances(path: Path, rows: Table) -> tuple[Float64Array, Float32Array]:
    """Sigmas Nx3 m, ascending, and Nx3x3 float32 m^2, definite."""
    quaternions = _columns(path, rows, ROTATION)
    if not quaternions.any(axis=1).all():
        bad = int(np.flatnonzero(~quaternions.any(axis=1))[0])
        raise InputError(f"{path}: component {bad} has rotation 0 0 0 0: expected a quaternion w, x, y, z")
    with np.errstate(over="ignore"):
        sigmas = np.exp(_columns(path, rows, SCALES))
    largest = sigmas.max(axis=1, keepdims=True)
    if not largest.max() < 1e6:
        raise InputError(f"{path}: a component has a sigma of {largest.max():.3g} m: expected logarithms in scale_0..2")
    sigmas = np.maximum(sigmas, np.maximum(RELATIVE_FLOOR * largest, SIGMA_FLOOR_M))
    spans = Rotation.from_quat(quaternions[:, [1, 2, 3, 0]]).as_matrix() * sigmas[:, None, :]
    return np.sort(sigmas, axis=1), (spans @ spans.transpose(0, 2, 1)).astype(np.float32)


def _opacities(path: Path, logits: Table) -> Float64Array:
    """Opacities 0..1 of logits; writers store 0 and 1 as infinite logits."""
    if np.isnan(logits).any():
        raise InputError(f"{path}: opacity of component {int(np.isnan(logits).argmax())} is NaN: expected a logit")
    return np.asarray(1 / (1 + np.exp(-logits.astype(np.float64).clip(-500, 500))))


def _columns(path: Path, rows: Table, names: tuple[str, ...]) -> Float64Array:
    """Properties by name as N x len(names) float64, finite."""
    table = np.stack([rows[name].astype(np.float64) for name in names], axis=1)
    good = np.isfinite(table).all(axis=1)
    if not good.all():
        raise InputError(
            f"{path}: {np.count_nonzero(~good)} of {len(rows)} components have NaN or infinity in {' '.join(names)}, "
            f"the first of them is {int(good.argmin())}: expected finite numbers"
        )
    return table


def _vertex_of(path: Path, elements: dict[str, _Element]) -> _Element:
    vertex = elements.get("vertex")
    if vertex is None or vertex.fields is None or vertex.end is None:
        raise InputError(
            f"{path} has no plain element vertex ({', '.join(elements) or 'no elements'}): expected splats"
        )
    for name in NEEDED:
        given = vertex.fields[name] if name in (vertex.fields.names or ()) else None
        if given is None or given.kind != "f":
            raise InputError(
                f"{path}: property {name} is {given or 'missing'}: expected float or double; "
                "a point cloud or mesh has no splats; compressed splat files must be unpacked first"
            )
    if vertex.count == 0:
        raise InputError(f"{path} has 0 components: expected at least one")
    return vertex


def _read_table(path: Path, element: _Element) -> Table:
    """The rows of an element, after a check of the length of the file."""
    size = path.stat().st_size
    if element.start is None or element.end is None or element.end > size:
        raise InputError(
            f"{path} has {size} bytes: its header announces {element.count} rows of {element.name}, "
            f"up to byte {element.end}; the file is cut off"
        )
    with path.open("rb") as file:
        return np.fromfile(file, element.fields, element.count, offset=element.start)


def _read_header(path: Path) -> dict[str, _Element]:
    """Tables of the file by name, in its order."""
    try:
        with path.open("rb") as file:
            start = file.read(MAX_HEADER_BYTES)
    except OSError as error:
        raise InputError(f"cannot read {path} ({error.strerror}): expected a splat PLY file") from None
    if start.split(b"\n", 1)[0].strip() != b"ply":
        raise InputError(f"{path} does not begin with 'ply': expected a splat PLY file")
    header, end, rest = start.partition(b"end_header")
    if not end or not rest.startswith((b"\n", b"\r\n")):
        raise InputError(f"{path}: no end_header in its first {len(start)} bytes: expected a whole PLY header")
    lines = [line.split() for line in header.decode("ascii", "replace").splitlines()[1:]]
    _check_format(path, [words[1:] for words in lines if words[:1] == ["format"]])
    length = len(header) + len(end) + rest.index(b"\n") + 1
    return _elements_of(path, [words for words in lines if words[:1] in (["element"], ["property"])], length)


def _check_format(path: Path, formats: list[list[str]]) -> None:
    given = " ".join(formats[0]) if formats else "missing"
    if given != "binary_little_endian 1.0":
        raise InputError(f"{path}: format is {given}: expected binary_little_endian 1.0. Write it again in that format")


def _elements_of(path: Path, lines: list[list[str]], start: int | None) -> dict[str, _Element]:
    """Element and property lines -> where each table begins; that is not known behind one with lists."""
    blocks: list[tuple[str, int, list[list[str]]]] = []
    for words in lines:
        if words[0] == "element" and len(words) == 3 and words[2].isdecimal() and len(words[2]) < 19:
            blocks.append((words[1], int(words[2]), []))
        elif words[0] == "property" and blocks and len(words) >= 3:
            blocks[-1][2].append(words[1:])
        else:
            raise InputError(
                f"{path}: header line {' '.join(words)!r}: expected element NAME COUNT or property TYPE NAME"
            )
    elements: dict[str, _Element] = {}
    for name, count, properties in blocks:
        elements[name] = _Element(name, count, _fields_of(path, properties), start)
        start = elements[name].end
    return elements


def _fields_of(path: Path, properties: list[list[str]]) -> np.dtype[Any] | None:
    if any(words[0] == "list" for words in properties):
        return None
    names = [words[-1] for words in properties]
    unknown = [words[0] for words in properties if words[0] not in TYPES]
    if unknown or len(set(names)) != len(names):
        raise InputError(
            f"{path}: property types {unknown}, {len(names) - len(set(names))} names twice: "
            f"expected each name once and one of {', '.join(TYPES)}"
        )
    return np.dtype([(name, TYPES[words[0]]) for name, words in zip(names, properties, strict=True)])


def _frustum(path: Path, elements: dict[str, _Element], solid: Float64Array) -> Frustum | None:
    """Frustum of the camera in the file, or None without one; solid: Mx3 m, means of the components that occlude."""
    intrinsic, size, extrinsic = (_numbers(path, elements, n) for n in ("intrinsic", "image_size", "extrinsic"))
    if intrinsic is None or size is None:
        return None
    if intrinsic.size != 9 or size.size != 2 or not 0 < size.prod() <= MAX_IMAGE_PIXELS or size.min() < 1:
        raise InputError(
            f"intrinsic {intrinsic}, image_size {size}: expected 9 numbers, and width and height in pixels"
        )
    if extrinsic is not None and not np.array_equal(extrinsic, np.eye(4).ravel()):
        raise InputError("extrinsic is not the identity: expected splats in the frame of their own camera")
    step = max(1.0, float(size.max()) / FRUSTUM_CELLS)
    K = checked_intrinsics(intrinsic.reshape(3, 3)).copy()
    K[:2] /= step
    K[:2, 2] -= 0.5  # such files count from pixel edges, a frustum from pixel centres
    width, height = (max(1, int(side / step)) for side in size)
    return Frustum(K, _nearest_depth(solid[solid[:, 2] > 0], K, width, height))


def _nearest_depth(points: Float64Array, K: Float64Array, width: int, height: int) -> Float32Array:
    """Least z of the points in every cell, NaN in empty ones; height x width m."""
    u, v = (np.rint(points[:, i] / points[:, 2] * K[i, i] + K[i, 2]) for i in (0, 1))
    inside = (u >= 0) & (u < width) & (v >= 0) & (v < height)
    depth = np.full((height, width), np.inf, np.float32)
    np.minimum.at(depth, (v[inside].astype(int), u[inside].astype(int)), points[inside, 2].astype(np.float32))
    depth[np.isinf(depth)] = np.nan
    return depth


def _numbers(path: Path, elements: dict[str, _Element], name: str) -> Float64Array | None:
    """A small element of one property as a list of numbers; None when the file has none that can be found."""
    element = elements.get(name)
    if element is None or element.fields is None or element.end is None or element.count > 16:
        return None
    names = element.fields.names or ()
    return np.asarray(_read_table(path, element)[names[0]], np.float64) if len(names) == 1 else None
