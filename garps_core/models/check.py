# SPDX-License-Identifier: Apache-2.0
"""Plausibility of a weights file: its tensors, and the answer of its network to one drawn picture.

The tests of this repository have no real weights, so a user who has them checks them here.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from pathlib import Path

import numpy as np
import numpy.typing as npt
import torch

from garps_core.checks import Float32Array
from garps_core.errors import WeightsError
from garps_core.weights.manifest import of_file, range_of
from garps_core.weights.reader import Tensors, read_tensors
from garps_core.weights.state_dict import check_finite, kind_of, load_strictly, recognised

Check = tuple[str, str, bool]
"""Name, result in words, and whether it is plausible."""
Picture = npt.NDArray[np.uint8]

LOW_M = 0.2
"""Smallest plausible depth of a whole room."""
HIGH_M = 20.0
"""Largest plausible median depth by a two-view network."""
SHIFT_PX = 16
"""Shift between the two views that a two-view network is shown, right and down."""
SATURATED = 0.98
"""Share of the largest depth beyond which nearly every pixel of a relative model's output lies."""


def check_file(path: Path, *, variant: str = "", kind: str | None = None) -> Iterator[Check]:
    """Yield the checks of a weights file in order, as they are made.

    Args:
        path: any weights file.
        variant: indoor or outdoor, for Depth Anything where neither the file's name nor its metadata says it.
        kind: the network, see `read_tensors`.
    Raises:
        WeightsError: unreadable, not trustworthy, values that are not finite, or tensors that do not fit the network.
    """
    known = of_file(path.name)
    found = read_tensors(path, kind=kind or (known.kind if known else None))
    yield "sha256", found.sha256, True
    values = sum(tensor.numel() for tensor in found.tensors.values())
    yield "tensors", f"{len(found.tensors)}, {values / 1e6:.1f} M values; {recognised(found.tensors)}", True
    told = kind_of(found.tensors) or (known.kind if known else "")
    if known is not None:
        yield "name", f"{known.name}: {known.kind}", told == known.kind
    check_finite(found.tensors, str(path))
    yield "values", "all finite", True
    if told == "depth_anything":
        yield from _depth_anything(path, found, range_of(path.name, found.metadata, variant, "--variant"))
    elif told == "flash3d":
        yield from _flash3d(found)
    elif told in ("mast3r", "dust3r"):
        yield from _two_view(found, known.variant if known else found.metadata.get("variant", ""))
    elif told == "dinov2":
        yield from _dinov2(found)
    elif told == "m2f":
        yield from _m2f(found)
    elif "decode_head.conv_seg.weight" in found.tensors:
        yield from _head(found)
    else:
        yield "network", f"{told or 'unknown'}: shapes and output are not checked here", told != ""


def drawn_room(height: int = 240, width: int = 320) -> tuple[Picture, Float32Array]:
    """A picture HxWx3 uint8 of a room 4 x 2.5 x 5 m, tiles and lamp light, 60 degrees wide, and its depth HxW, m."""
    v, u = np.mgrid[0:height, 0:width]
    ray = np.stack([u - (width - 1) / 2, v - (height - 1) / 2, np.full(u.shape, 0.866 * width)], -1)
    ray /= ray[..., 2:]
    sides = np.array([[-2.0, -1.1, 0.1], [2.0, 1.4, 5.0]])
    with np.errstate(divide="ignore"):
        reach = np.where(ray > 0, sides[1], sides[0]) / np.where(ray == 0, 1e-9, ray)
    reach[..., 2] = sides[1, 2]
    wall, depth = reach.argmin(-1), reach.min(-1)
    point = ray * depth[..., None]
    tiles = (np.floor(point / 0.5).astype(int).sum(-1) % 2) * 0.25 + 0.75
    colours = np.array([[200, 190, 170], [150, 120, 90], [180, 200, 210]])[wall]
    light = 1 / (1 + 0.08 * ((point - (0, -1, 2.5)) ** 2).sum(-1))
    grain = np.random.default_rng(0).normal(0, 4, (height, width, 3))
    rgb = colours * (tiles * light)[..., None] + grain
    return np.clip(rgb, 0, 255).astype(np.uint8), depth.astype(np.float32)


def _depth_anything(path: Path, found: Tensors, max_depth: float) -> Iterator[Check]:
    from garps_core.models.depth_anything import built_from, depth_of_images

    model = built_from(found.tensors, max_depth)
    yield "shapes", f"Depth Anything V2 of width {model.pretrained.cls_token.shape[-1]}", True
    picture, true = drawn_room()
    (depth,) = depth_of_images(model, [picture])
    low, median, high = (float(x) for x in np.percentile(depth, (5, 50, 95)))
    words = f"{low:.2f} .. {median:.2f} .. {high:.2f} m (5, 50, 95 %)"
    yield "depth", words, low >= LOW_M and high <= SATURATED * max_depth
    likeness = _likeness(depth, true)
    yield _likeness_check(likeness, true)
    if likeness < -0.3 or median > SATURATED * max_depth:
        yield (
            "relative?",
            "near and far exchanged, or all as far as can be: probably the file of a relative model",
            False,
        )


def _likeness(depth: Float32Array, true: Float32Array) -> float:
    """Correlation of the logarithms of two depth maps."""
    logs = np.log(np.maximum(depth.ravel(), 1e-6)), np.log(true.ravel())
    return float(np.corrcoef(*logs)[0, 1]) if logs[0].std() > 1e-5 else 0.0


def _likeness_check(likeness: float, true: Float32Array) -> Check:
    words = f"correlation {likeness:.2f} with the drawn room, {np.median(true):.2f} m deep in the median"
    return "likeness", words, likeness > 0


