# SPDX-License-Identifier: Apache-2.0
"""Semantic classes of pixels: the published linear and multi-scale ADE20K heads on DINOv2.

The head sees the last block of the transformer (linear) or its last four (ms), normalises, and scores 150 classes per
patch with one 1x1 convolution: 0 = wall, 1 = building, 2 = sky, 3 = floor, ... in the order of the data set; there is
no background. Scores become pixels by bilinear resizing, which is linear: here two small matrices, one per axis, so
that a picture is never held with all its classes at once.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor, nn
from torch.nn import functional as F

from garps_core.checks import Float64Array, IntArray
from garps_core.errors import ConfigError, InputError, ModelError, WeightsError
from garps_core.models.depth_anything import DEVIATION, DTYPES, MEAN, RGBImage, checked_image
from garps_core.models.vit import PATCH, SIZES, VisionTransformer, from_transformers, size_of
from garps_core.types import Mixture
from garps_core.weights.load import load_weights
from garps_core.weights.manifest import BY_NAME, of_file
from garps_core.weights.state_dict import load_strictly
from garps_core.weights.store import installed

RATIOS = (1.0, 1.32, 1.73)
"""Sizes of the picture that the published multi-scale test merges (some add 2.28 and 3.0)."""
LAST_BLOCKS = (1, 4)
"""Blocks that a head sees, counted from the last: linear, ms."""
BAND_ROWS = 64
"""Rows of the picture that hold all classes at once."""

Labels = npt.NDArray[np.int16]


class DecodeHead(nn.Module):
    """Maps (B, C, h, w) -> scores (B, classes, h, w)."""

    def __init__(self, channels: int, classes: int) -> None:
        super().__init__()
        self.bn = nn.BatchNorm2d(channels)
        self.conv_seg = nn.Conv2d(channels, classes, 1)

    def forward(self, maps: Tensor) -> Tensor:  # noqa: D102
        scores: Tensor = self.conv_seg(self.bn(maps))
        return scores


class Segmenter(nn.Module):
    """Backbone and head; their `state_dict`s have the keys of the two published files."""

    def __init__(self, size: str, last_blocks: int, classes: int) -> None:
        super().__init__()
        blocks = SIZES[size].blocks
        self.taps = tuple(range(blocks - last_blocks, blocks))
        self.backbone = VisionTransformer(SIZES[size])
        self.decode_head = DecodeHead(last_blocks * SIZES[size].width, classes)

    def forward(self, picture: Tensor) -> Tensor:
        """(B, 3, H, W), normalised, sides multiples of 14 -> scores (B, classes, H / 14, W / 14), float32."""
        scores: Tensor = self.decode_head(torch.cat(self.backbone(picture, self.taps), dim=1))
        return scores.float()


def load_network(kind: str, weights: str, backbone: str) -> Segmenter:
    """Read a head of kind linear or ms and its backbone, and build the network. Raises WeightsError.

    Both are given by name or file; "" = the first installed head, and the installed backbone of the head's size.
    """
    path, head = load_weights(weights, f"ade20k_{kind}")
    known = of_file(path.name)
    if not backbone and known is not None:
        fitting = [one.name for one in BY_NAME.values() if one.kind == "dinov2" and one.size == known.size]
        backbone = next(filter(installed, fitting), fitting[0])
    return segmenter_of(load_weights(backbone, "dinov2")[1].tensors, head.tensors)


def segmenter_of(backbone: Mapping[str, Tensor], head: Mapping[str, Tensor]) -> Segmenter:
    """The network for inference, float32 on the CPU; which head it is follows from its width.

    Args:
        backbone: of a DINOv2 file without registers, official names or those of `transformers`.
        head: of the file beside it, keys `decode_head.*`.
    Raises:
        WeightsError: tensors that are missing, too many, misshaped or not finite; a head for another backbone.
    """
    if any("embeddings.cls_token" in key for key in backbone):
        inner = {key.removeprefix("dinov2."): value for key, value in backbone.items()}
        backbone = from_transformers({key: value for key, value in inner.items() if not key.startswith("classifier.")})
    size = size_of(backbone)
    weight = head.get("decode_head.conv_seg.weight")
    if weight is None or weight.dim() != 4:
        raise WeightsError(
            f"no decode_head.conv_seg.weight among {len(head)} tensors ({', '.join(list(head)[:3])}): expected an "
            "ADE20K head, linear or ms"
        )
    classes, channels = weight.shape[:2]
    if channels not in [count * SIZES[size].width for count in LAST_BLOCKS]:
        raise WeightsError(
            f"the head reads {channels} channels, the backbone is {size} of width {SIZES[size].width}: expected the "
            "width (linear) or four times it (ms). Take the head that was published for this backbone"
        )
    with torch.device("meta"):
        network = Segmenter(size, channels // SIZES[size].width, classes)
    load_strictly(network.backbone, backbone, f"DINOv2 {size}")
    inside = {key.removeprefix("decode_head."): value for key, value in head.items()}
    load_strictly(network.decode_head, inside, f"an ADE20K head on {size}")
    return network.eval().requires_grad_(False)


@dataclass(frozen=True, eq=False)
class Scores:
    """Scores of one pass; those of the pixels are rows @ wide.

    Args:
        wide: (classes, h, W), on the image's columns and the rows of patches.
        rows: (H, h).
    """

    wide: Tensor
    rows: Tensor

    def pixels(self, first: int, last: int) -> Tensor:
        """(classes, last - first, W), scores of some rows of the image."""
        return torch.einsum("rh,chw->crw", self.rows[first:last], self.wide)


def segment(
    network: Segmenter,
    image: RGBImage,
    *,
    short_side: int | None = None,
    ratios: Sequence[float] = (1.0,),
    flip: bool = False,
    official: bool = False,
    dtype: torch.dtype = torch.float32,
) -> Labels:
    """Class of every pixel: HxW int16.

    Several passes (`ratios`, `flip`) are merged by the mean of their probabilities, as the published test does with
    RATIOS and flip; one pass of the whole picture is enough for a robot.

    Args:
        network: on any device.
        image: HxWx3 uint8 RGB.
        short_side: resize the picture to this before the network (518 in the published test); None = as it is.
        ratios: sizes of the picture to look at.
        flip: look at the mirrored picture as well.
        official: stretch the scores of the padded picture to the unpadded one, as published, which shifts them by up
            to 7 pixels; otherwise the padding is cut off.
        dtype: of the layers that autocast may compute in less than float32.
    Raises:
        InputError: no such image. ConfigError: a ratio, size or dtype that cannot be. ModelError: scores that are not
            finite, too little memory.
    """
    height, width = checked_image(image).shape[:2]
    if not ratios or min(ratios) <= 0 or (short_side is not None and short_side < PATCH) or dtype not in DTYPES:
        raise ConfigError(
            f"ratios {tuple(ratios)}, short_side {short_side}, {dtype}: expected positive ratios such as {RATIOS}, at "
            f"least {PATCH} pixels, and one of {', '.join(sorted(map(str, DTYPES)))}"
        )
    base = 1.0 if short_side is None else short_side / min(height, width)
    passes = [
        scores_of(network, image, base * ratio, mirrored, official, dtype)
        for ratio in ratios
        for mirrored in ((False, True) if flip else (False,))
    ]
    return best_classes(passes)


def scores_of(
    network: Segmenter,
    image: RGBImage,
    scale: float = 1.0,
    mirrored: bool = False,
    official: bool = False,
    dtype: torch.dtype = torch.float32,
) -> Scores:
    """One pass over the image, resized by `scale`; the scores come back unmirrored, on the image's own pixels."""
    device = next(network.parameters()).device
    height, width = image.shape[:2]
    size = (max(1, int(height * scale + 0.5)), max(1, int(width * scale + 0.5)))
    picture = image if size == (height, width) else cv2.resize(image, size[::-1], interpolation=cv2.INTER_LINEAR)
    given = padded_input(np.asarray(picture[:, ::-1] if mirrored else picture, np.uint8)).to(device)
    try:
        with torch.inference_mode(), torch.autocast(device.type, dtype, enabled=dtype != torch.float32):
            patches: Tensor = network(given)[0]
    except torch.cuda.OutOfMemoryError as error:
        raise ModelError(
            f"out of memory on {device} with {size[1]}x{size[0]} pixels: choose a smaller backbone or the CPU ({error})"
        ) from None
    if not patches.isfinite().all():
        raise ModelError(f"the network returned NaN or infinity in {dtype}: expected scores. Is float32 needed?")
    axes = zip(patches.shape[1:], size, (height, width), strict=True)
    rows, columns = (torch.from_numpy(_spreading(*axis, official)).to(device, torch.float32) for axis in axes)
    return Scores(patches @ (columns.flip(0) if mirrored else columns).T, rows)


