"""Disparity of every pixel of a rectified pair, by one of two networks.

``CostVolumeNetwork`` corrects the costs of candidate offsets once: colour differences (plane sweep,
Collins 1996) and whether the other view shows the background (visual hull). Untrained it equals
block matching. ``RecurrentNetwork`` correlates learned features and updates the offsets repeatedly,
as in GPS-Gaussian (Zheng et al. 2024), which follows RAFT-Stereo (Lipson et al. 2021).

Symbols: two views, left and right; crops of H x W pixels, h x w a quarter of it; C channels, D
offsets.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch
from torch import Tensor, nn
from torch.nn.functional import avg_pool2d, instance_norm, interpolate, max_pool2d, pad, unfold

from dyngs.human.predict.gps.rectification import SIDES, RectifiedPair
from dyngs.models.prediction import GROUPS, ResidualBlock, upsample

QUARTER = 4
"""Pixels of the crops per pixel of the plane sweep, per axis."""
NUM_OFFSETS = 48
"""Candidate offsets, evenly spaced in ``RANGE``."""
RANGE = (-0.22, 0.28)
"""Range of offsets, relative to the disparity of the person's middle: 0.56 m behind to 0.44 m in
front of it at a distance of 2 m."""
_COLOUR, _BESIDE = 300.0, 5.0  # factors of colour difference and background in the offset logits
_SHARPNESS = 2.0  # of upsampling weights, which fall with the squared distance
_NEVER = -1e4  # logit of excluded values


class CostVolumeNetwork(nn.Module):
    """UNet that predicts the offsets of two views from plane-sweep costs and image features."""

    def __init__(self, widths: Sequence[int]) -> None:
        super().__init__()
        fine, middle, coarse = widths
        self.enter = residual_layer(2 * NUM_OFFSETS + fine, fine)
        self.down = nn.ModuleList(
            [residual_layer(fine + middle, middle, 2), residual_layer(middle + coarse, coarse, 2)]
        )
        self.deep = ResidualBlock(coarse)
        self.up = nn.ModuleList(
            [residual_layer(coarse + middle, middle), residual_layer(middle + fine, fine)]
        )
        self.change = _convolution(fine, NUM_OFFSETS + 1)
        self.weights = _convolution(fine, 9 * QUARTER**2)

    def forward(self, pair: RectifiedPair, levels: Sequence[Tensor]) -> tuple[list[Tensor], Tensor]:
        """Return offsets (2, 1, H, W), px, bilinearly upsampled and refined, and features (2, C, h
        / 2, w / 2).

        ``levels`` are image features at 1/4, 1/8 and 1/16 of the resolution.
        """
        offsets = candidate_offsets(pair.shift)
        swept = plane_sweep_costs(pair.rgb, pair.alpha, offsets)
        fine = self.enter(torch.cat([levels[0], 5 * swept], dim=1))
        middle = self.down[0](torch.cat([fine, upsample(levels[1])], dim=1))
        coarse = self.deep(self.down[1](torch.cat([middle, upsample(levels[2])], dim=1)))
        middle = self.up[0](torch.cat([middle, upsample(coarse)], dim=1))
        fine = self.up[1](torch.cat([fine, upsample(middle)], dim=1))
        change = self.change(fine)
        colours, beside = swept.split(NUM_OFFSETS, dim=1)
        probabilities = (change[:, 1:] - _COLOUR * colours - _BESIDE * beside).softmax(dim=1)
        expected = (probabilities * probabilities.new_tensor(offsets)[:, None, None]).sum(
            1, keepdim=True
        ) + change[:, :1]
        upsampled_offsets = interpolate(expected, scale_factor=QUARTER, mode="bilinear")
        return [
            upsampled_offsets,
            convex_upsample(expected, self.weights(fine), max_pool2d(pair.solid.float(), QUARTER)),
        ], middle


def residual_layer(before: int, width: int, stride: int = 1) -> nn.Module:
    """Return a convolution from ``before`` to ``width`` channels and a residual block."""
    return nn.Sequential(nn.Conv2d(before, width, 3, stride, padding=1), ResidualBlock(width))


def _convolution(before: int, width: int, size: int = 3) -> nn.Conv2d:
    return nn.Conv2d(before, width, size, padding=size // 2)


def candidate_offsets(shift: Tensor) -> list[int]:
    """Return D candidate offsets, even px, for the disparity ``shift`` of the person's middle."""
    halves = shift / 2 * torch.linspace(*RANGE, NUM_OFFSETS, device=shift.device)
    return (2 * halves.round()).int().tolist()