def _two_view(found: Tensors, variant: str) -> Iterator[Check]:
    """Check a two-view network on a part of the drawn room and another that is SHIFT_PX further right and down."""
    from garps_core.models.mast3r import NaverModel
    from garps_core.models.two_view import built_from

    model = NaverModel(built_from(found.tensors), variant)
    sizes = model.network.architecture
    stacks = (f"{name} {stack.width} x {stack.blocks}" for name, stack in vars(sizes).items() if name.endswith("coder"))
    yield "shapes", f"{sizes.name}, {', '.join(stacks)}, {sizes.descriptors or 'no'} descriptors", True
    picture, room = drawn_room(240 + SHIFT_PX, 320 + SHIFT_PX)
    maps = model(picture[:240, :320].copy(), picture[SHIFT_PX:, SHIFT_PX:].copy())
    seen, framing = maps.source_first[0], maps.framings[0]
    depth, unit = seen.points[..., 2], "m" if maps.metric else "units of its own"
    low, median, high = (float(x) for x in np.percentile(depth, (5, 50, 95)))
    words = f"{low:.2f} .. {median:.2f} .. {high:.2f} {unit} (5, 50, 95 %)"
    yield "depth", words, LOW_M <= median <= HIGH_M if maps.metric else median > 0
    y, x = np.mgrid[: depth.shape[0], : depth.shape[1]]
    u, v = framing.to_image(np.stack([x.ravel(), y.ravel()], -1)).round().astype(int).clip(0, (319, 239)).T
    yield _likeness_check(_likeness(depth, room[v, u]), room[v, u])
    least, middle = float(seen.confidence.min()), float(np.median(seen.confidence))
    yield "confidence", f"at least {least:.2f}, {middle:.2f} in the median", least >= 1 and middle > 1
    if maps.source_first[1].descriptors is not None and seen.descriptors is not None:
        yield _descriptors(seen.descriptors, maps.source_first[1].descriptors, framing.scale)


def _descriptors(first: Float32Array, second: Float32Array, scale: tuple[float, float]) -> Check:
    """Check that descriptors are unit vectors, and more alike where both views see the same."""
    right, down = (round(SHIFT_PX * factor) for factor in scale)
    one, two = first[down:, right:], second[:-down, :-right]
    off = max(float(np.abs(np.linalg.norm(part, axis=-1) - 1).max()) for part in (one, two))
    same, others = (float((one * part).sum(-1).mean()) for part in (two, two[::-1, ::-1]))
    words = f"length 1 to {off:.0e}; likeness {same:.2f} where both views see the same, {others:.2f} elsewhere"
    return "descriptors", words, off < 1e-3 and same > others


def _flash3d(found: Tensors) -> Iterator[Check]:
    from garps_core.models.flash3d import HEIGHT, PAD, WIDTH, flash3d_network, flash3d_tensors

    kept, left = flash3d_tensors(found.tensors)
    network = flash3d_network(kept)
    others = ", ".join(f"{count} of {group}" for group, count in sorted(left.items())) or "none"
    yield "shapes", f"Flash3D; not read: {others}", True
    picture, depth = drawn_room(HEIGHT, WIDTH)
    border = ((PAD, PAD), (PAD, PAD))
    rgb = np.pad(picture, (*border, (0, 0))).transpose(2, 0, 1)[None] / np.float32(255)
    with torch.inference_mode():
        maps = network(torch.from_numpy(rgb), torch.from_numpy(np.pad(depth, border, "edge")[None, None]))
    opaque = maps.opacity[0].numpy()
    yield "opacity", f"{opaque.mean():.2f} +- {opaque.std():.2f}", bool(0.01 < opaque.mean() < 0.999)
    sigma = float(maps.sigmas.median())
    yield "sigmas", f"{1000 * sigma:.1f} mm, median", 1e-4 < sigma < 1
    offset = float(maps.offset.norm(dim=1).median())
    yield "offsets", f"{1000 * offset:.1f} mm, median", offset < 1


def _dinov2(found: Tensors) -> Iterator[Check]:
    from garps_core.models import vit

    tensors: Mapping[str, torch.Tensor] = found.tensors
    if not any(key.startswith("blocks.") for key in tensors):
        bare = {key.removeprefix("dinov2."): tensor for key, tensor in tensors.items()}
        tensors = vit.from_transformers({key: tensor for key, tensor in bare.items() if "classifier" not in key})
    size = vit.size_of(tensors)
    with torch.device("meta"):
        network = vit.VisionTransformer(vit.SIZES[size])
    load_strictly(network, tensors, f"DINOv2 {size}")
    yield "shapes", f"DINOv2 {size}", True


def _head(found: Tensors) -> Iterator[Check]:
    from garps_core.models.semantics import DecodeHead

    weight = found.tensors["decode_head.conv_seg.weight"]
    if weight.dim() != 4:
        raise WeightsError(f"decode_head.conv_seg.weight has {weight.dim()} dimensions: expected 4; damaged or another")
    classes, channels = weight.shape[:2]
    with torch.device("meta"):
        head = DecodeHead(channels, classes)
    inside = {key.removeprefix("decode_head."): tensor for key, tensor in found.tensors.items()}
    load_strictly(head, inside, "an ADE20K head")
    yield "shapes", f"a head on {channels} channels, {classes} classes (ADE20K has 150)", classes == 150


def _m2f(found: Tensors) -> Iterator[Check]:
    from garps_core.models.mask2former import mask2former_of

    mask2former_of(found.tensors)
    yield "shapes", "Mask2Former on ViT-Adapter, sizes as the file has them; its output is not checked here", True
