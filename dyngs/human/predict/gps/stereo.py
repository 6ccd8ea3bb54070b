"""The depth of every pixel of two rectified views: a sweep over offsets, of which a network finds
the right one.

GPS-Gaussian (Zheng et al. 2024) correlates learned features and refines a match step by step. Here
what speaks for an offset is computed: how much colours would differ (plane sweep, Collins 1996),
and whether the other view shows the person there at all (visual hull). The network corrects that,
and is as good as block matching before it is trained.

Local letters: two views, left and right; H x W pixels of the windows, h x w of a quarter of them; C
channels, D offsets.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor, nn
from torch.nn.functional import avg_pool2d, interpolate, max_pool2d, pad, unfold

from dyngs.models.convolution import ResidualBlock, upsampled

QUARTER = 4
"""Pixels of the windows per pixel of the sweep."""
NUM_OFFSETS = 48
"""Offsets that are looked at, evenly between those of ``RANGE``."""
RANGE = (-0.22, 0.28)
"""Least and largest offset, relative to the disparity of the middle: 0.56 m behind to 0.44 m before
it at 2 m."""
# What the logit of an offset loses by the difference of colours, and beside the person
_COLOUR, _BESIDE = 300.0, 5.0
_SHARPNESS = 2.0
_NEVER = -1e4  # Logits of upsampling: by squared distance, and of what cannot be
SIDES = (1.0, -1.0)
"""A larger offset lies further left in the right view, further right in the left one."""


class Encoder(nn.Module):
    """Features (B, C, ...) of images at 1/2, 1/4 and 1/8 of their resolution."""

    def __init__(self, channels: int, widths: Sequence[int]) -> None:
        super().__init__()
        self.down = nn.ModuleList(
            nn.Sequential(
                nn.Conv2d(before, width, 5 if i == 0 else 3, 2, 2 if i == 0 else 1),
                ResidualBlock(width),
            )
            for i, (before, width) in enumerate(zip((channels, *widths), widths, strict=False))
        )

    def forward(self, images: Tensor) -> list[Tensor]:
        levels = [images]
        for layer in self.down:
            levels.append(layer(levels[-1]))
        return levels[1:]


class StereoNetwork(nn.Module):
    """Offsets of two views, see ``dyngs.human.predict.gps.rectification``, from a sweep and the features of the
    images: a UNet."""

    def __init__(self, widths: Sequence[int]) -> None:
        super().__init__()
        fine, middle, coarse = widths
        self.enter = _block(2 * NUM_OFFSETS + fine, fine)
        self.down = nn.ModuleList(
            [_block(fine + middle, middle, 2), _block(middle + coarse, coarse, 2)]
        )
        self.deep = ResidualBlock(coarse)
        self.up = nn.ModuleList([_block(coarse + middle, middle), _block(middle + fine, fine)])
        self.change = nn.Conv2d(fine, NUM_OFFSETS + 1, 3, padding=1)
        self.weights = nn.Conv2d(fine, 9 * QUARTER**2, 3, padding=1)

    def forward(
        self, levels: Sequence[Tensor], swept: Tensor, offsets: Sequence[int], inside: Tensor
    ) -> tuple[list[Tensor], Tensor]:
        """Return offsets (2, 1, H, W), px, and features (2, C, h / 2, w / 2).

        The offsets are those of a quarter of the resolution, then fine ones. ``levels`` are
        features of the images at 1/4, 1/8 and 1/16, ``swept`` is what ``sweep`` says of ``offsets``
        (D), ``inside`` (2, 1, H, W) is 1 where the person is.
        """
        fine = self.enter(torch.cat([levels[0], 5 * swept], dim=1))
        middle = self.down[0](torch.cat([fine, upsampled(levels[1])], dim=1))
        coarse = self.deep(self.down[1](torch.cat([middle, upsampled(levels[2])], dim=1)))
        middle = self.up[0](torch.cat([middle, upsampled(coarse)], dim=1))
        fine = self.up[1](torch.cat([fine, upsampled(middle)], dim=1))
        change = self.change(fine)
        colours, beside = swept.split(NUM_OFFSETS, dim=1)
        shares = (change[:, 1:] - _COLOUR * colours - _BESIDE * beside).softmax(dim=1)
        found = (shares * shares.new_tensor(offsets)[:, None, None]).sum(1, keepdim=True) + change[
            :, :1
        ]
        enlarged = interpolate(found, scale_factor=QUARTER, mode="bilinear")
        return [enlarged, refined(found, self.weights(fine), max_pool2d(inside, QUARTER))], middle


def _block(before: int, width: int, stride: int = 1) -> nn.Module:
    return nn.Sequential(nn.Conv2d(before, width, 3, stride, padding=1), ResidualBlock(width))


def offsets_of(shift: Tensor) -> list[int]:
    """Return the offsets (D) that are looked at for the disparity ``shift`` of the middle of the
    person, even px."""
    return [
        2 * round(float(x))
        for x in (shift / 2) * torch.linspace(*RANGE, NUM_OFFSETS, device=shift.device)
    ]


def sweep(rgb: Tensor, alpha: Tensor, offsets: Sequence[int]) -> Tensor:
    """Return (2, 2 D, h, w): per offset the difference of colours, and how much of the other view
    there is background.

    Of ``rgb`` (2, 3, H, W) and ``alpha`` (2, 1, H, W) at half the resolution, means over 3 x 3 and
    2 x 2 of its pixels.
    """
    layers = avg_pool2d(torch.cat([rgb * alpha, alpha], dim=1), 2)
    width = layers.shape[3]
    room = min(max(abs(x) // 2 for x in offsets), width)
    around = pad(layers.flip(0), (room, room))
    colours = []
    beside = []
    for offset in offsets:
        starts = (room - int(side) * max(-room, min(room, offset // 2)) for side in SIDES)
        other = torch.stack(
            [view[..., at : at + width] for view, at in zip(around, starts, strict=True)]
        )
        colours.append((other[:, :3] - layers[:, :3]).abs().mean(1))
        beside.append(1 - other[:, 3])
    volume = torch.stack([*colours, *beside], dim=1)
    return avg_pool2d(avg_pool2d(volume, 3, 1, 1, count_include_pad=False), 2)


def refined(coarse: Tensor, weights: Tensor, inside: Tensor) -> Tensor:
    """Return (B, 1, 4 h, 4 w) means of 3x3 values of ``coarse`` (B, 1, h, w), weighted by the
    softmax of ``weights``.

    ``weights`` (B, 9 * 16, h, w) are logits of the nine, for each of the 16 pixels (convex
    upsampling, Teed and Deng 2020), next to those of a Gaussian around the pixel. Values where
    ``inside`` (B, 1, h, w) is 0 do not count.
    """
    batch, _, height, width = coarse.shape
    values, known = (
        unfold(pad(x, (1, 1, 1, 1), mode=mode), 3).view(batch, 9, 1, 1, height, width)
        for x, mode in ((coarse, "replicate"), (inside, "constant"))
    )
    logits = weights.view(batch, 9, QUARTER, QUARTER, height, width) + _near_first(coarse)
    shares = torch.where(known > 0, logits, _NEVER).softmax(dim=1)
    fine = (shares * values).sum(1)
    return fine.permute(0, 3, 1, 4, 2).reshape(batch, 1, QUARTER * height, QUARTER * width)


def _near_first(like: Tensor) -> Tensor:
    """Return logits (9, 4, 4, 1, 1) of 3x3 values for each of 4x4 pixels in the middle: of their
    squared distance."""
    pixel = (torch.arange(QUARTER, dtype=like.dtype, device=like.device) + 0.5) / QUARTER - 0.5
    square = (
        torch.arange(-1.0, 2.0, dtype=like.dtype, device=like.device)[:, None] - pixel
    ).square()
    return -_SHARPNESS * (square[:, None, :, None] + square[None, :, None, :]).reshape(
        9, QUARTER, QUARTER, 1, 1
    )
