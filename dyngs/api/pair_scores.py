"""How much better one of two models shows a training view that neither was trained on."""

from __future__ import annotations

from collections.abc import Callable
from statistics import fmean

import torch
from torch import Tensor

from dyngs.core.metrics import psnr
from dyngs.data.loader import Image
from dyngs.gaussians.colour.affine import fitted_affine, recoloured
from dyngs.models.renderable import Rendering
from dyngs.models.views import background_colour
from dyngs.training.corrections.camera_refinement import fitted_to_image
from dyngs.training.new_trainer import GaussianTrainer

EXPLAINED = 0.8
"""Fraction of the pixels of a view that count: those where the smaller of two models' errors is
smallest."""
SQUARES = 8  # The halves of an image are the two colours of a chess board of so many squares a side

PairScore = Callable[[GaussianTrainer, GaussianTrainer, int], tuple[float, float]]
"""PSNR, dB, of the training view at an index by two models."""


def plain(one: GaussianTrainer, other: GaussianTrainer, index: int) -> tuple[float, float]:
    """Return the PSNR of the view; where either has exposures, after an affine colour fitted to
    it."""
    truth, mask, first, second = _both(one, other, index)
    return psnr(first, truth, mask), psnr(second, truth, mask)


def explained(one: GaussianTrainer, other: GaussianTrainer, index: int) -> tuple[float, float]:
    """Return the PSNR over the pixels that at least one of the two explains best, the same ones for
    both.

    Views held out show people who walk through, too, whom no model can foresee.
    """
    truth, mask, first, second = _both(one, other, index)
    counts = explained_pixels(first, second, truth, mask)
    return psnr(first, truth, counts), psnr(second, truth, counts)


def explained_pixels(one: Tensor, other: Tensor, truth: Tensor, mask: Tensor | None) -> Tensor:
    """Return (H, W) the pixels, of those that ``mask`` keeps, where the smaller error of two images
    is smallest.

    Neither image is favoured: exchanged, they give the same.
    """
    error = torch.minimum((one - truth).square().mean(-1), (other - truth).square().mean(-1))
    weight = torch.ones_like(error) if mask is None else mask
    known = error[weight > 0]
    if not known.numel():
        return weight
    rank = max(1, round(EXPLAINED * known.numel()))
    return weight * (error <= known.sort().values[rank - 1])


def after_pose_fit(one: GaussianTrainer, other: GaussianTrainer, index: int) -> tuple[float, float]:
    """Return the PSNR of the right half of the view from the pose in which its left half fits each
    model best.

    Views held out have no refined cameras.
    """
    return _score_after_pose_fit(one, index), _score_after_pose_fit(other, index)


def _score_after_pose_fit(trainer: GaussianTrainer, index: int) -> float:
    image = trainer.images[index]
    background = background_colour(trainer.background)
    left = torch.zeros_like(image.rgb_premultiplied[..., 0])
    left[:, : left.shape[1] // 2] = 1
    right = 1 - left if image.mask is None else (1 - left) * image.mask
    options = trainer.model.options
    fitted = fitted_to_image(
        trainer.model.scene, image, background, trainer.extent, options=options, weights=left
    )
    return psnr(_rendered(trainer, fitted).rgb[0], image.composite(background), right)


def after_colour_fit(
    one: GaussianTrainer, other: GaussianTrainer, index: int
) -> tuple[float, float]:
    """Return the mean PSNR of the view as it is, and with each half recoloured by a fit on the
    other half.

    Views held out have no exposures of their own. Where exposure goes with the viewpoint, as in a
    slow walk, colours that depend on the viewpoint explain it: then the scene in one exposure is
    farther from images as they are.
    """
    return _score_after_colour_fit(one, index), _score_after_colour_fit(other, index)


def _score_after_colour_fit(trainer: GaussianTrainer, index: int) -> float:
    image = trainer.images[index]
    background = background_colour(trainer.background)
    rendering = _rendered(trainer, image)
    truth = image.composite(background)
    rgb = rendering.rgb[0]
    fitted = rgb.clone()
    light = _chess_board(*rgb.shape[:2])
    for half in (light, ~light):
        affine = fitted_affine([(image, rendering)], background, half.float())
        fitted[~half] = recoloured(affine, image, rendering, background)[~half]
    return fmean((psnr(rgb, truth, image.mask), psnr(fitted, truth, image.mask)))


def _chess_board(height: int, width: int) -> Tensor:
    rows, columns = (torch.arange(size, device="cpu") * SQUARES // size for size in (height, width))
    return (rows[:, None] + columns) % 2 == 0


@torch.no_grad()
def _rendered(trainer: GaussianTrainer, image: Image) -> Rendering:
    background = background_colour(trainer.background)
    return trainer.model.scene.render(
        image.cameras, image.time, options=trainer.model.options, background=background
    )


def _both(
    one: GaussianTrainer, other: GaussianTrainer, index: int
) -> tuple[Tensor, Tensor | None, Tensor, Tensor]:
    """Return the view (H, W, 3), its mask, and the view as both scenes show it.

    Where either has exposures, after an affine colour that is fitted to the view.
    """
    image = one.images[index]
    background = background_colour(one.background)
    renderings = [_rendered(x, image) for x in (one, other)]
    shown = [x.rgb[0] for x in renderings]
    if one.exposures is not None or other.exposures is not None:
        affines = [fitted_affine([(image, x)], background) for x in renderings]
        shown = [
            recoloured(affine, image, x, background)
            for affine, x in zip(affines, renderings, strict=True)
        ]
    return image.composite(background), image.mask, shown[0], shown[1]
