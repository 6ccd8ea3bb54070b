"""Parts that convolutional networks of several kinds share."""

from __future__ import annotations

import torch
from torch import Tensor, nn

GROUPS = 8
"""Groups of channels that are normalised together (Wu and He 2018)."""


class ResidualBlock(nn.Module):
    """Residual block of two convolutions (B, ``width``, H, W), normalised before each (He et al.
    2016)."""

    def __init__(self, width: int) -> None:
        super().__init__()
        self.layers = nn.Sequential(
            *(nn.GroupNorm(GROUPS, width), nn.SiLU(), nn.Conv2d(width, width, 3, padding=1)),
            *(nn.GroupNorm(GROUPS, width), nn.SiLU(), nn.Conv2d(width, width, 3, padding=1)),
        )

    def forward(self, features: Tensor) -> Tensor:
        return features + self.layers(features)


def upsampled(features: Tensor) -> Tensor:
    """Return features (B, C, H, W) at twice the resolution, bilinear."""
    return nn.functional.interpolate(features, scale_factor=2, mode="bilinear", align_corners=False)


def begin_weights(network: nn.Module, generator: torch.Generator) -> None:
    """Draw the weights of all convolutions (He et al. 2015) from ``generator``, on the CPU; biases
    are 0."""
    for layer in network.modules():
        if isinstance(layer, nn.Conv2d):
            nn.init.kaiming_normal_(layer.weight, nonlinearity="relu", generator=generator)
            if layer.bias is not None:
                nn.init.zeros_(layer.bias)
