# SPDX-License-Identifier: Apache-2.0
"""Depth Anything V2 (Yang et al. 2024), the metric models: one image -> depth along the optical axis, in metres.

A DINOv2 transformer, a dense prediction head, a sigmoid and the largest depth of the training: 20 m (indoor) or 80 m
(outdoor). The weights do not tell which, nor whether they are a relative model's: the caller must know. The calibration
does not enter the network; its scale assumes the cameras of the training.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor, nn

from garps_core.checks import Float32Array
from garps_core.config import Reconstruction
from garps_core.devices import checked_device, on_device
from garps_core.errors import ConfigError, InputError, ModelError, ReconstructionError, WeightsError
from garps_core.models import vit
from garps_core.models.depth_networks import DepthNetwork
from garps_core.models.dpt import DptHead, Grid, enlarged
from garps_core.models.vit import PATCH, SIZES, VisionTransformer
from garps_core.types import View
from garps_core.weights.load import load_weights
from garps_core.weights.manifest import MAX_DEPTH_M, range_of
from garps_core.weights.state_dict import load_strictly

RGBImage = npt.NDArray[np.uint8]


@dataclass(frozen=True)
class HeadSize:
    """Blocks whose maps the head reads (0-based), channels of its pyramid and of its fusion."""

    taps: tuple[int, int, int, int]
    channels: tuple[int, int, int, int]
    features: int


HEADS: Mapping[str, HeadSize] = {
    "vits": HeadSize((2, 5, 8, 11), (48, 96, 192, 384), 64),
    "vitb": HeadSize((2, 5, 8, 11), (96, 192, 384, 768), 128),
    "vitl": HeadSize((4, 11, 17, 23), (256, 512, 1024, 1024), 256),
}
SHORT_SIDE = 518
"""Pixels of the shorter side of the network's input."""
LONGEST_SIDE = 8 * SHORT_SIDE
MEAN, DEVIATION = (0.485, 0.456, 0.406), (0.229, 0.224, 0.225)
"""Mean and deviation of red, green and blue (0..1) in the training images."""
TRAINING_FX = 0.5 / np.tan(np.radians(60) / 2)
"""Focal length over image width of the indoor training's cameras: 60 deg wide."""
DTYPES = {torch.float32, torch.float16, torch.bfloat16}
AT_THE_END = 0.98
"""Share of the network's largest depth beyond which a pixel is at the end of the network's range."""


class DepthAnythingV2(nn.Module):
    """The metric network of one size (`HEADS`); `state_dict` has the keys of the official files. max_depth: metres."""

    def __init__(self, size: str, max_depth: float) -> None:
        super().__init__()
        self.head = HEADS[size]
        self.max_depth = max_depth
        self.pretrained = VisionTransformer(SIZES[size])
        self.depth_head = DptHead(SIZES[size].width, self.head.channels, self.head.features)

    def forward(self, image: Tensor) -> Tensor:
        """(B, 3, H, W), normalised, sides multiples of 14 -> depth (B, H, W), float32, metres."""
        logit: Tensor = self.depth_head(self.pretrained(image, self.head.taps))
        return self.max_depth * logit.squeeze(1).float().sigmoid()


def load_network(weights: str, scene: str, device: str) -> DepthAnythingV2:
    """Read the weights by name or file ("" = the first installed) and build the network on the device.

    scene: any, indoor or outdoor. Raises WeightsError, ConfigError, ModelError.
    """
    variant = "" if scene == "any" else scene
    path, read = load_weights(weights, "depth_anything", variant)
    network = built_from(read.tensors, range_of(path.name, read.metadata, variant, "reconstruction.scene"))
    return on_device(network, device)


def depths(network: DepthAnythingV2, views: Sequence[View], settings: Reconstruction) -> list[Float32Array]:
    """Depth of each view, HxW float32 m along z, all in one pass.

    Raises ReconstructionError where most of a picture lies at the end of the range; else as `depth_of_images`.
    """
    images = [view.rgb for view in views]
    fx = [float(view.K[0, 0]) for view in views] if settings.focal_correction else None
    found = depth_of_images(network, images, fx=fx, dtype=getattr(torch, settings.network_dtype))
    for view, depth, largest_m in zip(views, found, network.max_depth * focal_factors(images, fx), strict=True):
        _check_range(view, depth, float(largest_m))
    return found


def _check_range(view: View, depth: Float32Array, largest_m: float) -> None:
    far = float(np.mean(depth >= AT_THE_END * largest_m))
    if far > 0.5:
        raise ReconstructionError(
            f"{far:.0%} of the network's depth of {view.frame_id or 'a view'} is {largest_m:g} m, all it can say: "
            "expected rooms for indoor weights, streets for outdoor ones, and no relative model's"
        )


