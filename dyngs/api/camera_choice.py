"""Whether the training cameras are refined: found by one or two small, short runs.

Views held out have no refined cameras. So for each of them both models find the pose from which they look most like one
half of the image, and are compared on the other half. Where that helps the run without refinement little, the cameras
are right, and a second run would not be worth its time.
"""

from __future__ import annotations

from statistics import fmean

import torch

from dyngs.api.candidate import Candidate, Choice, Comparison, Evidence
from dyngs.api.small_runs import drawn
from dyngs.config import Config, DynamicModel, StaticModel
from dyngs.kinds import GaussianTrainer
from dyngs.metrics import psnr
from dyngs.models.views import background_colour
from dyngs.training.corrections.camera_fit import fitted_to_image

WRONG = 0.1
"""Mean gain, dB, of views held out by a fitted pose from which the cameras may be wrong."""
CLEAR_GAIN = 0.1
"""Mean gain, dB, that refined training cameras must bring at least."""


def evidence(plain: GaussianTrainer) -> Evidence:
    """Return whether the cameras of a small run without refinement may be wrong."""
    scores = [_scores(plain, index) for index in sorted(plain.held_out)]
    gain = fmean(fitted - given for given, fitted in scores)
    text = f"poses fitted on half of each of {len(scores)} images change the other half by {gain:+.2f} dB"
    return Evidence(gain >= WRONG, text)


def compared(one: GaussianTrainer, other: GaussianTrainer) -> Comparison:
    """Compare two models on the views held out, each after the same fit."""
    held_out = sorted(one.held_out)
    return Comparison([(_scores(one, i)[1], _scores(other, i)[1]) for i in held_out])


def _scores(trainer: GaussianTrainer, index: int) -> tuple[float, float]:
    """Return PSNR, dB, of the right half of a view: from its own pose, and from one fitted on the left half."""
    image, background = trainer.images[index], background_colour(trainer.background)
    left = torch.zeros_like(image.rgb_premultiplied[..., 0])
    left[:, : left.shape[1] // 2] = 1
    right = 1 - left if image.mask is None else (1 - left) * image.mask
    options = trainer.model.options
    fitted = fitted_to_image(trainer.model.scene, image, background, trainer.extent, options=options, weights=left)
    truth = image.composite(background)
    plain, moved = (psnr(drawn(trainer.model.scene, x, options, background), truth, right) for x in (image, fitted))
    return plain, moved


def _asked(config: Config) -> bool:
    match config.model:
        case StaticModel() | DynamicModel():
            return config.camera.refine == "auto"
        case _:
            return False


def _decided(config: Config, choice: Choice) -> Config:
    return config.model_copy(update={"camera": config.camera.model_copy(update={"refine": choice})})


CANDIDATE = Candidate(
    key="camera.refine",
    does="with refined cameras",
    asked=_asked,
    decided=_decided,
    compared=compared,
    clear_gain=CLEAR_GAIN,
    evidence=evidence,
)
