"""Whether exposure and white balance are learned for each image: found by one or two small, short runs.

A small run without them says whether images disagree: an affine colour that is fitted on half of each image makes
the other half clearly better. Only then is a second run worth its time. Its exposures of training views say nothing of
the views held out. So both models get an affine colour for each of those, fitted on one half, and are compared on the
other half.
"""

from __future__ import annotations

from statistics import fmean

import torch
from torch import Tensor

from dyngs.api.candidate import Candidate, Choice, Comparison, Evidence
from dyngs.config import Config, DynamicModel, StaticModel
from dyngs.data.frame_selection import evenly_spaced
from dyngs.gaussians.colour.affine import fitted_affine, recoloured
from dyngs.kinds import GaussianTrainer
from dyngs.metrics import psnr
from dyngs.models.views import background_colour

CLEAR_GAIN = 0.1
"""Mean gain, dB, from which exposures are tried, and then taken."""
MAX_LOSS = 0.05
"""Most that views may lose as they are, without a fit, dB."""
LOOKED_AT = 40
"""Training views that are looked at."""
SQUARES = 8
"""The halves of an image are the two colours of a chess board of so many squares a side."""


def evidence(plain: GaussianTrainer) -> Evidence:
    """Return whether the images of a small run without exposures ask for them."""
    trained_on = [i for i in range(len(plain.images)) if i not in plain.held_out]
    chosen = [trained_on[i] for i in evenly_spaced(len(trained_on), LOOKED_AT)]
    found = [_scored(plain, index) for index in chosen]
    gains = [fitted - given for given, fitted in found]
    text = (
        f"an affine colour fitted on half of each of {len(found)} training images changes the other half by "
        f"{fmean(gains):+.2f} dB"
    )
    return Evidence(fmean(gains) >= CLEAR_GAIN, text)


def compared(one: GaussianTrainer, other: GaussianTrainer) -> Comparison:
    """Compare two models on the views held out, each after the same fit.

    Where exposure goes with the viewpoint, as in a slow walk, colours that depend on the viewpoint explain it. Then a
    scene in one exposure is further away from images as they are, and is not taken unasked.
    """
    held_out = sorted(one.held_out)
    before, after = ([_scored(trainer, index) for index in held_out] for trainer in (one, other))
    lost = fmean(x[0] for x in before) - fmean(x[0] for x in after)
    objection = f"but {lost:.2f} dB less without a fit: exposure goes with the viewpoint" if lost > MAX_LOSS else ""
    return Comparison([(a[1], b[1]) for a, b in zip(before, after, strict=True)], objection)


@torch.no_grad()
def _scored(trainer: GaussianTrainer, index: int) -> tuple[float, float]:
    """Return PSNR, dB, of an image as the scene shows it, and with each half by a fit on the other half."""
    image, background = trainer.images[index], background_colour(trainer.background)
    rendering = trainer.model.scene.render(
        image.cameras, image.time, options=trainer.model.options, background=background
    )
    truth, rgb = image.composite(background), rendering.rgb[0]
    fitted, light = rgb.clone(), _chess_board(*rgb.shape[:2])
    for half in (light, ~light):
        affine = fitted_affine([(image, rendering)], background, half.float())
        fitted[~half] = recoloured(affine, image, rendering, background)[~half]
    return psnr(rgb, truth, image.mask), psnr(fitted, truth, image.mask)


def _chess_board(height: int, width: int) -> Tensor:
    """Return (H, W) bool, one of the two colours of a chess board."""
    rows, columns = (torch.arange(size, device="cpu") * SQUARES // size for size in (height, width))
    return (rows[:, None] + columns) % 2 == 0


def _asked(config: Config) -> bool:
    match config.model:
        case StaticModel() | DynamicModel():
            return config.train.exposure == "auto"
        case _:
            return False


def _decided(config: Config, choice: Choice) -> Config:
    return config.model_copy(update={"train": config.train.model_copy(update={"exposure": choice})})


CANDIDATE = Candidate(
    key="train.exposure",
    does="with an exposure for each image (after the same fit)",
    asked=_asked,
    decided=_decided,
    compared=compared,
    clear_gain=CLEAR_GAIN,
    evidence=evidence,
)
