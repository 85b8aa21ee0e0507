# SPDX-License-Identifier: Apache-2.0
"""Textured triangle soups: boxes, lathed shapes, superellipsoids and leaves.

A piece of furniture is built in its own frame: x right and z up as seen by someone who faces it, y away from that
person, the floor at z = 0 and the wall behind it at y = 0 (so the piece fills y < 0). Texture coordinates are
metres on the surface, u right and v down, so that a texture never stretches.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from bench.rooms.textures import Texture

Array = npt.NDArray[np.float64]

LABELS = (
    "void", "wall", "floor", "ceiling", "door", "window", "picture", "table", "chair", "sofa",
    "shelf", "book", "cabinet", "lamp", "plant", "box", "ball", "vase", "rug", "trim",
)  # fmt: skip


@dataclass(frozen=True, eq=False)
class Part:
    """Triangles that share one texture and one label.

    Args:
        corners: Mx3x3 m, triangle corners.
        uv: Mx3x2 m on the texture.
        normals: Mx3x3 unit, at the corners.
        patch: M integers, equal on triangles of one smooth surface (shading is only filtered within a patch).
        texture: what it is painted with.
        label: one of `LABELS`.
    """

    corners: Array
    uv: Array
    normals: Array
    patch: npt.NDArray[np.int64]
    texture: Texture
    label: str

    def moved(self, yaw: float, shift: Sequence[float]) -> Part:
        """Turned about z by `yaw` rad, then shifted by 3 metres."""
        c, s = np.cos(yaw), np.sin(yaw)
        R = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
        return self.transformed(R, shift)

    def transformed(self, R: Array, shift: Sequence[float]) -> Part:
        """Rigid motion x -> R x + shift."""
        return replace(self, corners=self.corners @ R.T + np.asarray(shift, float), normals=self.normals @ R.T)


def moved(parts: Iterable[Part], yaw: float = 0.0, shift: Sequence[float] = (0.0, 0.0, 0.0)) -> list[Part]:
    """All parts turned about z and shifted."""
    return [part.moved(yaw, shift) for part in parts]


def bounds(parts: Sequence[Part]) -> Array:
    """2x3 m: lowest and highest corner of all parts."""
    points = np.concatenate([part.corners.reshape(-1, 3) for part in parts])
    return np.stack([points.min(axis=0), points.max(axis=0)])


_FACES: dict[str, tuple[tuple[int, float], tuple[int, float], tuple[int, float]]] = {
    # name: (axis, side) of the normal, then of u and of v
    "front": ((1, -1), (0, 1), (2, -1)),
    "back": ((1, 1), (0, -1), (2, -1)),
    "right": ((0, 1), (1, 1), (2, -1)),
    "left": ((0, -1), (1, -1), (2, -1)),
    "top": ((2, 1), (0, 1), (1, -1)),
    "bottom": ((2, -1), (0, 1), (1, 1)),
}


def box(
    low: Sequence[float],
    high: Sequence[float],
    texture: Texture,
    label: str,
    uv0: Sequence[float] = (0.0, 0.0),
    faces: Sequence[str] = tuple(_FACES),
) -> Part:
    """Axis-aligned box; on each face uv starts at `uv0` in the upper left corner as seen from outside."""
    lo, hi = np.asarray(low, float), np.asarray(high, float)
    size = hi - lo
    corners, uv, normals = [], [], []
    for name in faces:
        (axis, side), (ua, us), (va, vs) = _FACES[name]
        quad = np.empty((4, 3))
        st = np.array([[0, 0], [1, 0], [1, 1], [0, 1]], float)
        quad[:, axis] = hi[axis] if side > 0 else lo[axis]
        for column, (a, sign) in enumerate(((ua, us), (va, vs))):
            t = st[:, column]
            quad[:, a] = lo[a] + size[a] * (t if sign > 0 else 1 - t)
        normal = np.zeros(3)
        normal[axis] = side
        texel = np.asarray(uv0, float) + st * (size[ua], size[va])
        for tri in ((0, 1, 2), (0, 2, 3)):
            corners.append(quad[list(tri)])
            uv.append(texel[list(tri)])
            normals.append(np.tile(normal, (3, 1)))
    patch = np.repeat(np.arange(len(faces)), 2)
    return Part(np.array(corners), np.array(uv), np.array(normals), patch, texture, label)


def board(
    low: Sequence[float], high: Sequence[float], texture: Texture, label: str, uv0: Sequence[float] = (0.0, 0.0)
) -> Part:
    """Like `box`, with u along the longer side of each face, as grain runs in wood."""
    part = box(low, high, texture, label, uv0)
    quads = part.uv.reshape(-1, 6, 2)
    extent = np.ptp(quads, axis=1)
    upright = extent[:, 1] > extent[:, 0]
    quads[upright] = quads[upright][..., ::-1]
    return part


def _sheet(points: Array, uv: Array, normals: Array, texture: Texture, label: str) -> Part:
    """Triangulate an RxC grid of points with uv and normals."""
    rows, cols = points.shape[:2]
    i, j = (a.ravel() for a in np.mgrid[: rows - 1, : cols - 1])
    first = np.stack([i * cols + j, i * cols + j + 1, (i + 1) * cols + j + 1], axis=1)
    second = np.stack([i * cols + j, (i + 1) * cols + j + 1, (i + 1) * cols + j], axis=1)
    index = np.concatenate([first, second])
    p, t, n = points.reshape(-1, 3), uv.reshape(-1, 2), normals.reshape(-1, 3)
    n = n / np.maximum(np.linalg.norm(n, axis=1, keepdims=True), 1e-9)
    return Part(p[index], t[index], n[index], np.zeros(len(index), np.int64), texture, label)


def lathe(profile: Sequence[tuple[float, float]], texture: Texture, label: str, segments: int = 28) -> Part:
    """Surface of revolution about z from (radius, height) pairs in m, bottom to top."""
    r, z = np.asarray(profile, float).T
    angle = np.linspace(0, 2 * np.pi, segments + 1)
    A, r_, z_ = angle[None, :], r[:, None], z[:, None]
    points = np.stack(np.broadcast_arrays(r_ * np.cos(A), r_ * np.sin(A), z_), axis=-1)
    slope_r, slope_z = np.gradient(r), np.gradient(z)
    normals = np.stack(
        np.broadcast_arrays(slope_z[:, None] * np.cos(A), slope_z[:, None] * np.sin(A), -slope_r[:, None]), axis=-1
    )
    along = np.concatenate([[0], np.cumsum(np.hypot(np.diff(r), np.diff(z)))])
    uv = np.stack(np.broadcast_arrays(A * r.max(), along.max() - along[:, None]), axis=-1)
    return _sheet(points, uv, normals, texture, label)


def cylinder(radius: float, low: float, high: float, texture: Texture, label: str, segments: int = 24) -> list[Part]:
    """Upright cylinder with flat caps, m."""
    side = lathe([(radius, low), (radius, high)], texture, label, segments)
    caps = [_cap(radius, z, sign, texture, label, segments) for z, sign in ((low, -1.0), (high, 1.0))]
    return [side, *caps]


def _cap(radius: float, z: float, sign: float, texture: Texture, label: str, segments: int) -> Part:
    angle = np.linspace(0, 2 * np.pi, segments + 1)
    rim = np.stack([radius * np.cos(angle), radius * np.sin(angle)], axis=1)
    flat = np.stack([np.zeros_like(rim), rim])
    points = np.concatenate([flat, np.full((*flat.shape[:2], 1), z)], axis=-1)
    normals = np.zeros_like(points)
    normals[..., 2] = sign
    return _sheet(points, flat + radius, normals, texture, label)


def superellipsoid(radii: Sequence[float], texture: Texture, label: str, power: float = 1.0, n: int = 24) -> Part:
    """Ellipsoid with semi-axes in m about the origin; `power` < 1 makes it squarer (0.4 is a cushion)."""
    theta = np.linspace(-np.pi / 2, np.pi / 2, n // 2 + 1)[:, None]
    phi = np.linspace(0, 2 * np.pi, n + 1)[None, :]

    def bend(x: Array, p: float) -> Array:
        return np.sign(x) * np.abs(x) ** p

    def direction(p: float) -> Array:
        x = bend(np.cos(theta), p) * bend(np.cos(phi), p)
        y = bend(np.cos(theta), p) * bend(np.sin(phi), p)
        return np.stack(np.broadcast_arrays(x, y, bend(np.sin(theta), p)), axis=-1)

    points = direction(power) * np.asarray(radii, float)
    # At the poles and on the axes the analytic normal vanishes for power > 1 only; here power <= 1.
    normals = direction(max(2 - power, 1.0)) / np.asarray(radii, float)
    mean = float(np.mean(radii))
    uv = np.stack(np.broadcast_arrays(phi * mean * np.ones_like(theta), -theta * mean), axis=-1)
    part = _sheet(points, uv, normals, texture, label)
    return part if power > 0.7 else replace(part, uv=_boxed(part.corners))


def _boxed(corners: Array) -> Array:
    """Mx3x2 m: uv of Mx3x3 triangles projected along their main direction, as cloth is sewn onto a cushion."""
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    axes = np.array([[1, 2], [0, 2], [0, 1]])[np.abs(normal).argmax(axis=1)]
    return np.take_along_axis(corners, np.repeat(axes[:, None], 3, axis=1), axis=2)


def leaf(base: Array, tip: Array, width: float, texture: Texture, label: str, droop: float = 0.3) -> Part:
    """A bent blade from `base` to `tip` (m), widest in the middle, its end hanging by `droop` of its length."""
    t = np.linspace(0, 1, 5)[:, None]
    length = float(np.linalg.norm(tip - base))
    spine = base + t * (tip - base) + np.array([0, 0, droop * length]) * (t - 2 * t**2)
    across = np.cross(tip - base, [0.0, 0.0, 1.0])
    across /= max(float(np.linalg.norm(across)), 1e-6)
    half = 0.5 * width * np.sin(np.pi * (0.08 + 0.9 * t))
    points = np.stack([spine - half * across, spine, spine + half * across], axis=1)
    points[:, 1, 2] -= 0.15 * width
    uv = np.stack(np.broadcast_arrays(np.array([-0.5, 0, 0.5])[None, :] * width, t * length), axis=-1)
    tangent = np.gradient(spine, axis=0)
    normal = np.cross(np.broadcast_to(across, tangent.shape), tangent)
    return _sheet(points, uv, np.repeat(normal[:, None], 3, axis=1), texture, label)