def built_from(tensors: Mapping[str, Tensor], max_depth: float) -> DepthAnythingV2:
    """The network of the size that the tensors have, with them as its float32 parameters, ready to be used.

    tensors: of an official file or, under the names of `transformers`, of an `-hf` file. max_depth: metres, 20 for
    indoor and 80 for outdoor weights. Raises ConfigError unless it is positive; WeightsError where tensors are missing,
    too many, misshaped or not finite.
    """
    if not (np.isfinite(max_depth) and max_depth > 0):
        raise ConfigError(
            f"max_depth = {max_depth:g}: expected metres above 0, {MAX_DEPTH_M} as the weights were trained"
        )
    if any(key.startswith("backbone.") for key in tensors):
        tensors = from_transformers(tensors)
    size = vit.size_of(tensors, "pretrained.")
    if size not in HEADS:
        raise WeightsError(f"Depth Anything V2 of size {size}: expected one of {', '.join(HEADS)}")
    with torch.device("meta"):  # nothing is allocated or initialised twice
        model = DepthAnythingV2(size, max_depth)
    load_strictly(model, tensors, f"Depth Anything V2 {size}")
    model.eval().requires_grad_(False)
    model.depth_head.to(memory_format=torch.channels_last)  # type: ignore[call-overload]
    return model


_OTHER_NAMES = (
    (r"^neck\.reassemble_stage\.layers\.(\d)\.projection\.", r"projects.\1."),
    (r"^neck\.reassemble_stage\.layers\.(\d)\.resize\.", r"resize_layers.\1."),
    *((rf"^neck\.convs\.{i - 1}\.", f"scratch.layer{i}_rn.") for i in (1, 2, 3, 4)),
    *(
        (
            rf"^neck\.fusion_stage\.layers\.{4 - i}\.residual_layer(\d)\.convolution(\d)\.",
            rf"scratch.refinenet{i}.resConfUnit\1.conv\2.",
        )
        for i in (1, 2, 3, 4)
    ),
    *(
        (rf"^neck\.fusion_stage\.layers\.{4 - i}\.projection\.", f"scratch.refinenet{i}.out_conv.")
        for i in (1, 2, 3, 4)
    ),
    (r"^head\.conv1\.", "scratch.output_conv1."),
    (r"^head\.conv2\.", "scratch.output_conv2.0."),
    (r"^head\.conv3\.", "scratch.output_conv2.2."),
)


def from_transformers(tensors: Mapping[str, Tensor]) -> dict[str, Tensor]:
    """Tensors of an `-hf` file, as the `transformers` library names them -> the same under the official names.

    Raises WeightsError for an unexpected name, or an incomplete attention layer.
    """
    prefix = "backbone."
    backbone = {key.removeprefix(prefix): value for key, value in tensors.items() if key.startswith(prefix)}
    head = {key: value for key, value in tensors.items() if not key.startswith(prefix)}
    official = {f"pretrained.{key}": value for key, value in vit.from_transformers(backbone).items()}
    return official | {f"depth_head.{key}": value for key, value in vit.renamed(head, _OTHER_NAMES).items()}


def depth_of_images(
    model: DepthAnythingV2,
    images: Sequence[RGBImage],
    *,
    depth_scale: float = 1.0,
    fx: Sequence[float] | None = None,
    device: torch.device | str | None = None,
    dtype: torch.dtype = torch.float32,
) -> list[Float32Array]:
    """Depth along the optical axis of each image: HxW float32, metres.

    Images whose network sizes agree share one pass.

    Args:
        model: on any device.
        images: HxWx3 uint8 RGB.
        depth_scale: factor on every depth.
        fx: focal lengths in pixels, one per image, for depth * (fx / W) / (that of the training's cameras); depth is
            not corrected when None.
        device: the model is moved there; it stays where it is when None.
        dtype: of the layers that autocast may compute in less than float32, for a GPU (a CPU is often slower in it);
            the sigmoid and the resize to the image never do.
    Raises:
        InputError: no such image, one smaller than a patch or too elongated; focal lengths that cannot be.
        ConfigError: a scale, device or dtype that cannot be.
        ModelError: too little memory for one image, or depth that is not finite.
    """
    if not (np.isfinite(depth_scale) and depth_scale > 0):
        raise ConfigError(f"depth_scale = {depth_scale:g}: expected a factor above 0, 1 to leave depth as it is")
    if dtype not in DTYPES:
        raise ConfigError(f"dtype {dtype}: expected one of {', '.join(sorted(map(str, DTYPES)))}")
    sizes = [network_size(checked_image(image)) for image in images]
    scales = np.float32(depth_scale) * focal_factors(images, fx)
    if device is not None:
        model.to(checked_device(str(device)))
    found: dict[int, Float32Array] = {}
    for size in dict.fromkeys(sizes):
        members = [i for i, own in enumerate(sizes) if own == size]
        depths = _passed(model, [resized_input(images[i], size) for i in members], dtype)
        for i, depth in zip(members, depths, strict=True):
            found[i] = scales[i] * _resized_back(depth, images[i].shape[:2])
    return [found[i] for i in range(len(images))]


