"""Motion masks that a user gives, as a measure of what may move: in place of the errors of a static model."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import torch

from dyngs.conventions import SH_C0
from dyngs.data.loader import Image
from dyngs.deform.still_error import SHOWS, USUAL, StillErrors
from dyngs.gaussians import Gaussians
from dyngs.gaussians.rendering import RenderOptions, render

SURE_FRACTION = 0.5
"""Fraction of a Gaussian in masks, where it is seen, from which it surely moves."""


def moving_fraction_of(
    gaussians_at: Callable[[float], Gaussians], images: Sequence[Image], options: RenderOptions, sure: float
) -> StillErrors:
    """Return the fraction of each Gaussian that lies in motion masks where it is seen, scaled as ``still_errors``.

    s_vi = sum_p w_vip m_vp / sum_p w_vip with w = alpha T and m the mask of image v. ``most`` is the largest over
    images in which a Gaussian shows; ``usual`` their ``USUAL`` quantile, as in ``still_errors``: what stands behind
    is covered in fewer.
    """
    sums, weights = [], []
    for image in images:
        if image.moves is None:
            continue
        gaussians = gaussians_at(image.time or 0.0).detach()
        counts = torch.ones_like(image.moves) if image.mask is None else image.mask
        flat = torch.zeros(len(gaussians), 1, 3, requires_grad=True, device=gaussians.means.device)
        blended = render(gaussians.replace(sh=flat), image.cameras, options).rgb[0]
        # One pass back through the blending of a constant colour sums both weights, each in a channel of its own.
        (found,) = torch.autograd.grad(blended, flat, torch.stack([image.moves * counts, counts, 0 * counts], dim=-1))
        sums.append(found[:, 0, 0])
        weights.append(found[:, 0, 1])
    weight = torch.stack(weights)
    seen = SH_C0 * SHOWS  # weights come out times the constant harmonic
    shows = weight > seen
    fraction = torch.where(shows, torch.stack(sums) / weight.clamp_min(seen), 0.0)
    ordered = (fraction * (sure / SURE_FRACTION)).sort(dim=0, descending=True).values
    usual = ((1 - USUAL) * shows.sum(0)).long().clamp_max(len(ordered) - 1)
    return StillErrors(ordered[0], ordered.gather(0, usual[None])[0])
