# SPDX-License-Identifier: Apache-2.0
"""The demo's picture of a pair: the two images that go in, beside the mixtures before and after."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import numpy.typing as npt
from matplotlib.font_manager import findfont
from PIL import Image, ImageDraw, ImageFont

UInt8 = npt.NDArray[np.uint8]

WIDTH = 1400
"""Width of the finished picture, px."""
COLOURS = 256
"""A palette keeps the file below 400 kB."""
MARGIN, CAPTION = 24, 40


def with_inputs(source: UInt8, target: UInt8, figure: Path) -> None:
    """Put source and target (HxWx3 RGB) to the left of a before/after figure, in place, as a small PNG."""
    drawn = Image.open(figure).convert("RGB")
    height = (drawn.height - 3 * MARGIN) // 2 - CAPTION
    inputs = [Image.fromarray(rgb) for rgb in (source, target)]
    inputs = [image.resize((round(image.width * height / image.height), height)) for image in inputs]
    left = max(image.width for image in inputs) + MARGIN
    sheet = Image.new("RGB", (left + drawn.width, drawn.height), "white")
    sheet.paste(drawn, (left, 0))
    pen, font = ImageDraw.Draw(sheet), ImageFont.truetype(findfont("DejaVu Sans"), 24)
    top = MARGIN
    for name, image in zip(("source", "target"), inputs, strict=True):
        pen.text((MARGIN, top), f"{name} image", fill="black", font=font)
        sheet.paste(image, (MARGIN, top + CAPTION))
        top += CAPTION + height + MARGIN
    size = WIDTH, round(sheet.height * WIDTH / sheet.width)
    small = sheet.resize(size, Image.Resampling.LANCZOS).quantize(COLOURS, dither=Image.Dither.NONE)
    small.save(figure, optimize=True)
