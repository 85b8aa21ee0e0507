# SPDX-License-Identifier: Apache-2.0
"""The demonstration depth network, trained on generated rooms alone and shipped with the package: one image and its
intrinsics -> depth in metres.

It gives a pose from two plain images without any download. It was not trained on real pictures; docs/demo_net.md
lists its errors. It is used only if it is selected by name.

A picture of any size is brought to 192x256 pixels. Beside its colours the network gets the slopes x/z and y/z of every
pixel's ray; it returns depth over focal length, the quantity that a picture determines without intrinsics. It is
trained by `python -m bench.train_depth`.
"""

from __future__ import annotations

from collections.abc import Sequence
from importlib.resources import as_file, files

import cv2
import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor, nn
from torch.nn import functional as F

from garps_core.checks import Float32Array
from garps_core.config import Reconstruction
from garps_core.devices import on_device
from garps_core.errors import InputError, ModelError
from garps_core.models.depth_networks import DepthNetwork
from garps_core.types import View
from garps_core.weights.reader import read_tensors
from garps_core.weights.state_dict import load_strictly

HEIGHT, WIDTH = 192, 256
"""Pixels of the network's input; its answer has half as many a side."""
CHANNELS = (24, 32, 64, 96, 128)
"""Channels of the maps at 1/2, 1/4 ... 1/32 of the input."""
BLOCKS = (0, 2, 2, 2, 1)
"""Residual blocks of each of these maps."""
MEAN, DEVIATION = 0.45, 0.25
"""Mean and deviation of the colours, 0..1."""
UNIT_FOCAL_PX = 220.0
"""Unit of the focal length, in pixels of the input."""
WHAT_IT_IS = "a demonstration: it knows generated rooms only, its depth of real pictures means little"
FILE = "demo_net.safetensors"
MAX_BYTES = 6_000_000
MAX_ASPECT = 3
"""Largest ratio of a picture's sides, as in training."""


