"""A residual network of our own: torchvision and timm, which have one, do not load beside every PyTorch.

He, Zhang, Ren, Sun: Deep residual learning for image recognition, CVPR 2016, with group normalisation
(Wu and He, ECCV 2018) instead of that over batches: frames of one window in a batch resemble each other, and
domain adaptation sees one person only.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Literal

import torch
from torch import Tensor, nn

from toile.errors import InputError
from toile.limits import Count, Positive

CHANNELS = 4
"""Of the input: red, green, blue times the mask of the person, and the mask of the garment."""

_STRIDE = 32
_GROUP = 16  # channels that are normalised together


@dataclass(frozen=True)
class BackboneSettings:
    """Size of a network.

    Attributes:
        depth: 10, 18 or 50 layers.
        width: channels as a multiple of those in He et al.; sums are rounded to 8.
        side: of the square input images [px].
        grid: cells per side that features are averaged over; 1 in He et al., where a picture is of one thing
            wherever that is. Here it matters where in the crop a limb is.
    """

    depth: Literal[10, 18, 50] = 18
    width: Positive = 0.5
    side: Count = 128
    grid: Count = 4

    def __post_init__(self) -> None:
        if self.depth not in _LAYERS:
            raise InputError(
                "No such backbone",
                where="backbone.depth",
                expected=", ".join(map(str, _LAYERS)),
                got=str(self.depth),
            )
        if self.side < _STRIDE or self.side // _STRIDE < self.grid:
            raise InputError(
                "Images are too small for the backbone",
                where="backbone.side",
                expected=f"at least {_STRIDE} px per cell of its grid, {_STRIDE * self.grid} px",
                got=f"{self.side} px",
            )


class ResNet(nn.Module):
    """Features of images.

    Args:
        settings: see BackboneSettings.

    Attributes:
        n_features: C, numbers that an image becomes.
    """

    def __init__(self, settings: BackboneSettings) -> None:
        super().__init__()
        self.settings = settings
        layers, block = _LAYERS[settings.depth]
        stem = max(8, 8 * round(64 * settings.width / 8))
        self.stem = nn.Sequential(
            nn.Conv2d(CHANNELS, stem, 7, 2, 3, bias=False),
            _norm(stem),
            nn.ReLU(),
            nn.MaxPool2d(3, 2, 1),
        )
        channels, stages = stem, []
        for stage, count in enumerate(layers):
            for number in range(count):
                stride = 2 if stage and not number else 1
                made = block(channels, stem * 2**stage, stride)
                channels = made.channels
                stages.append(made)
        self.stages = nn.Sequential(*stages)
        self.pool = nn.AdaptiveAvgPool2d(settings.grid)
        self.n_features = channels * settings.grid**2

    def forward(self, images: Tensor) -> Tensor:
        """Features.

        Args:
            images: (B, 4, S, S), see ``CHANNELS``; S the settings' side.

        Returns:
            (B, C).

        Raises:
            InputError: images of another shape.
        """
        side = self.settings.side
        if images.ndim != 4 or images.shape[1:] != (CHANNELS, side, side):
            raise InputError(
                "Images do not fit the network",
                where="images",
                expected=f"(B, {CHANNELS}, {side}, {side})",
                got=str(tuple(images.shape)),
            )
        # Centred: most of a segmented image is black.
        features: Tensor = self.pool(self.stages(self.stem(images - 0.25))).flatten(1)
        return features


class _Block(nn.Module):
    """Two convolutions beside a short cut, as in the shallow networks of He et al."""

    def __init__(self, channels: int, width: int, stride: int) -> None:
        super().__init__()
        self.channels = width
        self.way = nn.Sequential(
            nn.Conv2d(channels, width, 3, stride, 1, bias=False),
            _norm(width),
            nn.ReLU(),
            nn.Conv2d(width, width, 3, 1, 1, bias=False),
            _norm(width),
        )
        self.short = _short_cut(channels, width, stride)

    def forward(self, x: Tensor) -> Tensor:
        return torch.relu(self.way(x) + self.short(x))


class _Bottleneck(nn.Module):
    """Three convolutions, the middle one between fewer channels, as in the deep networks of He et al."""

    def __init__(self, channels: int, width: int, stride: int) -> None:
        super().__init__()
        self.channels = 4 * width
        self.way = nn.Sequential(
            nn.Conv2d(channels, width, 1, bias=False),
            _norm(width),
            nn.ReLU(),
            nn.Conv2d(width, width, 3, stride, 1, bias=False),
            _norm(width),
            nn.ReLU(),
            nn.Conv2d(width, self.channels, 1, bias=False),
            _norm(self.channels),
        )
        self.short = _short_cut(channels, self.channels, stride)

    def forward(self, x: Tensor) -> Tensor:
        return torch.relu(self.way(x) + self.short(x))


_MakeBlock = Callable[[int, int, int], "_Block | _Bottleneck"]
_LAYERS: Mapping[int, tuple[tuple[int, int, int, int], _MakeBlock]] = {
    10: ((1, 1, 1, 1), _Block),
    18: ((2, 2, 2, 2), _Block),
    50: ((3, 4, 6, 3), _Bottleneck),
}


def _short_cut(channels: int, width: int, stride: int) -> nn.Module:
    if stride == 1 and channels == width:
        return nn.Identity()
    return nn.Sequential(nn.Conv2d(channels, width, 1, stride, bias=False), _norm(width))


def _norm(channels: int) -> nn.GroupNorm:
    groups = max(1, channels // _GROUP)
    return nn.GroupNorm(groups if channels % groups == 0 else 1, channels)
