"""Scores of held-out images whose exposure nobody knows: colours fitted on the left half, measured on the right.

Where training images differ in exposure and white balance, so do test images. The published protocol
(Martin-Brualla et al. 2021) fits what is particular to a test image on its left half, and scores the right half.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from dyngs.data.loader import Image
from dyngs.gaussians.colour.affine import fitted_affine, recoloured
from dyngs.metrics import psnr
from dyngs.models.renderable import Rendering


@dataclass(frozen=True)
class HalfScores:
    """PSNR of the right half of an image, dB; None where a half has no pixel that counts.

    Attributes:
        plain: as the scene shows it.
        fitted: after an affine colour that was fitted on the left half.
    """

    plain: float | None
    fitted: float | None


def right_half_scores(image: Image, rendering: Rendering, background: Tensor) -> HalfScores:
    """Return the scores of the right half of an image.

    Args:
        image: the truth.
        rendering: of its one view.
        background: (3,) behind both.
    """
    truth = image.composite(background)
    left = torch.zeros_like(truth[..., 0])
    left[:, : left.shape[1] // 2] = 1
    weights = [part if image.mask is None else part * image.mask for part in (left, 1 - left)]
    if not all(bool((weight > 0).any()) for weight in weights):
        return HalfScores(None, None)
    affine = fitted_affine([(image, rendering)], background, left)
    fitted = recoloured(affine, image, rendering, background)
    return HalfScores(psnr(rendering.rgb[0], truth, weights[1]), psnr(fitted, truth, weights[1]))
