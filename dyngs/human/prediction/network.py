"""The network over the atlas: a UNet on maps of observations in a few images (GHG, Kwon et al. 2024).

Local letters: D input channels, K scaffolds, S texels per side.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor, nn

from dyngs.errors import DyngsError

HEADS = {"rotation": 4, "scale": 3, "opacity": 1, "height": 1, "colour": 3, "image_weight": 1, "guess": 3}
"""Outputs per texel of a scaffold and their number of channels; see ``dyngs.human.prediction.predict``."""

_GROUPS = 8


class AtlasNetwork(nn.Module):
    """UNet from maps (D, S, S) to raw predictions (K, 16, S, S) in the order of ``HEADS``, which are 0 before training.

    Each width halves the resolution; the way up concatenates the features of the way down, and at full resolution the
    input itself.
    """

    def __init__(self, channels: int, scaffolds: int, widths: Sequence[int], generator: torch.Generator) -> None:
        """
        Args:
            channels: D, of the input.
            scaffolds: K.
            widths: channels at 1/2, 1/4, ... of the resolution; multiples of 8.
            generator: of the initial weights, on the CPU, where the network is made.

        Raises:
            DyngsError: a width that is not a multiple of 8.
        """
        super().__init__()
        if any(width % _GROUPS for width in widths):
            raise DyngsError(f"model.widths must be multiples of {_GROUPS}, not {list(widths)}")
        self.scaffolds, self.halvings = scaffolds, len(widths)
        with torch.device("cpu"):
            self._make_layers(channels, scaffolds, widths)
        for layer in self.modules():
            if isinstance(layer, nn.Conv2d):
                nn.init.kaiming_normal_(layer.weight, nonlinearity="relu", generator=generator)
                nn.init.zeros_(layer.bias)  # pyright: ignore[reportArgumentType]
        nn.init.zeros_(self.heads.weight)

    def _make_layers(self, channels: int, scaffolds: int, widths: Sequence[int]) -> None:
        """Make the layers of the way down and up, and of the heads."""
        self.down = nn.ModuleList(
            nn.Sequential(nn.Conv2d(before, width, 5 if i == 0 else 3, 2, padding=2 if i == 0 else 1), _Block(width))
            for i, (before, width) in enumerate(zip((channels, *widths), widths, strict=False))
        )
        self.up = nn.ModuleList(
            nn.Sequential(nn.Conv2d(below + width, width, 3, padding=1), _Block(width))
            for below, width in zip(widths[:0:-1], widths[-2::-1], strict=True)
        )
        self.last = nn.Sequential(nn.Conv2d(widths[0] + channels, widths[0], 3, padding=1), nn.SiLU())
        self.heads = nn.Conv2d(widths[0], scaffolds * sum(HEADS.values()), 1)

    def forward(self, maps: Tensor) -> Tensor:
        """Return the raw predictions (K, 16, S, S); S must be a multiple of 2 to the number of widths."""
        levels = [maps[None]]
        for layer in self.down:
            levels.append(layer(levels[-1]))
        features = levels.pop()
        for layer in self.up:
            features = layer(torch.cat([_upsampled(features), levels.pop()], dim=1))
        features = self.last(torch.cat([_upsampled(features), maps[None]], dim=1))
        return self.heads(features)[0].unflatten(0, (self.scaffolds, -1))


class _Block(nn.Module):
    """Residual block of two convolutions."""

    def __init__(self, width: int) -> None:
        super().__init__()
        self.layers = nn.Sequential(
            *(nn.GroupNorm(_GROUPS, width), nn.SiLU(), nn.Conv2d(width, width, 3, padding=1)),
            *(nn.GroupNorm(_GROUPS, width), nn.SiLU(), nn.Conv2d(width, width, 3, padding=1)),
        )

    def forward(self, features: Tensor) -> Tensor:
        return features + self.layers(features)


def _upsampled(features: Tensor) -> Tensor:
    """Return the features at twice the resolution, bilinear."""
    return nn.functional.interpolate(features, scale_factor=2, mode="bilinear", align_corners=False)
