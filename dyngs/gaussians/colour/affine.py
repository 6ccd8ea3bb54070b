"""Affine colours: what a camera's exposure and white balance make of the colours of a scene.

Local letters: M (3, 4), a matrix next to an offset; colours c are shown as M[:, :3] c + M[:, 3].
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from dyngs.data.loader import Image
from dyngs.models.renderable import Rendering

SATURATED = 254.5 / 255  # A channel this bright may have been any brighter
GAIN_RIDGE, MIXING_RIDGE = 1e-5, 1e-2
"""Weights of squared deviations from the identity, of gains and of all else, against the mean squared error.

They decide what the pixels do not: the channels of most images are so alike that mixtures of them can mean anything.
With 3e-4 for the latter, halves of the cup in docs/benchmarks.md had 2 dB less after the fit than before it.
"""
ROUNDS = 3  # Fits in turn, each without the saturated channels that the one before shows brighter still

Shown = tuple[Image, Rendering]  # An image, and the rendering of its one view


def recoloured(affine: Tensor, image: Image, rendering: Rendering, background: Tensor) -> Tensor:
    """Return (H, W, 3) a rendering as the camera of ``image`` would have made it.

    Where the image has alpha, the background was not in front of the camera and keeps its colour.

    Args:
        affine: (3, 4) M.
    """
    rgb = rendering.rgb[0]
    background, affine = background.to(rgb.device), affine.to(rgb.device)
    matrix, offset = affine[:, :3], affine[:, 3]
    if image.alpha is None:
        return torch.addmm(offset, rgb.reshape(-1, 3), matrix.T).reshape(rgb.shape)
    through = rendering.transmittance[0][..., None]
    behind = through * background
    shown = torch.addmm(offset - offset * through.reshape(-1, 1), (rgb - behind).reshape(-1, 3), matrix.T)
    return shown.reshape(rgb.shape) + behind


@torch.no_grad()
def fitted_affine(shown: Sequence[Shown], background: Tensor, counts: Tensor | None = None) -> Tensor:
    """Return (3, 4) M, one for all, that brings renderings closest to their images: least squares in float64.

    Args:
        shown: one or more; masked pixels do not count.
        counts: (H, W) weights next to the masks; None: 1.
    """
    background = background.to(shown[0][1].rgb.device)
    identity = torch.eye(3, 4, dtype=torch.float64, device=background.device)
    affine, equations = identity, [_equations(image, rendering, background, counts) for image, rendering in shown]
    used: list[Tensor] = []
    for _ in range(ROUNDS):
        before, used = used, [weight * ~((target >= SATURATED) & (x @ affine.T > 1)) for x, target, weight in equations]
        if before and all(torch.equal(x, y) for x, y in zip(used, before, strict=True)):
            break  # the same equations again
        products, sides = torch.zeros_like(identity.new_empty(3, 4, 4)), torch.zeros_like(identity)
        total = identity.new_zeros(())
        for (seen, target, weight), known in zip(equations, used, strict=True):
            for channel in range(3):
                weighted = seen * known[:, channel, None]
                products[channel] += weighted.T @ seen
                sides[channel] += weighted.T @ (target - seen @ identity.T)[:, channel]
            total = total + weight.sum()
        is_gain = torch.nn.functional.pad(identity[:, :3], (0, 1))
        ridge = total.clamp_min(1) * torch.diag_embed(MIXING_RIDGE + (GAIN_RIDGE - MIXING_RIDGE) * is_gain)
        affine = identity + torch.linalg.solve(products + ridge, sides)
    return affine.float()


def _equations(
    image: Image, rendering: Rendering, background: Tensor, counts: Tensor | None
) -> tuple[Tensor, Tensor, Tensor]:
    """Return (P, 4) what M is applied to, (P, 3) what should come out, and (P, 1) weights, all float64."""
    rgb, truth = rendering.rgb[0], image.composite(background)
    ones, through = torch.ones_like(rgb[..., :1]), rendering.transmittance[0][..., None]
    if image.alpha is not None:
        rgb, truth, ones = rgb - through * background, truth - through * background, 1 - through
    weight = torch.ones_like(through) if image.mask is None else image.mask[..., None]
    weight = weight if counts is None else weight * counts[..., None]
    seen = torch.cat([rgb, ones], -1)
    counted = weight.reshape(-1) > 0
    return tuple(x.reshape(-1, x.shape[-1])[counted].double() for x in (seen, truth, weight))  # type: ignore[return-value]
