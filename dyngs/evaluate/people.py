"""Scores of an image of a person: inside the person's box, and of the whole image on black.

Most of an image of a person is background, which costs nothing to get right: on black, as published figures have it,
the same render scores many dB more than inside the box.
"""

from __future__ import annotations

from torch import Tensor

from dyngs.data.images.silhouettes import silhouette_box
from dyngs.data.loader import Image
from dyngs.metrics import Lpips, psnr, ssim
from dyngs.models.renderable import Rendering


def person_scores(image: Image, rendering: Rendering, background: Tensor, lpips: Lpips) -> dict[str, float | None]:
    """Return the scores by their names in ``dyngs.evaluate.view_scores.ViewScore``; none where nobody is to be seen.

    Args:
        image: the truth.
        rendering: of its one view.
        background: (3,) behind both.
        lpips: from ``load_lpips``.
    """
    box = person_box(image)
    if box is None:
        return {}
    truth, mask, rendered = image.composite(background), image.mask, rendering.rgb[0]
    inside = None if mask is None else mask[box]
    black = rendered - rendering.transmittance[0][..., None] * background
    return {
        "psnr_person": psnr(rendered[box], truth[box], inside),
        "ssim_person": ssim(rendered[box], truth[box], inside),
        "psnr_black": psnr(black, image.rgb_premultiplied, mask),
        "ssim_black": ssim(black, image.rgb_premultiplied, mask),
        "lpips_black": lpips(black, image.rgb_premultiplied, mask).value,
    }


def person_box(image: Image) -> tuple[slice, slice] | None:
    """Return rows and columns of the smallest box around opaque pixels; None without alpha or where there are none."""
    return None if image.alpha is None else silhouette_box(image.alpha)
