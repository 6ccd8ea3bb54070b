"""A Gaussian for every pixel of the person in two rectified views (GPS-Gaussian, Zheng et al.
2024).

Local letters: two views; windows of H x W pixels, N pixels of the person.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor, nn
from torch.nn.functional import pixel_shuffle, pixel_unshuffle

from dyngs.core.conventions import SH_C0
from dyngs.gaussians import Gaussians
from dyngs.human.predict.gps.keys import GpsModel
from dyngs.human.predict.gps.rectification import RectifiedPair
from dyngs.human.predict.gps.stereo import Encoder, StereoNetwork, offsets_of, sweep
from dyngs.models.convolution import ResidualBlock, begin_weights, upsampled
from dyngs.ops.quaternions import quat_product, quats_of, unit_quats

HEADS = {"rotation": 4, "scale": 3, "opacity": 1}
"""Outputs per pixel and their number of channels."""
LARGEST = 4.0
"""Largest standard deviation, in pixels of the window at the depth of the pixel: 2 cm for a person
of 256 px images."""
_SCALE_LOGIT = -1.95
_OPACITY_LOGIT = 4.0  # Of an untrained network: half a pixel, nearly opaque
_DEPTH_WIDTHS = (16, 24, 32)  # Channels of the features of depth
_LAST = 32  # Channels of the features that Gaussians are made from
_RANGE = 64.0  # px; offsets are divided by it before they enter a network
_LEAST = 0.2  # Smallest disparity, relative to that of the middle of the person


@dataclass(frozen=True)
class Surface:
    """What the network says of two views."""

    offsets: list[Tensor]  # (2, 1, H, W), of which the last are the finest, px
    raw: Tensor | None  # (2, 8, H, W) in the order of ``HEADS``; None: only depth was asked for


class GpsNetwork(nn.Module):
    """Depth and Gaussians of two rectified views; features of the images are shared by both tasks.

    It works at half the resolution of the windows, of which it is given four pixels as one, and
    returns four as one.
    """

    def __init__(self, model: GpsModel, generator: torch.Generator) -> None:
        """Weights are drawn from ``generator`` on the CPU."""
        super().__init__()
        half, quarter, _ = model.widths
        with torch.device("cpu"):
            self.encoder = Encoder(16, model.widths)
            self.stereo = StereoNetwork(model.widths)
            self.depth_encoder = Encoder(8, _DEPTH_WIDTHS)
            below = quarter + _DEPTH_WIDTHS[1] + _DEPTH_WIDTHS[2]
            self.up = nn.ModuleList(
                nn.Sequential(nn.Conv2d(before, half, 3, padding=1), ResidualBlock(half))
                for before in (below, 2 * half + _DEPTH_WIDTHS[0])
            )
            self.last = nn.Sequential(nn.Conv2d(half + 20, _LAST, 3, padding=1), nn.SiLU())
            self.heads = nn.Conv2d(_LAST, 4 * sum(HEADS.values()), 1)
        begin_weights(self, generator)
        for layer in (self.heads, self.stereo.change, self.stereo.weights):
            nn.init.zeros_(layer.weight)

    def forward(self, pair: RectifiedPair, *, with_gaussians: bool = True) -> Surface:
        """Return the offsets of ``pair``, and what makes Gaussians of its pixels."""
        inside = pair.solid.float()
        images = pixel_unshuffle(torch.cat([(2 * pair.rgb - 1) * inside, pair.alpha], dim=1), 2)
        levels = self.encoder(images)
        around = offsets_of(pair.shift)
        offsets, fused = self.stereo(levels, sweep(pair.rgb, pair.alpha, around), around, inside)
        if not with_gaussians:
            return Surface(offsets, None)
        depth = pixel_unshuffle(torch.cat([offsets[-1] / _RANGE * inside, inside], dim=1), 2)
        halves, quarters, eighths = self.depth_encoder(depth)
        features = self.up[0](torch.cat([fused, quarters, upsampled(eighths)], dim=1))
        features = self.up[1](torch.cat([upsampled(features), levels[0], halves], dim=1))
        features = self.last(torch.cat([upsampled(features), images, depth[:, :4]], dim=1))
        return Surface(offsets, pixel_shuffle(self.heads(features), 2))


def gaussians_of(pair: RectifiedPair, surface: Surface) -> Gaussians:
    """Return the Gaussians of the pixels of the person in both views, differentiable in
    ``surface``.

    Means lie on the rays through the pixels, rotations are relative to the axes of the windows,
    colours are those of the images. Outlines are as transparent as in the images; what the other
    view would show beside the person, wholly (visual hull).
    """
    assert surface.raw is not None
    least = (_LEAST - 1) * pair.shift
    offsets = torch.maximum(surface.offsets[-1], least)
    depth = pair.depth(offsets)
    solid = pair.solid[:, 0]
    parts = surface.raw.permute(0, 2, 3, 1)[solid].split(tuple(HEADS.values()), dim=1)
    part = dict(zip(HEADS, parts, strict=True))
    pixel = (depth[:, 0][solid] / pair.focal)[:, None]
    scales = LARGEST * pixel * (part["scale"] + _SCALE_LOGIT).sigmoid()
    within = (pair.alpha * pair.seen_by_other(offsets))[solid[:, None]]
    opacities = (part["opacity"][:, 0] + _OPACITY_LOGIT).sigmoid() * within
    opacities = opacities.clamp(1e-4, 1 - 1e-4)
    one = part["rotation"].new_tensor([1.0, 0.0, 0.0, 0.0])
    world_from_rect = quats_of(pair.rect_from_world.T[None])
    rgb = pair.rgb.permute(0, 2, 3, 1)[solid]
    return Gaussians(
        means=pair.points(depth)[solid],
        quats=quat_product(world_from_rect.expand(len(rgb), 4), unit_quats(one + part["rotation"])),
        log_scales=scales.clamp_min(1e-12).log(),
        logit_opacities=(opacities / (1 - opacities)).log(),
        sh=((rgb - 0.5) / SH_C0)[:, None],
    )


def offset_loss(pair: RectifiedPair, offsets: Sequence[Tensor], decay: float) -> Tensor:
    """Return the weighted sum of the mean errors of ``offsets``, px, where the truth is known.

    The last ones count 1, each before ``decay`` times the next (Teed and Deng 2020).
    """
    assert pair.offsets is not None
    known = pair.solid & pair.offsets.isfinite()
    truth = pair.offsets[known]
    total = torch.zeros((), device=pair.rgb.device)
    for i, found in enumerate(reversed(offsets)):
        total = total + decay**i * (found[known] - truth).abs().mean()
    return total
