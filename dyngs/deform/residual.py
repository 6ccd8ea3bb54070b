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
    """(N,) mean absolute colour error where each Gaussian shows: over all pixels, weighted by what it adds to them.

    sum_p w_ip |rendered_p - truth_p| / sum_p w_ip with w = alpha T, both sums by one backward pass through the blending
    of a constant colour. Masked pixels do not count; a Gaussian that shows nowhere has 0.

    Args:
        pictures: as many as are to be looked at, one at a time.
        background: (3,) colour.
    """
    errors, weights = torch.zeros(len(gaussians)), torch.zeros(len(gaussians))
    still = gaussians.detach()
    for picture in pictures:
        with torch.no_grad():
            rendered = render(still, picture.cameras, options, background=background).rgb[0]
            error = (rendered - picture.composite(background)).abs().mean(-1)
            counts = torch.ones_like(error) if picture.mask is None else picture.mask
        flat = torch.zeros(len(still), 1, 3, requires_grad=True)
        blended = render(still.replace(sh=flat), picture.cameras, options).rgb[0]
        (grad,) = torch.autograd.grad(
            blended, flat, torch.stack([error * counts, counts, torch.zeros_like(counts)], -1)
        )
        errors += grad[:, 0, 0]
        weights += grad[:, 0, 1]
    return errors / weights.clamp_min(1e-6)


def two_group_threshold(scores: Tensor) -> float:
    """The score that parts ``scores`` (N,) best into two groups (Otsu 1979); infinite where all are equal."""
    from skimage.filters import threshold_otsu

    if not len(scores) or float(scores.min()) == float(scores.max()):
        return float("inf")
    return float(threshold_otsu(scores.numpy()))
