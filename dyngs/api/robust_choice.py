"""Whether a static scene is trained without what disagrees between its images: found by two small, short runs.

Both runs are compared on training views that are held out. Those show people who walk through, too, whom no model can
foresee. So only the pixels count that at least one of the two models explains best, the same ones for both.
"""

from __future__ import annotations

import torch
from torch import Tensor

from dyngs.api.candidate import Candidate, Choice, Comparison
from dyngs.api.small_runs import drawn
from dyngs.config import Config, StaticModel
from dyngs.kinds import GaussianTrainer
from dyngs.metrics import psnr
from dyngs.models.views import background_colour

EXPLAINED = 0.8
"""Fraction of the pixels of a view that count: those where the smaller of the two errors is smallest."""
CLEAR_GAIN = 0.1
"""Mean gain, dB, that masks must bring at least."""


def _asked(config: Config) -> bool:
    match config.model:
        case StaticModel():
            return config.train.robust == "auto"
        case _:
            return False


def compared(one: GaussianTrainer, other: GaussianTrainer) -> Comparison:
    """Compare two models on the views held out, over the pixels that one of them explains."""
    background, found = background_colour(one.background), []
    for index in sorted(one.held_out):
        image = one.images[index]
        truth = image.composite(background)
        images = [
            drawn(x.model.scene, image, x.model.options, background, fitted=x.exposures is not None)
            for x in (one, other)
        ]
        counts = explained(images[0], images[1], truth, image.mask)
        found.append((psnr(images[0], truth, counts), psnr(images[1], truth, counts)))
    return Comparison(found)


def explained(one: Tensor, other: Tensor, truth: Tensor, mask: Tensor | None) -> Tensor:
    """Return (H, W) the pixels, of those that ``mask`` keeps, where the smaller error of two images is smallest.

    Neither image is favoured: exchanged, they give the same.

    Args:
        one, other, truth: (H, W, 3).
        mask: (H, W); None: all pixels count.
    """
    error = torch.minimum((one - truth).square().mean(-1), (other - truth).square().mean(-1))
    weight = torch.ones_like(error) if mask is None else mask
    known = error[weight > 0]
    if not known.numel():
        return weight
    rank = max(1, round(EXPLAINED * known.numel()))
    return weight * (error <= known.sort().values[rank - 1])


def _decided(config: Config, choice: Choice) -> Config:
    return config.model_copy(update={"train": config.train.model_copy(update={"robust": choice})})


CANDIDATE = Candidate(
    key="train.robust",
    does="without what disagrees between views",
    asked=_asked,
    decided=_decided,
    compared=compared,
    clear_gain=CLEAR_GAIN,
)
