# SPDX-License-Identifier: Apache-2.0
"""Paint: hands furniture its textures, all drawn at one strength from one random stream."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np

from bench.rooms import materials as ma
from bench.rooms import prints
from bench.rooms import textures as tx
from bench.rooms.textures import Colour, Image, Texture

FINE_M = 0.0025  # texel of furniture and prints
WALL_M = 0.005  # texel of walls and floor


@dataclass(eq=False)
class Paint:
    """Draws textures.

    Args:
        rng: consumed in the order of the calls.
        strength: 1 = rich, 0 = almost plain.
    """

    rng: np.random.Generator
    strength: float
    _shared: dict[str, Texture] = field(default_factory=dict)

    def finish(self, canvas: Image, texel_m: float, glow: float = 0.0) -> Texture:
        """Canvas to texture at this paint's strength."""
        return tx.make_texture(canvas, texel_m, self.strength, glow)

    def plain(self, colour: Colour) -> Texture:
        """One colour with a hint of grain."""
        shape = (128, 128)
        grain = tx.noise(self.rng, shape, (24, 24), 4, 0.8)
        return self.finish(tx.tint(colour, 0.05 * grain), FINE_M)

    def wood(self, colour: Colour | None = None) -> Texture:
        """Furniture wood, 1.6 x 0.6 m of it."""
        colour = tx.pick(self.rng, tx.WOODS) if colour is None else colour
        return self.finish(ma.wood(self.rng, tx.texels((1.6, 0.6), FINE_M), FINE_M, colour), FINE_M)

    def fabric(self, colour: Colour | None = None) -> Texture:
        """Upholstery, 1 x 1 m of it."""
        colour = tx.pick(self.rng, tx.CLOTHS) if colour is None else colour
        return self.finish(ma.fabric(self.rng, tx.texels((1.0, 1.0), FINE_M), FINE_M, colour), FINE_M)

    def glaze(self) -> Texture:
        """Ceramics: speckled glaze with painted rings."""
        shape = tx.texels((0.5, 0.4), FINE_M)
        image = tx.tint(tx.pick(self.rng, tx.VIVID), 0.16 * tx.noise(self.rng, shape, (30, 40), 5, 0.7))
        ink = np.asarray(tx.pick(self.rng, tx.VIVID), np.float32)
        blot = tx.noise(self.rng, shape, (18, 18), 2)
        for _ in range(int(self.rng.integers(1, 4))):
            y = int(self.rng.integers(shape[0] - 14))
            image[y : y + int(self.rng.integers(3, 14))] = ink
        image = np.where((blot > 0.75)[..., None], ink, image)
        return self.finish(image, FINE_M)

    def foliage(self) -> Texture:
        """Leaf green with veins."""
        shape = (64, 128)
        vein = np.abs(np.sin(np.arange(shape[0], dtype=np.float32) / 4))[:, None] ** 6
        tone = 0.25 * tx.noise(self.rng, shape, (16, 16), 4) - 0.2 * vein
        return self.finish(tx.tint(tx.pick(self.rng, ((0.22, 0.38, 0.16), (0.30, 0.42, 0.20))), tone), FINE_M)

    def floor(self, size: tuple[float, float]) -> Texture:
        """Boards, tiles or carpet for a floor of (width, depth) m."""
        make: tuple[tuple[Callable[..., Image], tuple[Colour, ...]], ...] = (
            (ma.planks, tx.WOODS), (ma.planks, tx.WOODS), (ma.tiles, tx.WALLS), (ma.carpet, tx.CLOTHS),
        )  # fmt: skip
        draw, colours = make[int(self.rng.integers(len(make)))]
        return self.finish(draw(self.rng, tx.texels(size, WALL_M), WALL_M, tx.pick(self.rng, colours)), WALL_M)

    def walls(self, sizes: list[tuple[float, float]]) -> list[Texture]:
        """Paint for all walls of (width, height) m, one of them perhaps bricks or wallpaper."""
        colour = tx.pick(self.rng, tx.WALLS)
        accent, kind = int(self.rng.integers(len(sizes))), int(self.rng.integers(3))
        out = []
        for k, size in enumerate(sizes):
            shape = tx.texels(size, WALL_M)
            if k == accent and kind == 1:
                image = ma.bricks(self.rng, shape, WALL_M, tx.pick(self.rng, ((0.58, 0.33, 0.25), (0.78, 0.74, 0.70))))
            elif k == accent and kind == 2:
                image = ma.wallpaper(self.rng, shape, WALL_M, tx.pick(self.rng, tx.WALLS))
            else:
                image = ma.plaster(self.rng, shape, WALL_M, colour)
            out.append(self.finish(image, WALL_M))
        return out

    def ceiling(self, size: tuple[float, float]) -> Texture:
        """White plaster."""
        texel = 2 * WALL_M
        return self.finish(ma.plaster(self.rng, tx.texels(size, texel), texel, (0.90, 0.89, 0.87)), texel)

    def printed(
        self, size: tuple[float, float], draw: Callable[..., Image], *extra: float, glow: float = 0.0
    ) -> Texture:
        """A print that fills (width, height) m exactly once; `draw` takes rng, shape and `extra`."""
        image = draw(self.rng, tx.texels(size, FINE_M), *extra)
        height, width = image.shape[:2]
        texture = self.finish(image, FINE_M, glow)
        # The canvas has whole texels; let it span the given size exactly so that it does not repeat at its edge.
        assert abs(width * FINE_M - size[0]) < 9 * FINE_M and abs(height * FINE_M - size[1]) < 9 * FINE_M
        return Texture(texture.levels, size, glow)

    def spines(self) -> Texture:
        """64 book spines in a row, each 0.04 m wide and 0.3 m tall; shared by all shelves of a room."""
        if "spines" not in self._shared:
            self._shared["spines"] = self.printed((64 * 0.04, 0.3), prints.spines, 64)
        return self._shared["spines"]

    def paper(self) -> Texture:
        """Edges of pages."""
        if "paper" not in self._shared:
            self._shared["paper"] = self.plain((0.88, 0.85, 0.76))
        return self._shared["paper"]

    def metal(self) -> Texture:
        """Dark or brass metal."""
        return self.plain(tx.pick(self.rng, ((0.15, 0.15, 0.16), (0.55, 0.45, 0.28), (0.55, 0.55, 0.56))))
