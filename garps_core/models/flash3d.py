# SPDX-License-Identifier: Apache-2.0
"""Flash3D (Szymanowicz et al., 2024): a picture with metric depth -> two 3D Gaussians per pixel, one behind the other.

This is the part after the depth network, which may be any; its parameters are named as in the published file.
`flash3d.py` makes the input from a view and a mixture from the output.

    layer 0 stands on the given depth, layer 1 behind it: depth_1 = depth_0 + exp(clamp(r, -10, 6))
    per pixel and layer: offset (m, camera axes), opacity, sigmas (m), rotation (w, x, y, z), colour harmonics
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from garps_core.errors import WeightsError
from garps_core.models.resnet import FEATURE_CHANNELS, ResNet50
from garps_core.weights.load import load_weights
from garps_core.weights.state_dict import load_strictly

LAYERS = 2
HEIGHT, WIDTH = 256, 384
"""Size of the resized picture, pixels."""
PAD = 32
"""Border around the resized picture, pixels on every side."""
PADDED = (HEIGHT + 2 * PAD, WIDTH + 2 * PAD)

GAUSSIAN_CHANNELS = (32, 32, 64, 128, 256)
DEPTH_CHANNELS = (16, 32, 64, 128, 256)
PARTS = {"offset": 3, "opacity": 1, "scale": 3, "rotation": 4, "harmonics_0": 3, "harmonics_1": 9}
"""Meaning of the 23 channels of a Gaussian decoder, in their order."""

DEPTH_UNIT_M = 20.0
MEAN, DEVIATION = 0.45, 0.225
LOG_STEP_RANGE = (-10.0, 6.0)
SCALE_UNIT_M = 0.01

FIRST_KEY = "encoder.encoder.conv1.weight"
COUNTER = "num_batches_tracked"


@dataclass(frozen=True, eq=False)
class GaussianMaps:
    """The output of the network for every pixel of the padded picture; float32, first index = layer.

    Args:
        depth: (2, 1, H, W) m along z.
        offset: (2, 3, H, W) m, camera axes, from the pixel's point at `depth` to the mean.
        opacity: (2, 1, H, W) 0..1.
        sigmas: (2, 3, H, W) m, standard deviations along the axes of `rotation`.
        rotation: (2, 4, H, W) unit quaternion w, x, y, z: axes of the Gaussian into the camera's.
        harmonics: (2, 3, H, W) constant spherical harmonic of red, green and blue.
    """

    depth: Tensor
    offset: Tensor
    opacity: Tensor
    sigmas: Tensor
    rotation: Tensor
    harmonics: Tensor


class PaddedConv(nn.Module):
    """3x3 convolution that mirrors the picture at its border."""

    def __init__(self, channels: int, out: int) -> None:
        super().__init__()
        self.conv = nn.Conv2d(channels, out, 3, padding=1, padding_mode="reflect")

    def forward(self, x: Tensor) -> Tensor:  # noqa: D102
        y: Tensor = self.conv(x)
        return y


class ConvBlock(nn.Module):
    """A 3x3 convolution, followed by ELU."""

    def __init__(self, channels: int, out: int) -> None:
        super().__init__()
        self.conv = PaddedConv(channels, out)

    def forward(self, x: Tensor) -> Tensor:  # noqa: D102
        return F.elu(self.conv(x))


class Decoder(nn.Module):
    """Features, coarse to fine: at each of five levels a block, twice the size, the finer feature, a block."""

    def __init__(self, widths: tuple[int, ...]) -> None:
        super().__init__()
        blocks: list[nn.Module] = []
        channels = FEATURE_CHANNELS[-1]
        for level in reversed(range(len(widths))):
            beside = FEATURE_CHANNELS[level - 1] if level else 0
            blocks += [ConvBlock(channels, widths[level]), ConvBlock(widths[level] + beside, widths[level])]
            channels = widths[level]
        self.decoder = nn.ModuleList(blocks)

    def upsampled(self, features: list[Tensor]) -> Tensor:
        """Five features -> (B, widths[0], H, W) at the full size."""
        x, finer = features[-1], features[-2::-1]
        for step in range(len(features)):
            x = F.interpolate(self.decoder[2 * step](x), scale_factor=2, mode="nearest")
            if step < len(finer):
                x = torch.cat((x, finer[step]), dim=1)
            x = self.decoder[2 * step + 1](x)
        return x


class DepthDecoder(Decoder):
    """Logarithm (B, 1, H, W) of how far layer 1 lies behind layer 0, m; not yet clamped."""

    def __init__(self) -> None:
        super().__init__(DEPTH_CHANNELS)
        self.decoder.append(PaddedConv(DEPTH_CHANNELS[0], 1))

    def forward(self, features: list[Tensor]) -> Tensor:  # noqa: D102
        y: Tensor = self.decoder[-1](self.upsampled(features))
        return y


class GaussianDecoder(Decoder):
    """The 23 numbers (B, 23, H, W) of the Gaussians of one layer, not yet activated."""

    def __init__(self) -> None:
        super().__init__(GAUSSIAN_CHANNELS)
        self.out = nn.Conv2d(GAUSSIAN_CHANNELS[0], sum(PARTS.values()), 1)

    def forward(self, features: list[Tensor]) -> Tensor:  # noqa: D102
        y: Tensor = self.out(self.upsampled(features))
        return y


class Flash3D(nn.Module):
    """Encoder, depth decoder and one Gaussian decoder per layer; `state_dict` has the 385 keys behind the prefix."""

    def __init__(self) -> None:
        super().__init__()
        self.encoder = nn.ModuleDict({"encoder": ResNet50()})
        self.models = nn.ModuleDict({"depth": DepthDecoder()})
        for layer in range(LAYERS):
            self.models[f"gauss_decoder_{layer}"] = GaussianDecoder()

    def forward(self, picture: Tensor, depth: Tensor) -> GaussianMaps:
        """Gaussians of the padded picture.

        Args:
            picture: (1, 3, H, W) RGB 0..1 with its border, H and W multiples of 32.
            depth: (1, 1, H, W) m along z, every pixel known.
        """
        stacked = torch.cat((picture, depth / DEPTH_UNIT_M), dim=1)
        features = self.encoder["encoder"]((stacked - MEAN) / DEVIATION)
        step = self.models["depth"](features)
        raw = [self.models[f"gauss_decoder_{layer}"](features) for layer in range(LAYERS)]
        with torch.autocast(picture.device.type, enabled=False):
            return _activated(depth.float(), step.float(), torch.cat(raw).float())


def _activated(depth: Tensor, step: Tensor, raw: Tensor) -> GaussianMaps:
    part = dict(zip(PARTS, torch.split(raw, list(PARTS.values()), dim=1), strict=True))
    return GaussianMaps(
        depth=torch.cat((depth, depth + step.clamp(*LOG_STEP_RANGE).exp())),
        offset=part["offset"],
        opacity=part["opacity"].sigmoid(),
        sigmas=part["scale"].exp() * SCALE_UNIT_M,
        rotation=F.normalize(part["rotation"], dim=1),
        harmonics=part["harmonics_0"],
    )


def flash3d_tensors(state: Mapping[str, Tensor]) -> tuple[dict[str, Tensor], dict[str, int]]:
    """Pick the tensors of `Flash3D` from the entry "model" of a published file.

    Such a file also holds the authors' depth network, under another licence: that is never read.

    Args:
        state: keys under a prefix of any kind, which is that of the four-channel first convolution.
    Returns:
        the 385 tensors by their names in `Flash3D`, and how many others were left out, by their common prefix.
    Raises:
        WeightsError: another kind of file; names the first key that is missing or has another shape.
    """
    prefix = _prefix_of(state)
    with torch.device("meta"):
        expected = Flash3D().state_dict()
    found = {}
    for name, like in expected.items():
        tensor = state.get(prefix + name)
        if tensor is None and name.endswith(COUNTER):
            tensor = torch.zeros((), dtype=torch.int64)
        if tensor is None:
            raise WeightsError(
                f"no {prefix + name}: expected all {len(expected)} tensors of Flash3D. Is the file whole?"
            )
        if tensor.shape != like.shape:
            raise WeightsError(
                f"{prefix + name} has shape {tuple(tensor.shape)}: expected {tuple(like.shape)}, "
                "as in the file for two layers and harmonics of degree 1"
            )
        found[name] = tensor
    read = {prefix + name for name in expected}
    left = Counter(_group_of(key, prefix) for key in state if key not in read)
    return found, dict(left)


def load_network(weights: str) -> Flash3D:
    """Read the weights by name or file ("" = the first installed) and build the network. Raises WeightsError."""
    return flash3d_network(flash3d_tensors(load_weights(weights, "flash3d")[1].tensors)[0])


def flash3d_network(tensors: Mapping[str, Tensor]) -> Flash3D:
    """The network with what `flash3d_tensors` found, float32 on the CPU, for inference.

    Raises WeightsError for tensors that are missing, too many, misshaped or not finite.
    """
    with torch.device("meta"):
        network = Flash3D()
    load_strictly(network, tensors, "Flash3D")
    network.to(memory_format=torch.channels_last)  # type: ignore[call-overload]  # convolves faster
    return network.eval().requires_grad_(False)


def _prefix_of(state: Mapping[str, Tensor]) -> str:
    shape = (FEATURE_CHANNELS[0], 4, 7, 7)
    found = [key for key, tensor in state.items() if key.endswith(FIRST_KEY) and tuple(tensor.shape) == shape]
    if len(found) != 1:
        raise WeightsError(
            f"{len(found)} keys end in {FIRST_KEY} with shape {shape} among {len(state)} tensors "
            f"({', '.join(list(state)[:3])}, ...): expected one. Is this the file of Flash3D?"
        )
    return found[0].removesuffix(FIRST_KEY)


def _group_of(key: str, prefix: str) -> str:
    """Prefix and the next word, or the first word of a key elsewhere."""
    within = prefix if key.startswith(prefix) else ""
    return within + key.removeprefix(within).split(".")[0]
