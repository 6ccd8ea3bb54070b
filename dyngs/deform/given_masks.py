"""Motion masks that a user gives, as a measure of what may move: in place of the errors of a still model."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import torch

from dyngs.conventions import SH_C0
from dyngs.data.loader import Picture
from dyngs.deform.still_error import SHOWS, USUAL, StillErrors
from dyngs.gaussians import Gaussians
from dyngs.rendering import RenderOptions, render

SURE_SHARE = 0.5
"""Share of a Gaussian in masks, where it is seen, from which it surely moves."""


def moving_share_of(
    gaussians_at: Callable[[float], Gaussians], pictures: Sequence[Picture], options: RenderOptions, sure: float
) -> StillErrors:
    """Return the share of each Gaussian that lies in motion masks where it is seen, on the scale of ``still_errors``.

    s_vi = sum_p w_vip m_vp / sum_p w_vip with w = alpha T and m the mask of picture v. ``most`` is the largest over
    pictures in which a Gaussian shows; ``usual`` their ``USUAL`` quantile, as in ``still_errors``: what stands behind
    is covered in fewer.

    Args:
        gaussians_at: N Gaussians at a time.
        pictures: one or more with masks; others do not count.
        options: how to draw.
        sure: error that a share of ``SURE_SHARE`` stands for.
    """
    sums, weights = [], []
    for picture in pictures:
        if picture.moves is None:
            continue
        gaussians = gaussians_at(picture.time or 0.0).detach()
        counts = torch.ones_like(picture.moves) if picture.mask is None else picture.mask
        flat = torch.zeros(len(gaussians), 1, 3, requires_grad=True, device=gaussians.means.device)
        blended = render(gaussians.replace(sh=flat), picture.cameras, options).rgb[0]
        # One pass back through the blending of a constant colour sums both weights, each in a channel of its own.
        (found,) = torch.autograd.grad(blended, flat, torch.stack([picture.moves * counts, counts, 0 * counts], dim=-1))
        sums.append(found[:, 0, 0])
        weights.append(found[:, 0, 1])
    weight = torch.stack(weights)
    seen = SH_C0 * SHOWS  # weights come out times the constant harmonic
    shows = weight > seen
    share = torch.where(shows, torch.stack(sums) / weight.clamp_min(seen), 0.0)
    ordered = (share * (sure / SURE_SHARE)).sort(dim=0, descending=True).values
    usual = ((1 - USUAL) * shows.sum(0)).long().clamp_max(len(ordered) - 1)
    return StillErrors(ordered[0], ordered.gather(0, usual[None])[0])
