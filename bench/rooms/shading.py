# SPDX-License-Identifier: Apache-2.0
"""Light: surface colour, soft shadows, ambient occlusion, and the camera's tone curve and noise.

A surface point has one colour whatever camera looks at it: textures live on surfaces and all light is diffuse.
"""

from __future__ import annotations

import cv2
import numpy as np
import numpy.typing as npt

from bench.rooms.mesh import Array
from bench.rooms.scene import Float32Array, Hits, Scene

TILE = 4  # shadow rays use 16 light points and directions, a different one at each place of a 4x4 tile
AMBIENT = np.array([0.40, 0.41, 0.43], np.float32)
OCCLUSION_M = 0.45
BAND_ROWS = 24
MID_GREY = 0.33
TO_LINEAR = ((np.arange(256) / 255) ** 2.2).astype(np.float32)


def radiance(
    room: Scene, T: Array, K: Array, width: int, height: int, samples: int, centre: Hits | None = None
) -> Float32Array:
    """HxWx3 linear light that reaches the camera at T_world_camera, mean over samples x samples rays per pixel.

    Surfaces are sampled on the fine grid; visibility, the expensive part, once per pixel. `centre` are the hits of
    the pixel centres, if they are known.
    """
    patch, open_to = _pixel_visibility(room, T, K, (height, width), centre)
    out = np.empty((height, width, 3), np.float32)
    for top in range(0, height, BAND_ROWS):  # bands fit into the processor's cache
        bottom = min(top + BAND_ROWS, height)
        shifted = K.copy()
        shifted[1, 2] -= top
        light = _band(room, T, shifted, (bottom - top, width), samples, patch, open_to, top)
        out[top:bottom] = cv2.resize(light, (width, bottom - top), interpolation=cv2.INTER_AREA)
    return out


def _band(
    room: Scene,
    T: Array,
    K: Array,
    size: tuple[int, int],
    samples: int,
    patch: npt.NDArray[np.int32],
    open_to: Float32Array,
    top: int,
) -> Float32Array:
    """Light (h s)x(w s)x3 of the samples of `size` pixels, the first row being row `top` of the visibility map."""
    height, width = size
    rays = camera_rays(K, width, height, samples).reshape(-1, 3) @ T[:3, :3].T.astype(np.float32)
    hits = room.cast(T[:3, 3], rays)
    face = np.maximum(hits.face, 0)
    normals = _normals(room, hits, face, rays)
    albedo, glow = _surface(room, hits, face, normals, rays, 1 / (K[0, 0] * samples))
    points = T[:3, 3].astype(np.float32) + rays * hits.t[:, None]
    fine = room.patch[face].reshape(height * samples, width * samples)
    light = _irradiance(room, points, normals, open_to[_source(patch, fine, samples, top)])
    out = albedo * (light + glow[:, None])
    out[hits.face < 0] = 0
    return np.asarray(out.reshape(*fine.shape, 3), np.float32)


def camera_rays(K: Array, width: int, height: int, samples: int = 1) -> Float32Array:
    """(H s)x(W s)x3 rays with z = 1 through an even grid of s x s samples per pixel; pixel centres at integers."""
    u = (np.arange(width * samples) + 0.5) / samples - 0.5
    v = (np.arange(height * samples) + 0.5) / samples - 0.5
    rays = np.ones((height * samples, width * samples, 3), np.float32)
    rays[..., 0] = (u - K[0, 2]) / K[0, 0]
    rays[..., 1] = ((v - K[1, 2]) / K[1, 1])[:, None]
    return rays


def _pixel_visibility(
    room: Scene, T: Array, K: Array, size: tuple[int, int], hits: Hits | None
) -> tuple[npt.NDArray[np.int32], Float32Array]:
    """Patch ids HxW at the pixel centres, and their visibility (H W)x(1+L)."""
    height, width = size
    rays = camera_rays(K, width, height).reshape(-1, 3) @ T[:3, :3].T.astype(np.float32)
    hits = room.cast(T[:3, 3], rays) if hits is None else hits
    face = np.maximum(hits.face, 0)
    patch = room.patch[face].reshape(size)
    points = T[:3, 3].astype(np.float32) + rays * hits.t[:, None]
    return patch, _visibility(room, points, _normals(room, hits, face, rays), patch)