def checked_image(image: Any) -> RGBImage:
    """The image itself. Raises InputError unless it is an array HxWx3 of uint8."""
    if not isinstance(image, np.ndarray) or image.dtype != np.uint8 or image.ndim != 3 or image.shape[2] != 3:
        told = f"{image.dtype} {image.shape}" if isinstance(image, np.ndarray) else type(image).__name__
        raise InputError(f"image is {told}: expected an RGB image, HxWx3 uint8")
    return image


def network_size(image: RGBImage) -> Grid:
    """Rows and columns of the network's input: the shorter side about 518, both multiples of 14.

    Raises InputError for an image smaller than a patch, or so elongated that its longer side would exceed 4144.
    """
    height, width = image.shape[:2]
    if min(height, width) < PATCH:
        raise InputError(f"image of {width}x{height} pixels: expected at least {PATCH}x{PATCH}, one patch")
    factor = max(SHORT_SIDE / height, SHORT_SIDE / width)
    rows, columns = (round(side * factor / PATCH) * PATCH for side in (height, width))
    if max(rows, columns) > LONGEST_SIDE:
        raise InputError(
            f"image of {width}x{height} pixels would enter the network as {columns}x{rows}: expected at most "
            f"{LONGEST_SIDE} pixels on the longer side, that is {LONGEST_SIDE // SHORT_SIDE} to 1. Crop the image"
        )
    return rows, columns


def resized_input(image: RGBImage, size: Grid) -> Tensor:
    """HxWx3 uint8 RGB -> the network's input (3, *size), float32: cubic resize of 0..1 and normalised, in float64."""
    resized = cv2.resize(image / 255.0, size[::-1], interpolation=cv2.INTER_CUBIC)
    normalised = (resized - np.array(MEAN)) / np.array(DEVIATION)
    return torch.from_numpy(np.ascontiguousarray(normalised.transpose(2, 0, 1), np.float32))


def focal_factors(images: Sequence[RGBImage], fx: Sequence[float] | None) -> Float32Array:
    """Factor on each image's depth for its focal length in pixels, 1 without one."""
    if fx is None:
        return np.ones(len(images), np.float32)
    if len(fx) != len(images) or not all(np.isfinite(f) and f > 0 for f in fx):
        raise InputError(f"fx = {list(fx)} for {len(images)} images: expected one positive focal length each, pixels")
    widths = [image.shape[1] for image in images]
    return np.array([f / width / TRAINING_FX for f, width in zip(fx, widths, strict=True)], np.float32)


def _passed(model: DepthAnythingV2, inputs: Sequence[Tensor], dtype: torch.dtype) -> list[Tensor]:
    """Depth (H, W) of each input; in one pass, or one by one where the device's memory does not suffice for that."""
    device = next(model.parameters()).device
    try:
        return list(_pass(model, torch.stack(list(inputs)).to(device), dtype))
    except torch.cuda.OutOfMemoryError:
        torch.cuda.empty_cache()
    try:
        return [_pass(model, one[None].to(device), dtype)[0] for one in inputs]
    except torch.cuda.OutOfMemoryError as error:
        rows, columns = inputs[0].shape[-2:]
        raise ModelError(
            f"out of memory on {device} with one image of {columns}x{rows} pixels: expected it to fit. Free memory, "
            f"choose a smaller model or float16, or run on the CPU ({error})"
        ) from None


def _pass(model: DepthAnythingV2, batch: Tensor, dtype: torch.dtype) -> Tensor:
    """(B, 3, H, W) -> (B, H, W), metres. Raises ModelError where the depth is not finite."""
    with torch.inference_mode(), torch.autocast(batch.device.type, dtype, enabled=dtype != torch.float32):
        depth: Tensor = model(batch)
    if not depth.isfinite().all():
        raise ModelError(
            f"the network returned NaN or infinity in {dtype}: expected metres. Are the weights damaged, or is "
            "float32 needed?"
        )
    return depth


def _resized_back(depth: Tensor, size: Grid) -> Float32Array:
    """Depth (h, w) at the network's size -> at the image's, corner pixels on corner pixels."""
    return enlarged(depth[None, None], size)[0, 0].cpu().numpy()


NETWORK = DepthNetwork(
    "Depth Anything V2, metric, for rooms or for streets", load_network, depths, weights_kind="depth_anything"
)
