# SPDX-License-Identifier: Apache-2.0
"""Pictures with true depth to train a depth network on: generated rooms, seen by any camera in any light.

    python -m bench.training.rooms --rooms 1000 --out out/depth_data

Every room of `bench.rooms` is changed at random: colours of its surfaces, how rich they are, its lamps and windows.
Cameras stand, hang and tilt as they please, wide or narrow, exposed well or badly. Everything follows from the seeds,
which no benchmark uses; rooms that are there already are not rendered again.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated

import numpy as np
import numpy.typing as npt
import typer
from rich.progress import Progress

from bench.rooms import Room, look_at, make_room
from bench.rooms.dark import in_the_dark
from bench.rooms.mesh import Array
from bench.rooms.shading import camera_rays, room_gain
from bench.rooms.textures import Texture

FOLDER = Path("out/depth_data")
FIRST_SEED = 100_000
"""Smallest seed of the rooms to learn from; benchmarks, tests and demos stay below."""
HEIGHT, WIDTH = 192, 256
VIEWS = 12
"""Pictures of a room: most of the time goes into making it."""
FOCAL = (0.5, 1.1)
"""Focal length over the picture's width, 90 to 49 degrees; crops in training narrow it further."""
TRIED = 3
"""Cameras per picture, of which the one that sees farthest is kept: else half of all pictures were a piece of wall."""
CLEARANCE_M = 0.2
DARK_SHARE = 0.2
"""Share of the pictures that are taken in the dark by a moving camera (`bench.rooms.dark`)."""
VERSION = 1


@dataclass(frozen=True, eq=False)
class Shot:
    """One picture.

    Args:
        rgb: HxWx3 uint8.
        depth: HxW float32 m along z, NaN where nothing is hit.
        K: 3x3 pixels, pixel centres at integers.
    """

    rgb: npt.NDArray[np.uint8]
    depth: npt.NDArray[np.float32]
    K: Array


def shots(seed: int, views: int = VIEWS) -> Iterator[Shot]:
    """Pictures of one room, all from its seed."""
    rng = np.random.default_rng([seed, 401])
    room = recoloured(make_room(seed, float(rng.choice([rng.uniform(0, 0.2), rng.uniform(0.2, 1.0)]))), rng)
    for _ in range(views):
        K = intrinsics(rng)
        T = max((free_camera(room, rng) for _ in range(TRIED)), key=lambda T: median_depth_m(room, T, K))
        exposure = float(np.exp(rng.normal(0, 0.35)))
        seen = room.render(T, K, WIDTH, HEIGHT, exposure, float(rng.uniform(0.5, 4.0)), rng)
        rgb = in_the_dark(seen.rgb, rng) if rng.random() < DARK_SHARE else seen.rgb
        yield Shot(rgb, seen.depth_m, K)


def recoloured(room: Room, rng: np.random.Generator) -> Room:
    """The room with other colours and other light; its shape stays."""
    room.textures = tuple(_tinted(texture, rng) for texture in room.textures)
    room.lights = tuple(
        replace(light, power=light.power * float(np.exp(rng.normal(0, 0.6))) * rng.uniform(0.8, 1.2, 3))
        for light in room.lights
    )
    room.gain = 1.0
    room.gain = room_gain(room)
    return room


def _tinted(texture: Texture, rng: np.random.Generator) -> Texture:
    if texture.glow > 0:
        return texture
    gain = np.exp(rng.normal(0, 0.25)) * np.exp(rng.normal(0, 0.12, 3))
    levels = tuple(np.clip(level * gain, 0, 255).astype(np.uint8) for level in texture.levels)
    return replace(texture, levels=levels)


def intrinsics(rng: np.random.Generator) -> Array:
    """K, 3x3 px, of a camera of `WIDTH` x `HEIGHT` pixels whose principal point is nearly in the middle."""
    f = WIDTH * float(np.exp(rng.uniform(*np.log(FOCAL))))
    cx, cy = (side * (0.5 + rng.normal(0, 0.01)) - 0.5 for side in (WIDTH, HEIGHT))
    return np.array([[f, 0, cx], [0, f, cy], [0, 0, 1]])


def free_camera(room: Room, rng: np.random.Generator) -> Array:
    """T_world_camera somewhere in the room where nothing touches the lens, looking anywhere but straight up or down."""
    for _ in range(200):
        eye = rng.uniform([0.3, 0.3, 0.25], room.size - [0.3, 0.3, 0.3])
        yaw, pitch = rng.uniform(-math.pi, math.pi), np.clip(rng.normal(-0.15, 0.25), -0.9, 0.6)
        ahead = np.array([math.cos(pitch) * math.cos(yaw), math.cos(pitch) * math.sin(yaw), math.sin(pitch)])
        T = look_at(eye, eye + ahead, float(rng.normal(0, 0.08)))
        around = np.concatenate([np.eye(3), -np.eye(3), ahead[None]])
        near = room.cast(eye, around)
        ahead_m = float(room.cast(eye, ahead[None]).t[0])
        if near.t.min() > CLEARANCE_M and (near.face >= 0).all() and ahead_m > 0.6:
            return T
    raise RuntimeError(f"room {room.seed} has no place for a camera {CLEARANCE_M} m from everything")


def median_depth_m(room: Room, T: Array, K: Array) -> float:
    """Median depth of a coarse picture from there, m."""
    scale = np.diag([1 / 16, 1 / 16, 1.0])
    rays = camera_rays(scale @ K, WIDTH // 16, HEIGHT // 16).reshape(-1, 3)
    return float(np.median(room.cast(T[:3, 3], rays @ T[:3, :3].T.astype(np.float32)).t))


def render(seed: int, folder: Path) -> Path:
    """Render a room to its file: rgb (n, H, W, 3) uint8, depth (n, H, W) uint16 mm with 0 for none, K (n, 3, 3)."""
    path = folder / f"room{seed}_v{VERSION}.npz"
    if not path.is_file():
        found = list(shots(seed))
        depth = np.stack([np.nan_to_num(1000 * shot.depth, nan=0.0) for shot in found])
        unfinished = path.with_suffix(".unfinished")
        with unfinished.open("wb") as file:
            np.savez_compressed(
                file,
                rgb=np.stack([shot.rgb for shot in found]),
                depth=np.clip(np.rint(depth), 0, 65535).astype(np.uint16),
                K=np.stack([shot.K for shot in found]),
            )
        unfinished.replace(path)
    return path


def main(
    rooms: Annotated[int, typer.Option(min=1, help="how many")] = 1000,
    first: Annotated[int, typer.Option(help="seed of the first")] = FIRST_SEED,
    workers: Annotated[int, typer.Option(min=1, help="processes")] = 2,
    out: Annotated[Path, typer.Option(help="folder of the rooms")] = FOLDER,
) -> None:
    """Render rooms to learn from; goes on where it was stopped."""
    out.mkdir(parents=True, exist_ok=True)
    with ProcessPoolExecutor(workers) as pool, Progress() as bars:
        seeds = range(first, first + rooms)
        for _ in bars.track(pool.map(render, seeds, [out] * rooms), total=rooms, description="rooms"):
            pass


if __name__ == "__main__":
    typer.run(main)