def _source(patch: npt.NDArray[np.int32], fine: npt.NDArray[np.int32], samples: int, top: int) -> npt.NDArray[np.int64]:
    """For each fine sample, the pixel (flat index) of the same surface whose visibility it takes."""
    height, width = patch.shape
    rows = np.arange(fine.shape[0])[:, None] // samples + top
    cols = np.arange(fine.shape[1])[None, :] // samples
    source = np.asarray(rows * width + cols, np.int64).ravel()
    flat, wanted = patch.ravel(), fine.ravel()
    # At an edge the pixel's centre is on another surface for some samples: look for theirs among the neighbours.
    lost = np.flatnonzero(flat[source] != wanted)
    y, x = np.divmod(source[lost], width)
    for dy, dx in ((0, 1), (0, -1), (1, 0), (-1, 0), (1, 1), (-1, -1), (1, -1), (-1, 1)):
        near = np.clip(y + dy, 0, height - 1) * width + np.clip(x + dx, 0, width - 1)
        found = flat[near] == wanted[lost]
        source[lost[found]] = near[found]
        lost, y, x = lost[~found], y[~found], x[~found]
    return source


def _normals(room: Scene, hits: Hits, face: npt.NDArray[np.int64], rays: Float32Array) -> Float32Array:
    """Nx3 unit shading normals that look towards the camera."""
    corner = room.normals[:, 0]
    out = corner[face]
    bent = np.flatnonzero(room.smooth[face])
    n, u, v = room.normals[face[bent]], hits.u[bent, None], hits.v[bent, None]
    mixed = (1 - u - v) * n[:, 0] + u * n[:, 1] + v * n[:, 2]
    out[bent] = mixed / np.maximum(np.linalg.norm(mixed, axis=1, keepdims=True), 1e-6)
    away = np.einsum("ij,ij->i", out, rays) > 0
    out[away] *= -1
    return out


