"""Where a still model cannot explain the pictures: the first measure of what may move."""

from __future__ import annotations

from collections.abc import Iterable

import torch
from torch import Tensor

from dyngs.data.loader import Picture
from dyngs.gaussians import Gaussians
from dyngs.rendering import RenderOptions, render


def residual_scores(
    gaussians: Gaussians, pictures: Iterable[Picture], options: RenderOptions, background: Tensor
) -> Tensor:
    """(N,) how far the pictures disagree with the colour of each Gaussian, from view to view.

    sum_v |sum_p w_vip (rendered - truth)| / sum_v sum_p w_vip with w = alpha T, a mean over channels. Errors of one
    view are summed with their sign over what a Gaussian covers: detail that is not yet resolved cancels, a thing that
    has come or gone does not. Both sums come from passes back through the blending of a constant colour. Masked pixels
    do not count; a Gaussian that shows nowhere has 0.

    Args:
        pictures: as many as are to be looked at, one at a time.
        background: (3,) colour.
    """
    errors, weights = torch.zeros(len(gaussians)), torch.zeros(len(gaussians))
    still = gaussians.detach()
    for picture in pictures:
        with torch.no_grad():
            rendered = render(still, picture.cameras, options, background=background).rgb[0]
            counts = torch.ones(rendered.shape[:2]) if picture.mask is None else picture.mask
            error = (rendered - picture.composite(background)) * counts[..., None]
        flat = torch.zeros(len(still), 1, 3, requires_grad=True)
        blended = render(still.replace(sh=flat), picture.cameras, options).rgb[0]
        (signed,) = torch.autograd.grad(blended, flat, error, retain_graph=True)
        (weight,) = torch.autograd.grad(blended, flat, counts[..., None].expand_as(error).contiguous())
        errors += signed[:, 0].abs().mean(1)
        weights += weight[:, 0, 0]
    return errors / weights.clamp_min(1e-6)


def two_group_threshold(scores: Tensor) -> float:
    """The score that parts ``scores`` (N,) best into two groups (Otsu 1979); infinite where all are equal."""
    from skimage.filters import threshold_otsu

    if not len(scores) or float(scores.min()) == float(scores.max()):
        return float("inf")
    return float(threshold_otsu(scores.numpy()))