def padded_input(picture: RGBImage) -> Tensor:
    """HxWx3 uint8 RGB -> (1, 3, H', W') float32, normalised, zeros around it up to multiples of 14.

    Of an odd number of missing rows or columns the larger half comes below or at the right.
    """
    normalised = (picture / 255.0 - np.array(MEAN)) / np.array(DEVIATION)
    margins = [(missing // 2, missing - missing // 2) for missing in (-side % PATCH for side in picture.shape[:2])]
    padded = np.pad(normalised, (*margins, (0, 0)))
    return torch.from_numpy(np.ascontiguousarray(padded.transpose(2, 0, 1)[None], np.float32))


def _spreading(patches: int, side: int, wanted: int, official: bool) -> Float64Array:
    """(wanted, patches): scores of an axis on patches -> on the network's `side` pixels -> on the `wanted` ones."""
    if official:
        inner = stretching(patches, side)
    else:
        first = (patches * PATCH - side) // 2
        inner = stretching(patches, patches * PATCH)[first : first + side]
    return stretching(side, wanted) @ inner


def stretching(cells: int, wanted: int) -> Float64Array:
    """(wanted, cells): bilinear resizing along an axis, corners on corners of cells."""
    unit = torch.eye(cells, dtype=torch.float64)[None]
    return np.asarray(F.interpolate(unit, size=wanted, mode="linear", align_corners=False)[0].T.numpy())


def best_classes(passes: Sequence[Scores]) -> Labels:
    """HxW: the class of the highest score, or of the highest mean probability of several passes."""
    height = len(passes[0].rows)
    bands = [_best(passes, first, min(first + BAND_ROWS, height)) for first in range(0, height, BAND_ROWS)]
    return torch.cat(bands).to(torch.int16).cpu().numpy()


def _best(passes: Sequence[Scores], first: int, last: int) -> Tensor:
    if len(passes) == 1:
        return passes[0].pixels(first, last).argmax(dim=0)
    return sum((one.pixels(first, last).softmax(dim=0) for one in passes), start=torch.zeros(())).argmax(dim=0)


def labelled(mixture: Mixture, labels: IntArray, K: Float64Array) -> Mixture:
    """The mixture with the label of the pixel that each mean projects to; of the nearest pixel when it is outside.

    For components that came from pixels of this picture. labels: HxW integers. K: 3x3 pixels of the same picture.
    Raises InputError for labels of another form, or means behind the camera.
    """
    if labels.ndim != 2 or labels.dtype.kind not in "iu":
        raise InputError(f"labels are {labels.dtype} of shape {labels.shape}: expected HxW integers")
    z = mixture.means[:, 2]
    if not (z > 0).all():
        raise InputError(f"{np.count_nonzero(z <= 0)} means lie behind the camera: expected z above 0 m")
    place: list[Any] = []
    for axis, limit in ((1, labels.shape[0]), (0, labels.shape[1])):
        pixel = np.rint(mixture.means[:, axis] / z * K[axis, axis] + K[axis, 2])
        place.append(pixel.clip(0, limit - 1).astype(np.intp))
    return replace(mixture, labels=labels[tuple(place)])
