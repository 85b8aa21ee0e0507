# SPDX-License-Identifier: Apache-2.0
"""Printed things: pictures, book spines, rugs, parcels, the view outside a window, a door leaf."""

from __future__ import annotations

from itertools import pairwise

import cv2
import numpy as np
import numpy.typing as npt

from bench.rooms import materials
from bench.rooms import textures as tx
from bench.rooms.textures import Colour, Image


def writing(
    rng: np.random.Generator, image: Image, area: tuple[int, int, int, int], height: int, colour: Colour
) -> None:
    """Fill (x0, y0, x1, y1) texels with lines of invented letters `height` texels tall."""
    x0, y0, x1, y1 = area
    ink = tuple(float(c) for c in colour)
    stroke = max(height // 5, 1)
    y = y0
    while y + height <= y1:
        end = x1 - int(rng.uniform(0, 0.4) * (x1 - x0))
        x = x0
        while x + height // 2 < end:
            if rng.random() < 0.85:
                cell = rng.uniform(0, 1, (int(rng.integers(3, 5)), 2)) * (0.55 * height, height) + (x, y)
                cv2.polylines(image, [np.round(cell).astype(np.int32)], False, ink, stroke, cv2.LINE_AA)
            x += int(0.75 * height) + 1
        y += int(1.7 * height) + 1


def picture(rng: np.random.Generator, shape: tuple[int, int]) -> Image:
    """A framed print: landscape, abstract, still life or poster, in a mount and a frame. HxWx3."""
    height, width = shape
    kind = int(rng.integers(4))
    image = (landscape, abstract, still_life, poster)[kind](rng, shape)
    mount = int(0.09 * min(shape)) if rng.random() < 0.6 else 0
    frame = max(int(0.035 * min(shape)), 2)
    if mount:
        inner = cv2.resize(image, (width - 2 * (mount + frame), height - 2 * (mount + frame)))
        image[:] = 0.93 + 0.02 * rng.standard_normal((*shape, 1)).astype(np.float32)
        image[mount + frame : height - mount - frame, mount + frame : width - mount - frame] = inner
    colour = np.asarray(tx.pick(rng, (*tx.WOODS, (0.1, 0.1, 0.1), (0.75, 0.65, 0.4))), np.float32)
    border = np.ones(shape, bool)
    border[frame : height - frame, frame : width - frame] = False
    image[border] = colour * (1 + 0.08 * rng.standard_normal((int(border.sum()), 1))).astype(np.float32)
    return image


def landscape(rng: np.random.Generator, shape: tuple[int, int]) -> Image:
    """Sky with clouds over several ridges, nearer ones darker and rougher. HxWx3."""
    height, width = shape
    y = np.linspace(0, 1, height, dtype=np.float32)[:, None]
    top, low = (np.asarray(tx.pick(rng, c), np.float32) for c in (((0.30, 0.50, 0.80),), ((0.92, 0.82, 0.70),)))
    image = top + (low - top) * np.clip(1.7 * y, 0, 1)[..., None] * np.ones((1, width, 1), np.float32)
    cloud = np.clip(1.5 * tx.noise(rng, shape, (0.25 * height, 0.5 * width), 5) - 0.3, 0, 1)
    image = image + (0.97 - image) * (0.8 * cloud * np.clip(1.4 - 2 * y, 0, 1))[..., None]
    for k in range(4):
        ridge = 0.42 + 0.14 * k + 0.09 * tx.noise(rng, (1, width), (1, 0.5 * width), 6, 0.6)[0]
        colour = np.asarray(tx.pick(rng, ((0.45, 0.55, 0.62), (0.30, 0.45, 0.30), (0.45, 0.42, 0.25))), np.float32)
        rough = 0.10 + 0.08 * k
        ground = tx.tint(colour * (1 - 0.15 * k), rough * tx.noise(rng, shape, (0.08 * height, 0.06 * width), 4, 0.75))
        alpha = np.clip((y - ridge[None, :]) * height, 0, 1)[..., None]
        image = image * (1 - alpha) + ground * alpha
    return np.asarray(image, np.float32)


def abstract(rng: np.random.Generator, shape: tuple[int, int]) -> Image:
    """Overlapping polygons, discs and lines on a brushed ground. HxWx3."""
    height, width = shape
    image = tx.tint(tx.pick(rng, tx.VIVID), 0.12 * tx.noise(rng, shape, (0.3 * height, 0.1 * width), 5, 0.7))
    image = np.ascontiguousarray(image)
    for _ in range(int(rng.integers(14, 28))):
        colour = tuple(float(c) for c in tx.pick(rng, tx.VIVID))
        centre = rng.uniform(0, 1, 2) * (width, height)
        reach = rng.uniform(0.04, 0.28) * min(shape)
        at = (int(centre[0]), int(centre[1]))
        if rng.random() < 0.45:
            angle = np.sort(rng.uniform(0, 2 * np.pi, int(rng.integers(3, 6))))
            points = centre + reach * np.stack([np.cos(angle), np.sin(angle)], axis=1)
            cv2.fillPoly(image, [np.round(points).astype(np.int32)], colour, cv2.LINE_AA)
        elif rng.random() < 0.6:
            cv2.circle(image, at, int(reach), colour, -1 if rng.random() < 0.5 else 2, cv2.LINE_AA)
        else:
            end = centre + rng.normal(0, 2, 2) * reach
            cv2.line(image, at, (int(end[0]), int(end[1])), colour, int(rng.integers(1, 5)), cv2.LINE_AA)
    return np.asarray(image * (1 + 0.08 * tx.noise(rng, shape, (8, 8), 3, 0.8)[..., None]), np.float32)


def still_life(rng: np.random.Generator, shape: tuple[int, int]) -> Image:
    """Fruit-like shaded discs on a cloth in front of a dark wall. HxWx3."""
    height, width = shape
    y, x = np.mgrid[:height, :width].astype(np.float32)
    image = tx.tint(tx.pick(rng, tx.CLOTHS), 0.2 * tx.noise(rng, shape, (0.4 * height, 0.4 * width), 5, 0.7) - 0.25)
    cloth = tx.tint(tx.pick(rng, tx.WALLS), 0.18 * tx.noise(rng, shape, (0.1 * height, 0.3 * width), 4, 0.7))
    image = np.where((y > 0.66 * height)[..., None], cloth, image)
    for _ in range(int(rng.integers(6, 12))):
        r = rng.uniform(0.06, 0.15) * min(shape)
        cx, cy = rng.uniform(0.15, 0.85) * width, rng.uniform(0.5, 0.8) * height
        d = np.hypot(x - cx, y - cy) / r
        light = 0.45 + 0.75 * np.exp(-2 * (((x - cx) / r + 0.4) ** 2 + ((y - cy) / r + 0.4) ** 2))
        fruit = np.asarray(tx.pick(rng, tx.VIVID[:4]), np.float32) * light[..., None]
        alpha = np.clip((1 - d) * r, 0, 1)[..., None]
        image = image * (1 - alpha) + fruit * alpha
    return np.asarray(image * (1 + 0.07 * tx.noise(rng, shape, (6, 10), 3, 0.8)[..., None]), np.float32)


def poster(rng: np.random.Generator, shape: tuple[int, int]) -> Image:
    """Headline, a block of image and lines of text. HxWx3."""
    height, width = shape
    image = np.ascontiguousarray(tx.tint(tx.pick(rng, tx.VIVID), 0.03 * tx.noise(rng, shape, (40, 40), 3)))
    ink = (0.08, 0.08, 0.1) if image.mean() > 0.4 else (0.93, 0.9, 0.82)
    pad = width // 10
    writing(rng, image, (pad, height // 12, width - pad, height // 4), max(height // 12, 3), ink)
    block = (int(0.4 * height), width - 2 * pad)
    if min(block) >= 12:
        inner = (landscape if rng.random() < 0.5 else abstract)(rng, block)
        image[int(0.28 * height) : int(0.28 * height) + block[0], pad : width - pad] = inner
    writing(rng, image, (pad, int(0.72 * height), width - pad, int(0.95 * height)), max(height // 32, 3), ink)
    return image


def spines(rng: np.random.Generator, shape: tuple[int, int], count: int) -> Image:
    """`count` equally wide book spines side by side, each with bands and a title. HxWx3."""
    height, width = shape
    image = np.zeros((height, width, 3), np.float32)
    edges = np.linspace(0, width, count + 1).astype(int)
    for left, right in pairwise(edges):
        spine = np.empty((height, right - left, 3), np.float32)
        spine[:] = tx.pick(rng, tx.VIVID, 0.08)
        ink = tuple(float(c) for c in tx.pick(rng, tx.VIVID))
        for _ in range(int(rng.integers(1, 4))):
            y = int(rng.uniform(0.04, 0.95) * height)
            cv2.rectangle(spine, (0, y), (right - left, y + int(rng.integers(1, 8))), ink, -1)
        _title(rng, spine, ink)
        image[:, left:right] = spine
    return np.asarray(image * (1 + 0.06 * tx.noise(rng, shape, (30, 6), 3, 0.8)[..., None]), np.float32)


def _title(rng: np.random.Generator, spine: Image, ink: Colour) -> None:
    """One line of letters running down the middle of a spine."""
    height, width = spine.shape[:2]
    start, size = int(rng.uniform(0.1, 0.25) * height), max(int(0.5 * width), 3)
    lying = np.ascontiguousarray(spine.transpose(1, 0, 2))
    top = (width - size) // 2
    writing(rng, lying, (start, top, start + int(rng.uniform(0.4, 0.65) * height), top + size), size, ink)
    spine[:] = lying.transpose(1, 0, 2)


def rug(rng: np.random.Generator, shape: tuple[int, int], texel_m: float) -> Image:
    """Woven rug: borders around a field of mirrored ornaments. HxWx3."""
    height, width = shape
    quarter = np.ascontiguousarray(np.zeros(((height + 1) // 2, (width + 1) // 2, 3), np.float32))
    palette = [tuple(float(c) for c in tx.pick(rng, (*tx.CLOTHS, *tx.VIVID[:6]))) for _ in range(5)]
    for k, inset in enumerate((0, 0.05, 0.09, 0.16, 0.19)):
        corner = (int(inset / texel_m),) * 2
        cv2.rectangle(quarter, corner, (width, height), palette[k % 3], -1)
    for _ in range(45):
        centre = tuple(int(v) for v in rng.uniform(0.10, 1.0, 2) * quarter.shape[1::-1])
        axes = tuple(int(v / texel_m) + 1 for v in rng.uniform(0.01, 0.06, 2))
        colour = palette[int(rng.integers(5))]
        cv2.ellipse(quarter, centre, axes, float(rng.choice([0, 45, 90])), 0, 360, colour, -1, cv2.LINE_AA)
    half = np.concatenate([quarter, quarter[:, ::-1][:, : width - quarter.shape[1]]], axis=1)
    full = np.concatenate([half, half[::-1][: height - quarter.shape[0]]])
    pile = tx.noise(rng, shape, (0.012 / texel_m, 0.05 / texel_m), 3, 0.8)
    return np.asarray(full * (0.9 + 0.10 * pile[..., None]) + 0.03, np.float32)


def parcel(rng: np.random.Generator, shape: tuple[int, int], texel_m: float) -> Image:
    """Cardboard with tape, a label, print and dirt. HxWx3."""
    height, width = shape
    ribs = tx.noise(rng, shape, (0.2 / texel_m, 0.006 / texel_m), 2)
    image = tx.tint(tx.pick(rng, ((0.68, 0.52, 0.35),)), 0.04 * ribs + 0.07 * tx.noise(rng, shape, (30, 30), 5, 0.7))
    image = np.ascontiguousarray(image)
    tape = int(rng.uniform(0.3, 0.6) * width)
    image[:, tape : tape + int(0.05 / texel_m)] *= np.array([1.12, 1.05, 0.85], np.float32)
    x, y = int(rng.uniform(0.05, 0.45) * width), int(rng.uniform(0.1, 0.5) * height)
    w, h = int(0.4 * width), int(0.33 * height)
    cv2.rectangle(image, (x, y), (x + w, y + h), (0.92, 0.92, 0.9), -1)
    writing(rng, image, (x + 4, y + 4, x + w - 4, y + h - 2), max(int(0.008 / texel_m), 4), (0.1, 0.1, 0.12))
    bottom = int(0.8 * height)
    writing(rng, image, (8, bottom, width - 8, height - 3), max(int(0.1 * height), 5), (0.25, 0.16, 0.1))
    return image


def door_leaf(rng: np.random.Generator, shape: tuple[int, int], texel_m: float) -> Image:
    """Door with recessed panels, in wood or paint. HxWx3."""
    colour = tx.pick(rng, (*tx.WOODS, (0.85, 0.84, 0.80)))
    image = np.ascontiguousarray(materials.wood(rng, shape[::-1], texel_m, colour).transpose(1, 0, 2))
    height, width = shape
    for y0, y1 in ((0.07, 0.45), (0.53, 0.93)):
        for x0, x1 in ((0.13, 0.46), (0.54, 0.87)):
            box = [int(v) for v in (x0 * width, y0 * height, x1 * width, y1 * height)]
            edge = max(int(0.012 / texel_m), 2)
            image[box[1] : box[3], box[0] : box[2]] *= 0.93
            image[box[1] : box[1] + edge, box[0] : box[2]] *= 0.6
            image[box[3] - edge : box[3], box[0] : box[2]] *= 1.25
            image[box[1] : box[3], box[0] : box[0] + edge] *= 0.75
    return image


def clock_face(rng: np.random.Generator, shape: tuple[int, int]) -> Image:
    """Dial with marks and hands. HxWx3."""
    size = min(shape)
    image = np.full((*shape, 3), 0.92, np.float32)
    centre = np.array([shape[1] / 2, shape[0] / 2])

    def hand(angle: float, inner: float, outer: float, thick: int) -> None:
        way = np.array([np.sin(angle), -np.cos(angle)]) * size / 2
        a, b = (tuple(int(v) for v in centre + r * way) for r in (inner, outer))
        cv2.line(image, a, b, (0.1, 0.1, 0.12), thick, cv2.LINE_AA)

    for hour in range(12):
        hand(hour * np.pi / 6, 0.78, 0.9, 3 if hour % 3 == 0 else 2)
    for reach in (0.5, 0.72):
        hand(float(rng.uniform(0, 2 * np.pi)), 0.0, reach, 3)
    return image


def keys_and_screen(rng: np.random.Generator, shape: tuple[int, int]) -> Image:
    """A screen that shows windows of text and a picture. HxWx3."""
    height, width = shape
    image = np.ascontiguousarray(landscape(rng, shape) * np.float32(0.7))
    for _ in range(3):
        x, y = int(rng.uniform(0.03, 0.5) * width), int(rng.uniform(0.05, 0.5) * height)
        w, h = int(rng.uniform(0.3, 0.45) * width), int(rng.uniform(0.3, 0.42) * height)
        cv2.rectangle(image, (x, y), (x + w, y + h), (0.92, 0.93, 0.95), -1)
        cv2.rectangle(image, (x, y), (x + w, y + 6), (0.25, 0.35, 0.55), -1)
        writing(rng, image, (x + 5, y + 12, x + w - 5, y + h - 3), 5, (0.1, 0.12, 0.2))
    return image


def outdoors(rng: np.random.Generator, shape: tuple[int, int]) -> Image:
    """View through a window: a landscape with panes drawn in front, bright. HxWx3."""
    image = landscape(rng, shape)
    return np.asarray(0.35 + 0.65 * image, np.float32)


def flat(colour: Colour, shape: tuple[int, int] = (16, 16)) -> npt.NDArray[np.float32]:
    """One colour. HxWx3."""
    return np.tile(np.asarray(colour, np.float32), (*shape, 1))