def plane_sweep_costs(rgb: Tensor, alpha: Tensor, offsets: Sequence[int]) -> Tensor:
    """Return costs (2, 2 D, h, w): per offset the colour difference, and the background of the
    other view.

    Computed at half the resolution of ``rgb`` (2, 3, H, W) and ``alpha`` (2, 1, H, W), and
    averaged over 3 x 3 and 2 x 2 pixels.
    """
    layers = avg_pool2d(torch.cat([rgb * alpha, alpha], dim=1), 2)
    width = layers.shape[3]
    padding = min(max(abs(x) // 2 for x in offsets), width)
    padded = pad(layers.flip(0), (padding, padding))
    colours = []
    beside = []
    for offset in offsets:
        step = max(-padding, min(padding, offset // 2))
        right = padded[0].narrow(2, padding - step, width)
        left = padded[1].narrow(2, padding + step, width)
        other = torch.stack([right, left])
        colours.append((other[:, :3] - layers[:, :3]).abs().mean(1))
        beside.append(1 - other[:, 3])
    volume = torch.stack([*colours, *beside], dim=1)
    return avg_pool2d(avg_pool2d(volume, 3, 1, 1, count_include_pad=False), 2)


def convex_upsample(coarse: Tensor, weights: Tensor, inside: Tensor) -> Tensor:
    """Upsample ``coarse`` (B, 1, h, w) to (B, 1, 4 h, 4 w) by convex combination (Teed and Deng
    2020).

    ``weights`` (B, 9 * 16, h, w) are logits of the 3 x 3 neighbours for each of the 16 pixels,
    added to those of a Gaussian. Neighbours where ``inside`` (B, 1, h, w) is 0 are excluded.
    """
    batch, _, height, width = coarse.shape
    values, known = (
        unfold(pad(x, (1, 1, 1, 1), mode=mode), 3).view(batch, 9, 1, 1, height, width)
        for x, mode in ((coarse, "replicate"), (inside, "constant"))
    )
    logits = weights.view(batch, 9, QUARTER, QUARTER, height, width) + _gaussian_logits(coarse)
    shares = torch.where(known > 0, logits, _NEVER).softmax(dim=1)
    fine = (shares * values).sum(1)
    return fine.permute(0, 3, 1, 4, 2).reshape(batch, 1, QUARTER * height, QUARTER * width)


def _gaussian_logits(like: Tensor) -> Tensor:
    """Return Gaussian logits (9, 4, 4, 1, 1) of 3 x 3 neighbours for each of 4 x 4 pixels."""
    pixels = (torch.arange(QUARTER, device=like.device) + 0.5) / QUARTER - 0.5
    square = (torch.arange(-1, 2, device=like.device)[:, None] - pixels).square()
    distances = square[:, None, :, None] + square[:, None]
    return -_SHARPNESS * distances.view(9, QUARTER, QUARTER, 1, 1)


LEVELS = 4
"""Levels of the correlation pyramid; columns are halved from each to the next."""
RADIUS = 4
"""Radius of the look-up, columns of each level."""
_WEIGHT_SCALE = 0.25  # of upsampling logits, against their large gradients (Teed and Deng 2020)


class RecurrentNetwork(nn.Module):
    """Network that updates the offsets of both views by a convolutional GRU.

    The views share all weights. Each update looks up correlations around the current matches. The
    published network works at 1/8 of images of 1024 px; this one at a quarter of smaller crops.

    Args:
        widths: channels of the image features at 1/4, 1/8 and 1/16 of the resolution.
        width: channels C of matching features and hidden state, a multiple of 24; 96 as published.
        updates: number of updates, 3 as published.
    """

    def __init__(self, widths: Sequence[int], width: int, updates: int) -> None:
        super().__init__()
        part = 2 * width // 3
        wide = 8 * width // 3
        joined = width + 2 * part
        self.updates = updates
        self.enter = residual_layer(sum(widths), width)
        self.split = nn.Sequential(
            nn.GroupNorm(GROUPS, width), nn.SiLU(), _convolution(width, 3 * width)
        )
        self.gate_bias = _convolution(width, 2 * width)
        self.candidate_bias = _convolution(width, width)
        self.correlation = _layers((LEVELS * (2 * RADIUS + 1), part, 1), (part, part))
        self.position = _layers((1, part, 7), (part, part))
        # The last channel of the motion features is the offset itself.
        self.motion = _layers((2 * part, 2 * part - 1))
        self.gates = _convolution(joined, 2 * width)
        self.candidate = _convolution(joined, width)
        self.leave = _layers((width, 2 * wide))
        self.change = _convolution(wide, 1)
        self.weights = _convolution(wide, 9 * QUARTER**2, 1)

    def forward(self, pair: RectifiedPair, levels: Sequence[Tensor]) -> tuple[list[Tensor], Tensor]:
        """Return offsets (2, 1, H, W), px, after each update, and features (2, C, h / 2, w / 2).

        ``levels`` are image features at 1/4, 1/8 and 1/16 of the resolution.
        """
        fine, middle, coarse = levels
        coarse = upsample(upsample(coarse))
        features = self.enter(torch.cat([fine, upsample(middle), coarse], dim=1))
        matching, hidden, context = self.split(features).chunk(3, dim=1)
        hidden = hidden.tanh()
        gate_bias = self.gate_bias(context.relu())
        candidate_bias = self.candidate_bias(context.relu())
        # Correlations of features without a common mean are largest at the match from the start.
        pyramid = correlation_pyramid(instance_norm(matching))
        inside = max_pool2d(pair.solid.float(), QUARTER)
        offsets = torch.zeros_like(inside)  # quarter pixels
        found = []
        for _ in range(self.updates):
            offsets = offsets.detach()
            seen = [self.correlation(look_up(pyramid, offsets)), self.position(offsets)]
            motion = torch.cat([self.motion(torch.cat(seen, dim=1)), offsets], dim=1)
            gates = self.gates(torch.cat([hidden, motion], dim=1)) + gate_bias
            update, reset = gates.sigmoid().chunk(2, dim=1)
            candidate = self.candidate(torch.cat([reset * hidden, motion], dim=1))
            hidden = torch.lerp(hidden, (candidate + candidate_bias).tanh(), update)
            to_change, to_weights = self.leave(hidden).chunk(2, dim=1)
            offsets = offsets + self.change(to_change)
            weights = _WEIGHT_SCALE * self.weights(to_weights)
            found.append(convex_upsample(QUARTER * offsets, weights, inside))
        return found, middle


def _layers(*shapes: tuple[int, ...]) -> nn.Module:
    """Return convolutions of the given input channels, output channels and size, with ReLU."""
    return nn.Sequential(*(nn.Sequential(_convolution(*shape), nn.ReLU()) for shape in shapes))


def correlation_pyramid(features: Tensor) -> list[Tensor]:
    """Return scaled dot products of features (2, C, h, w) of two views along their rows.

    Each of the ``LEVELS`` levels is (2, h, w, columns): the first pairs every pixel of a view with
    all w columns of the other one, the next ones with means of 2, 4 and 8 columns.
    """
    scaled = features / math.sqrt(features.shape[1])
    others = features.flip(0)
    levels = []
    for _ in range(LEVELS):
        levels.append(torch.einsum("vchx,vchy->vhxy", scaled, others))
        # Products with mean features are mean products. An odd last column is kept.
        others = avg_pool2d(others, (1, 2), ceil_mode=True)
    return levels


def look_up(pyramid: Sequence[Tensor], offsets: Tensor) -> Tensor:
    """Return correlations (2, LEVELS (2 RADIUS + 1), h, w) around the matches of ``offsets``.

    Linear between columns, 0 outside; in the order of increasing offset in both views.

    Args:
        pyramid: levels of ``correlation_pyramid``.
        offsets: (2, 1, h, w), columns.
    """
    sides = offsets.new_tensor(SIDES)[:, None, None, None]
    columns = torch.arange(offsets.shape[3], device=offsets.device)[:, None] + 0.5
    matches = columns - sides * offsets.permute(0, 2, 3, 1)
    steps = sides * torch.arange(-RADIUS, RADIUS + 1, device=offsets.device)
    found = []
    for level, products in enumerate(pyramid):
        places = matches / 2**level - 0.5 - steps
        first = places.floor()
        padded = pad(products, (1, 1))
        left, right = (
            padded.gather(3, (first + k).clamp(0, padded.shape[3] - 1).long()) for k in (1, 2)
        )
        found.append(torch.lerp(left, right, places - first))
    return torch.cat(found, dim=3).permute(0, 3, 1, 2)
