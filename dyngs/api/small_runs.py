"""Small, short runs beside the one that was asked for, compared on training views that are held out."""

from __future__ import annotations

import math
from collections.abc import Sequence
from statistics import fmean, stdev

import torch
from torch import Tensor
from typing_extensions import assert_never

from dyngs.config import BudgetConfig, Config, DefaultStrategy, FixedStrategy, McmcStrategy, PruneConfig, Strategy
from dyngs.data.capture import View
from dyngs.data.loader import Image
from dyngs.gaussians.colour.affine import fitted_affine, recoloured
from dyngs.gaussians.rendering import RenderOptions
from dyngs.gaussians.scene import Scene
from dyngs.kinds import GaussianTrainer, assemble
from dyngs.metrics import psnr

SMALL_SIDE, SMALL_GAUSSIANS = 128, 15_000
"""Longest side of the images, px, and most Gaussians.

A static model of what moves grows without end, to explain motion by viewpoint; one per pixel is enough to fail by.
"""
FEWEST_VIEWS = 8
"""With fewer training views none can be spared for a comparison."""
FEW_VIEWS, OFTEN, HELD_OUT = 24, 4, 10
"""Below so many views one in four is held out; from there on one in eight, and about ten in all."""


def small_run(config: Config, every: int, steps: int) -> Config:
    """Return ``config`` for ``steps`` in small images, without limits, one view of ``every`` never trained on."""
    side = min(config.data.longest_side or SMALL_SIDE, SMALL_SIDE)
    held_out = {"hold_out_every": every, "hold_out_until": 1.0, "steps": steps, "minutes": None}
    return config.model_copy(
        update={
            "data": config.data.model_copy(update={"longest_side": side}),
            "strategy": _limited(config.strategy),
            "train": config.train.model_copy(update=held_out | {"save_every": 0, "eval_every": 0}),
            "budget": BudgetConfig(),
            "prune": PruneConfig(),
        }
    )


def trained(config: Config, every: int, steps: int) -> GaussianTrainer:
    """Return the trainer after a small run of ``config``; see ``small_run``."""
    trainer = assemble(small_run(config, every, steps))
    while trainer.done < steps:
        trainer.step()
    return trainer


def hold_out_every(views: Sequence[View]) -> int:
    """Return of how many views one is held out; odd, so that it is not always the same of several cameras."""
    if len(views) < FEW_VIEWS:
        return OFTEN
    return max(8, len(views) // HELD_OUT) | 1


@torch.no_grad()
def drawn(scene: Scene, image: Image, options: RenderOptions, background: Tensor, *, fitted: bool = False) -> Tensor:
    """Return ``image`` as ``scene`` shows it (H, W, 3); ``fitted``: after an affine colour that is fitted to it."""
    rendering = scene.render(image.cameras, image.time, options=options, background=background)
    if not fitted:
        return rendering.rgb[0]
    affine = fitted_affine([(image, rendering)], background)
    return recoloured(affine, image, rendering, background)


def held_out_scores(scene: Scene, trainer: GaussianTrainer, background: Tensor) -> list[float]:
    """Return the PSNR of the images that ``trainer`` holds out, dB, in order of their indices.

    Where exposures are learned, those of images held out are not: they are fitted.
    """
    options, fitted = trainer.model.options, trainer.exposures is not None
    shown = [trainer.images[i] for i in sorted(trainer.held_out)]
    return [psnr(drawn(scene, x, options, background, fitted=fitted), x.composite(background), x.mask) for x in shown]


def is_gain(gains: Sequence[float]) -> bool:
    """Return whether gains are positive by more than twice the standard error of their mean: runs differ by chance."""
    return fmean(gains) > 2 * (stdev(gains) if len(gains) > 1 else 0.0) / math.sqrt(len(gains))


def _limited(strategy: Strategy) -> Strategy:
    match strategy:
        case DefaultStrategy() | McmcStrategy():
            most = min(strategy.max_gaussians, SMALL_GAUSSIANS)
            return strategy.model_copy(update={"max_gaussians": most})
        case FixedStrategy():
            return strategy
        case _:
            assert_never(strategy)