class Unit(nn.Sequential):
    """Convolution, batch norm (in training; folded into the convolution for use) and ReLU."""

    def __init__(self, inside: int, outside: int, stride: int = 1, kernel: int = 3, norm: bool = False) -> None:
        super().__init__(
            nn.Conv2d(inside, outside, kernel, stride, kernel // 2, bias=not norm),
            nn.BatchNorm2d(outside) if norm else nn.Identity(),
            nn.ReLU(inplace=True),
        )


class Residual(nn.Module):
    """Two convolutions, added to what came in."""

    def __init__(self, width: int, norm: bool) -> None:
        super().__init__()
        self.first, self.second = Unit(width, width, norm=norm), Unit(width, width, norm=norm)

    def forward(self, x: Tensor) -> Tensor:
        """(B, C, h, w) -> (B, C, h, w)."""
        added: Tensor = x + self.second(self.first(x))
        return added


class DemoNet(nn.Module):
    """Five levels down, four up, each with a skip connection; the coarsest level sees the whole picture."""

    def __init__(self, norm: bool = False) -> None:
        super().__init__()
        into = (5, *CHANNELS[:-1])
        self.down = nn.ModuleList(
            nn.Sequential(Unit(i, o, 2, norm=norm), *(Residual(o, norm) for _ in range(n)))
            for i, o, n in zip(into, CHANNELS, BLOCKS, strict=True)
        )
        self.whole = nn.Sequential(nn.Linear(CHANNELS[-1], CHANNELS[-1]), nn.ReLU(inplace=True))
        ways = list(zip(CHANNELS[:0:-1], CHANNELS[-2::-1], strict=True))
        self.narrow = nn.ModuleList(Unit(i, o, kernel=1, norm=norm) for i, o in ways)
        self.up = nn.ModuleList(Residual(o, norm) if o > CHANNELS[0] else Unit(o, o, norm=norm) for _, o in ways)
        self.answer = nn.Conv2d(CHANNELS[0], 1, 3, padding=1)

    def forward(self, picture: Tensor) -> Tensor:
        """(B, 5, 192, 256) of `demo_input` -> logarithm of depth (m) over focal length (as the unit), (B, 96, 128)."""
        maps = []
        x = picture
        for level in self.down:
            x = level(x)
            maps.append(x)
        x = x + self.whole(x.mean((2, 3)))[..., None, None]
        for narrow, up, skip in zip(self.narrow, self.up, maps[-2::-1], strict=True):
            x = up(F.interpolate(narrow(x), skip.shape[-2:], mode="bilinear", align_corners=False) + skip)
        logarithm: Tensor = self.answer(x)[:, 0]
        return logarithm


def load_network(weights: str, scene: str, device: str) -> DemoNet:
    """Load the network of the package onto the device; it has one set of weights, so weights and scene do not count."""
    return on_device(shipped(), device)


def shipped() -> DemoNet:
    """Build the network with the weights of this package. Raises WeightsError if they are missing."""
    with as_file(files("garps_core.models").joinpath(FILE)) as path:
        tensors = read_tensors(path, max_bytes=MAX_BYTES).tensors
    network = DemoNet()
    load_strictly(network, tensors, "the demonstration network", dtype=torch.float32)
    return network.eval().requires_grad_(False).to(memory_format=torch.channels_last)  # type: ignore[call-overload, no-any-return]


def demo_input(rgb: npt.NDArray[np.uint8], K: npt.NDArray[np.float64]) -> tuple[Float32Array, float]:
    """HxWx3 uint8 and 3x3 K (pixel centres at integers) -> input (5, 192, 256), and the focal length as the unit."""
    height, width = rgb.shape[:2]
    scale_x, scale_y = WIDTH / width, HEIGHT / height
    shrinks = scale_x < 1 or scale_y < 1
    colours = cv2.resize(rgb, (WIDTH, HEIGHT), interpolation=cv2.INTER_AREA if shrinks else cv2.INTER_LINEAR)
    fx, fy = K[0, 0] * scale_x, K[1, 1] * scale_y
    cx, cy = (K[0, 2] + 0.5) * scale_x - 0.5, (K[1, 2] + 0.5) * scale_y - 0.5
    found = np.empty((5, HEIGHT, WIDTH), np.float32)
    found[:3] = (colours.transpose(2, 0, 1) / np.float32(255) - np.float32(MEAN)) / np.float32(DEVIATION)
    found[3] = (np.arange(WIDTH) - cx) / fx
    found[4] = ((np.arange(HEIGHT) - cy) / fy)[:, None]
    return found, float(np.sqrt(fx * fy) / UNIT_FOCAL_PX)


def depth_of_views(
    network: DemoNet, views: Sequence[View], settings: Reconstruction | None = None
) -> list[Float32Array]:
    """Depth of each view, HxW float32 m along z, all in one pass; no setting changes it.

    Raises:
        InputError: a picture more than `MAX_ASPECT` times as long as wide, or as wide as long.
        ModelError: depth that is not finite.
    """
    for view in views:
        height, width = view.rgb.shape[:2]
        if max(height, width) > MAX_ASPECT * min(height, width):
            raise InputError(f"rgb is {width}x{height}: expected sides within a factor of {MAX_ASPECT} for demo_net")
    inputs, focals = zip(*(demo_input(view.rgb, view.K) for view in views), strict=True)
    device = next(network.parameters()).device
    with torch.inference_mode():
        logarithms = network(torch.from_numpy(np.stack(inputs)).to(device)).float().cpu().numpy()
    return [
        _enlarged(one, focal, view.rgb.shape[:2]) for one, focal, view in zip(logarithms, focals, views, strict=True)
    ]


def _enlarged(logarithm: Float32Array, focal: float, size: tuple[int, ...]) -> Float32Array:
    """Depth in the picture's size: inverse depth is interpolated, which is linear in the pixel on a plane."""
    inverse = np.exp(-logarithm) / np.float32(focal)
    depth = np.float32(1) / cv2.resize(inverse, size[::-1], interpolation=cv2.INTER_LINEAR)
    if not np.isfinite(depth).all():
        raise ModelError("the depth of demo_net is not finite: expected numbers. Is its file what was shipped?")
    return np.asarray(depth, np.float32)


NETWORK = DepthNetwork("in the package", load_network, depth_of_views, preset="demo_net", warning=WHAT_IT_IS)