def _surface(
    room: Scene, hits: Hits, face: npt.NDArray[np.int64], normals: Float32Array, rays: Float32Array, pixel: float
) -> tuple[Float32Array, Float32Array]:
    """Linear albedo Nx3 and glow N; the mip level follows the size of a sample on the surface."""
    corner = room.uv
    edge1, edge2 = corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0]
    uv = corner[face, 0] + hits.u[:, None] * edge1[face] + hits.v[:, None] * edge2[face]
    texel = np.array([t.texel_m for t in room.textures], np.float32)
    top = np.array([len(t.levels) - 1 for t in room.textures], np.int64)
    which = room.texture[face]
    tilt = np.abs(np.einsum("ij,ij->i", normals, rays)) / np.linalg.norm(rays, axis=1)
    spot = hits.t * np.float32(pixel) / np.sqrt(np.maximum(tilt, 0.05))
    level = np.clip(np.round(np.log2(spot / texel[which] + 1e-6)), 0, top[which]).astype(np.int16)
    key = which * np.int16(8) + level
    order = np.argsort(key, kind="stable")
    starts = np.flatnonzero(np.diff(key[order], prepend=np.int16(-1)))
    colour = np.empty((len(face), 3), np.uint8)
    uv = uv[order]
    for begin, end in zip(starts, [*starts[1:], len(order)], strict=True):
        k = int(key[order[begin]])
        colour[order[begin:end]] = room.textures[k // 8].sample(uv[begin:end], k % 8)
    glow = np.array([t.glow for t in room.textures], np.float32)[which]
    return TO_LINEAR[colour], glow / np.float32(room.gain)


def _visibility(room: Scene, points: Float32Array, normals: Float32Array, patch: npt.NDArray[np.int32]) -> Float32Array:
    """Nx(1+L), 0..1: openness to the surroundings and to each light of N = HxW points, shared within 4x4 tiles."""
    height, width = patch.shape
    y, x = np.arange(height)[:, None] % TILE, np.arange(width)[None, :] % TILE
    turn = ((7 * (TILE * y + x)) % TILE**2).ravel()
    start = points + np.float32(2e-3) * normals
    layers = [_ambient(room, start, normals, turn)]
    for light in room.lights:
        way = light.points.astype(np.float32)[turn] - start
        layers.append(1 - room.blocked(start, way).astype(np.float32))
    return _share(np.stack(layers, axis=-1).reshape(height, width, -1), patch).reshape(height * width, -1)


def _irradiance(room: Scene, points: Float32Array, normals: Float32Array, open_to: Float32Array) -> Float32Array:
    """Nx3 light that falls on N points with their visibility Nx(1+L)."""
    strength = [open_to[:, 0]]
    for k, light in enumerate(room.lights):
        strength.append(open_to[:, k + 1] * _falloff(light.points, light.normal, points, normals))
    power = np.array([AMBIENT, *(light.power for light in room.lights)], np.float32)
    return np.stack(strength, axis=1) @ power


def _ambient(room: Scene, start: Float32Array, normals: Float32Array, turn: npt.NDArray[np.int64]) -> Float32Array:
    """N values 0..1: how open the half space is, from one cosine-distributed ray each."""
    k = np.arange(TILE**2)
    z = 1 - (2 * k + 1) / TILE**2
    r = np.sqrt(1 - z**2)
    sphere = np.stack([r * np.cos(2.39996 * k), r * np.sin(2.39996 * k), z], axis=1).astype(np.float32)
    way = normals * np.float32(1.02) + sphere[turn]
    way /= np.linalg.norm(way, axis=1, keepdims=True)
    hits = room.cast(start, way)
    reach = np.where(hits.face >= 0, hits.t, np.float32(1e3))
    return (1 - 0.85 * np.exp(-reach / OCCLUSION_M)).astype(np.float32)


def _falloff(source: Array, facing: Array | None, points: Float32Array, normals: Float32Array) -> Float32Array:
    """N: cosine and distance law of an area light, seen as its mean point."""
    way = source.mean(axis=0).astype(np.float32) - points
    d2 = np.einsum("ij,ij->i", way, way)
    cosine = np.maximum(np.einsum("ij,ij->i", way, normals), 0) / np.sqrt(d2 + 1e-6)
    if facing is not None:
        cosine = cosine * (0.25 + 0.75 * np.maximum(-(way @ facing.astype(np.float32)) / np.sqrt(d2 + 1e-6), 0))
    return np.asarray(cosine / (0.6 + d2), np.float32)


def _share(layers: Float32Array, patch: npt.NDArray[np.int32]) -> Float32Array:
    """Mean over 4x4 samples of the same surface, first along rows, then along columns."""
    for axis in (0, 1):
        total = layers.copy()
        count = np.ones(patch.shape, np.float32)
        for step in (-2, -1, 1):
            same = np.zeros(patch.shape, np.float32)
            here = [slice(None)] * 2
            there = [slice(None)] * 2
            here[axis] = slice(max(-step, 0), patch.shape[axis] - max(step, 0))
            there[axis] = slice(max(step, 0), patch.shape[axis] + min(step, 0))
            h, t = tuple(here), tuple(there)
            same[h] = patch[h] == patch[t]
            total[h] += same[h][..., None] * layers[t]
            count += same
        layers = total / count[..., None]
    return layers


def room_gain(room: Scene) -> float:
    """Factor that brings the median surface of the room to a mid grey; one number for all cameras."""
    K = np.array([[24.0, 0, 23.5], [0, 24.0, 17.5], [0, 0, 1]])
    centre = np.array([*(0.5 * room.size[:2]), 1.5])
    seen = []
    for yaw in np.arange(4) * np.pi / 2:
        c, s = np.cos(yaw), np.sin(yaw)
        T = np.eye(4)
        T[:3, :3] = np.array([[s, 0, c], [-c, 0, s], [0, -1, 0]])
        T[:3, 3] = centre
        seen.append(radiance(room, T, K, 48, 36, 1).reshape(-1, 3).mean(axis=1))
    return MID_GREY / max(float(np.median(np.concatenate(seen))), 1e-6)


def develop(light: Float32Array, exposure: float, sigma: float, rng: np.random.Generator) -> npt.NDArray[np.uint8]:
    """Linear light HxWx3 to uint8: shoulder, sRGB-like gamma, noise of `sigma` grey levels."""
    x = np.maximum(light * np.float32(exposure), 0)
    tone = (1 - np.exp(-1.25 * x)) ** np.float32(1 / 2.2)
    noise = rng.standard_normal(tone.shape, dtype=np.float32) * np.float32(sigma)
    return np.asarray(np.clip(np.round(255 * tone + noise), 0, 255), np.uint8)
