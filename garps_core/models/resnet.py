# SPDX-License-Identifier: Apache-2.0
"""ResNet-50 (He et al., 2015) as an encoder of pictures with depth; parameters named as in the usual files.

Four input channels, a bias in the first convolution, and the first feature taken before its normalisation.
"""

from __future__ import annotations

from torch import Tensor, nn
from torch.nn import functional as F

INPUT_CHANNELS = 4
STEM_CHANNELS = 64
STAGES = ((64, 3), (128, 4), (256, 6), (512, 3))
"""Inner width and number of blocks of the stages; each gives four times its inner width."""
EXPANSION = 4
FEATURE_CHANNELS = (STEM_CHANNELS, *(EXPANSION * width for width, _ in STAGES))


class Bottleneck(nn.Module):
    """1x1, 3x3, 1x1 convolutions beside a shortcut; the 3x3 one carries the stride."""

    def __init__(self, channels: int, width: int, stride: int) -> None:
        super().__init__()
        out = EXPANSION * width
        self.conv1 = nn.Conv2d(channels, width, 1, bias=False)
        self.bn1 = nn.BatchNorm2d(width)
        self.conv2 = nn.Conv2d(width, width, 3, stride=stride, padding=1, bias=False)
        self.bn2 = nn.BatchNorm2d(width)
        self.conv3 = nn.Conv2d(width, out, 1, bias=False)
        self.bn3 = nn.BatchNorm2d(out)
        self.downsample: nn.Module = nn.Identity()
        if stride != 1 or channels != out:
            self.downsample = nn.Sequential(nn.Conv2d(channels, out, 1, stride=stride, bias=False), nn.BatchNorm2d(out))

    def forward(self, x: Tensor) -> Tensor:  # noqa: D102
        y = F.relu(self.bn1(self.conv1(x)))
        y = F.relu(self.bn2(self.conv2(y)))
        return F.relu(self.bn3(self.conv3(y)) + self.downsample(x))


class ResNet50(nn.Module):
    """Picture (B, 4, H, W) -> five features of FEATURE_CHANNELS at 1/2, 1/4, 1/8, 1/16 and 1/32 of its sides."""

    def __init__(self) -> None:
        super().__init__()
        self.conv1 = nn.Conv2d(INPUT_CHANNELS, STEM_CHANNELS, 7, stride=2, padding=3, bias=True)
        self.bn1 = nn.BatchNorm2d(STEM_CHANNELS)
        self.layer1, self.layer2, self.layer3, self.layer4 = (
            _stage(channels, width, blocks, stride=1 if index == 0 else 2)
            for index, (channels, (width, blocks)) in enumerate(zip(FEATURE_CHANNELS, STAGES, strict=False))
        )

    def forward(self, picture: Tensor) -> list[Tensor]:
        """The first convolution's output, before its normalisation, and the outputs of the four stages."""
        stem: Tensor = self.conv1(picture)
        x = F.max_pool2d(F.relu(self.bn1(stem)), 3, stride=2, padding=1)
        features = [stem]
        for stage in (self.layer1, self.layer2, self.layer3, self.layer4):
            x = stage(x)
            features.append(x)
        return features


def _stage(channels: int, width: int, blocks: int, stride: int) -> nn.Sequential:
    first = Bottleneck(channels, width, stride)
    return nn.Sequential(first, *(Bottleneck(EXPANSION * width, width, 1) for _ in range(blocks - 1)))
