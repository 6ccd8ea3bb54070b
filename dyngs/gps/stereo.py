"""The depth of every pixel of two rectified views: correlation along rows, refined step by step (RAFT-Stereo, Lipson et
al. 2021, in the form of GPS-Gaussian, Zheng et al. 2024).

Local letters: two views, left and right; H x W pixels of the windows, h x w of a quarter of them, C channels.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor, nn
from torch.nn.functional import avg_pool1d, max_pool2d, normalize, silu, unfold

from dyngs.models.convolution import ResidualBlock, upsampled

QUARTER = 4
"""Pixels of the windows per pixel of the correlation."""
_LEVELS, _RADIUS = (
    3,
    4,
)  # Of the correlation: resolutions, each half as fine, and entries on either side in each
_HIDDEN = 32  # Channels of the state that is refined
_NEVER = -1e4  # Logit of what cannot be
_SIDES = (1.0, -1.0)  # A larger offset lies further left in the right view, further right in the left one


class Encoder(nn.Module):
    """Features (B, C, ...) of images at 1/2, 1/4 and 1/8 of the resolution."""

    def __init__(self, channels: int, widths: Sequence[int]) -> None:
        super().__init__()
        self.down = nn.ModuleList(
            nn.Sequential(nn.Conv2d(before, width, 5 if i == 0 else 3, 2, 2 if i == 0 else 1), ResidualBlock(width))
            for i, (before, width) in enumerate(zip((channels, *widths), widths, strict=False))
        )

    def forward(self, images: Tensor) -> list[Tensor]:
        levels = [images]
        for layer in self.down:
            levels.append(layer(levels[-1]))
        return levels[1:]


class StereoNetwork(nn.Module):
    """Offsets of two views, see ``dyngs.gps.rectification``, from their features."""

    def __init__(self, widths: Sequence[int]) -> None:
        super().__init__()
        middle = widths[1]
        self.fuse = nn.Sequential(nn.Conv2d(middle + widths[2], middle, 3, padding=1), ResidualBlock(middle))
        self.match = nn.Conv2d(middle, middle, 3, padding=1)
        self.context = nn.Conv2d(middle, 2 * _HIDDEN, 3, padding=1)
        self.motion = nn.Sequential(
            *(nn.Conv2d(_LEVELS * (2 * _RADIUS + 1) + 1, _HIDDEN, 1), nn.SiLU()),
            *(nn.Conv2d(_HIDDEN, _HIDDEN - 1, 3, padding=1), nn.SiLU()),
        )
        self.gates = nn.Conv2d(3 * _HIDDEN, 2 * _HIDDEN, 3, padding=1)
        self.candidate = nn.Conv2d(3 * _HIDDEN, _HIDDEN, 3, padding=1)
        self.change = nn.Sequential(
            nn.Conv2d(_HIDDEN, _HIDDEN, 3, padding=1), nn.SiLU(), nn.Conv2d(_HIDDEN, 1, 3, padding=1)
        )
        self.weights = nn.Sequential(
            nn.Conv2d(_HIDDEN, _HIDDEN, 3, padding=1), nn.SiLU(), nn.Conv2d(_HIDDEN, 9 * QUARTER**2, 1)
        )

    def forward(self, levels: Sequence[Tensor], inside: Tensor, iterations: int) -> tuple[list[Tensor], Tensor]:
        """Return offsets (2, 1, H, W), px, and the fused features (2, C, h, w).

        The offsets are those by correlation alone, then those after each iteration. ``inside`` (2, 1, H, W) is 1 where
        the person is.
        """
        fused = self.fuse(torch.cat([levels[1], upsampled(levels[2])], dim=1))
        pyramid = correlation_pyramid(self.match(fused))
        offsets = best_matches(pyramid[0], max_pool2d(inside, QUARTER))
        found = [upsampled(upsampled(QUARTER * offsets))]
        hidden, given = self.context(fused).split(_HIDDEN, dim=1)
        hidden, given = hidden.tanh(), silu(given)
        for _ in range(iterations):
            offsets = offsets.detach()  # each iteration learns from its own error (Teed and Deng 2020)
            motion = self.motion(torch.cat([looked_up(pyramid, offsets), offsets], dim=1))
            hidden = self._stepped(hidden, torch.cat([given, motion, offsets], dim=1))
            offsets = offsets + self.change(hidden)
            found.append(refined(QUARTER * offsets, 0.25 * self.weights(hidden)))
        return found, fused

    def _stepped(self, hidden: Tensor, news: Tensor) -> Tensor:
        """Return the state after a gated recurrent unit (Cho et al. 2014)."""
        update, reset = self.gates(torch.cat([hidden, news], dim=1)).sigmoid().split(_HIDDEN, dim=1)
        candidate = self.candidate(torch.cat([reset * hidden, news], dim=1)).tanh()
        return (1 - update) * hidden + update * candidate


def correlation_pyramid(features: Tensor) -> list[Tensor]:
    """Return the scalar products of ``features`` (2, C, h, w) along rows: (2, h, w, w') each.

    Entry (v, y, x, x') is the root of C times the cosine between the features of pixel x of view v and pixel x' of the
    other one; x' is pooled by two from one to the next.
    """
    features = normalize(features, dim=1) * features.shape[1] ** 0.25
    volume = torch.einsum("chx,chy->hxy", features[0], features[1])
    levels = [torch.stack([volume, volume.transpose(1, 2)])]
    for _ in range(_LEVELS - 1):
        pooled = avg_pool1d(levels[-1].flatten(0, 1), 2, ceil_mode=True, count_include_pad=False)
        levels.append(pooled.unflatten(0, levels[-1].shape[:2]))
    return levels


def best_matches(volume: Tensor, inside: Tensor) -> Tensor:
    """Return the offsets (2, 1, h, w) to the mean place in the other view, weighted by the softmax of ``volume``.

    Places outside of the person, where ``inside`` (2, 1, h, w) is 0, do not count (Xu et al. 2022, GMFlow).
    """
    outside = inside.flip(0)[:, 0, :, None] == 0
    shares = volume.masked_fill(outside, _NEVER).softmax(dim=3)
    column = torch.arange(volume.shape[3], dtype=volume.dtype, device=volume.device)
    place = (shares * column).sum(3)
    return (volume.new_tensor(_SIDES)[:, None, None] * (column - place))[:, None]


def looked_up(pyramid: Sequence[Tensor], offsets: Tensor) -> Tensor:
    """Return the correlations (2, K, h, w) around ``offsets`` (2, 1, h, w), linear between pixels, 0 outside.

    The entries of each level go from smaller offsets to larger ones, in both views.
    """
    sides = offsets.new_tensor(_SIDES)[:, None, None, None]
    column = torch.arange(offsets.shape[3], dtype=offsets.dtype, device=offsets.device)[:, None]
    around = torch.arange(-_RADIUS, _RADIUS + 1, dtype=offsets.dtype, device=offsets.device)
    found = []
    for level, volume in enumerate(pyramid):
        size = 2.0**level
        place = column - sides * (offsets[:, 0, :, :, None] + size * around)
        place = (place + 0.5) / size - 0.5
        first, last = place.floor(), volume.shape[3] - 1
        part = place - first
        entries = (
            torch.gather(volume, 3, at.clamp(0, last).long()) * ((at >= 0) & (at <= last)) for at in (first, first + 1)
        )
        low, high = entries
        found.append((1 - part) * low + part * high)
    return torch.cat(found, dim=3).permute(0, 3, 1, 2)


def refined(coarse: Tensor, weights: Tensor) -> Tensor:
    """Return (B, 1, 4 h, 4 w) means of 3x3 values of ``coarse`` (B, 1, h, w), weighted by the softmax of ``weights``.

    ``weights`` (B, 9 * 16, h, w) are logits of the nine, for each of the 16 pixels (convex upsampling, Teed and Deng
    2020).
    """
    batch, _, height, width = coarse.shape
    padded = nn.functional.pad(coarse, (1, 1, 1, 1), mode="replicate")
    nine = unfold(padded, 3).view(batch, 9, 1, 1, height, width)
    shares = weights.view(batch, 9, QUARTER, QUARTER, height, width).softmax(dim=1)
    fine = (shares * nine).sum(1)
    return fine.permute(0, 3, 1, 4, 2).reshape(batch, 1, QUARTER * height, QUARTER * width)
