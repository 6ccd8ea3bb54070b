"""Affine colours: what a camera's exposure and white balance make of the colours of a scene.

Local letters: M (3, 4), a matrix next to an offset; colours c are shown as M[:, :3] c + M[:, 3].
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from dyngs.data.loader import Image
from dyngs.models.renderable import Rendering

SATURATED = 254.5 / 255  # A channel this bright may have been any brighter
GAIN_RIDGE, MIXING_RIDGE = 1e-5, 1e-2
"""Weights of squared deviations from the identity, of gains and of all else, against the mean
squared error.

They decide what the pixels do not: the channels of most images are so alike that mixtures of them
can mean anything. With 3e-4 for the latter, halves of the cup in docs/benchmarks.md had 2 dB less
after the fit than before it.
"""
# Fits in turn, each without the saturated channels that the one before shows brighter still
ROUNDS = 3

Shown = tuple[Image, Rendering]  # An image, and the rendering of its one view


def recoloured(affine: Tensor, image: Image, rendering: Rendering, background: Tensor) -> Tensor:
    """Return (H, W, 3) a rendering as the camera of ``image`` would have made it.

    Where the image has alpha, the background was not in front of the camera and keeps its colour.

    Args:
        affine: (3, 4) M.
    """
    rgb = rendering.rgb[0]
    background = background.to(rgb.device)
    affine = affine.to(rgb.device)
    matrix = affine[:, :3]
    offset = affine[:, 3]
    if image.alpha is None:
        return torch.addmm(offset, rgb.reshape(-1, 3), matrix.T).reshape(rgb.shape)
    through = rendering.transmittance[0][..., None]
    behind = through * background
    shown = torch.addmm(
        offset - offset * through.reshape(-1, 1), (rgb - behind).reshape(-1, 3), matrix.T
    )
    return shown.reshape(rgb.shape) + behind


@torch.no_grad()
def fitted_affine(
    shown: Sequence[Shown], background: Tensor, counts: Tensor | None = None
) -> Tensor:
    """Return (3, 4) M, one for all, that brings renderings closest to their images: least squares
    in float64.

    Args:
        shown: one or more; masked pixels do not count.
        counts: (H, W) weights next to the masks; None: 1.
    """
    background = background.to(shown[0][1].rgb.device)
    identity = torch.eye(3, 4, dtype=torch.float64, device=background.device)
    affine = identity
    sums = [_sums(image, rendering, background, counts) for image, rendering in shown]
    is_gain = torch.nn.functional.pad(identity[:, :3], (0, 1))
    total = torch.stack([one.weight for one in sums]).sum()
    ridge = total.clamp_min(1) * torch.diag_embed(
        MIXING_RIDGE + (GAIN_RIDGE - MIXING_RIDGE) * is_gain
    )
    left_out: list[Tensor] = []
    for _ in range(ROUNDS):
        before = left_out
        left_out = [
            one.edge_weight * (one.saturated & (one.edge[:, :4] @ affine.T > 1)) for one in sums
        ]
        if before and all(torch.equal(x, y) for x, y in zip(left_out, before, strict=True)):
            break  # the same equations again
        products = torch.stack([one.products for one in sums]).sum(0).expand(3, 4, 7)
        for one, weights in zip(sums, left_out, strict=True):
            products = products - torch.einsum("pi,pc,pj->cij", one.edge[:, :4], weights, one.edge)
        sides = products[:, :, 4:].diagonal(dim1=0, dim2=2).T
        affine = identity + torch.linalg.solve(products[..., :4] + ridge, sides)
    return affine.float()


class _Sums(NamedTuple):
    """Sums over the pixels of an image, float64, and the B of its pixels that have a saturated
    channel.

    Rows of seven numbers: the four that M is applied to, and what should come out less the first
    three of them.
    """

    weight: Tensor  # () of all pixels
    products: Tensor  # (4, 7) weighted products of the four with all
    edge: Tensor  # (B, 7) rows of the saturated
    edge_weight: Tensor  # (B, 1)
    saturated: Tensor  # (B, 3) bool, which channels are


def _sums(image: Image, rendering: Rendering, background: Tensor, counts: Tensor | None) -> _Sums:
    """Return the sums of the pixels that count."""
    rgb = rendering.rgb[0]
    truth = image.composite(background)
    ones = torch.ones_like(rgb[..., :1])
    through = rendering.transmittance[0][..., None]
    if image.alpha is not None:
        rgb = rgb - through * background
        truth = truth - through * background
        ones = 1 - through
    weight = ones.new_ones(()) if image.mask is None else image.mask
    weight = (weight if counts is None else weight * counts).expand(ones.shape[:2]).reshape(-1, 1)
    rows = torch.cat([rgb, ones, truth], -1).reshape(-1, 7)
    if image.mask is not None or counts is not None:
        counted = torch.nonzero(weight[:, 0] > 0)[:, 0]
        rows = rows[counted]
        weight = weight[counted]
    saturated = rows[:, 4:] >= SATURATED
    rows = rows.double()
    weight = weight.double()
    rows[:, 4:] -= rows[:, :3]
    edge = torch.nonzero(saturated.any(1))[:, 0]
    return _Sums(
        weight.sum(), (weight * rows[:, :4]).T @ rows, rows[edge], weight[edge], saturated[edge]
    )
