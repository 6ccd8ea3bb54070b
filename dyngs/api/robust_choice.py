"""Whether a still scene is trained without what disagrees between its pictures: found by two small, short runs.

Both runs are compared on training views that are held out. Those show people who walk through, too, whom no model can
foresee. So only the pixels count that at least one of the two models explains best, the same ones for both.
"""

from __future__ import annotations

import time
from statistics import fmean
from typing import Literal

import torch
from torch import Tensor

from dyngs.api.small_runs import FEWEST_VIEWS, drawn, hold_out_every, is_gain, trained
from dyngs.config import Config, StaticModel
from dyngs.data.read import read_capture
from dyngs.metrics import psnr
from dyngs.training.background import background_colour
from dyngs.training.trainer import Trainer

STEPS, SHARE, FEWEST_STEPS = 1500, 0.2, 400
"""Steps of each small run; at most this share of the run's own. With fewer steps than these it says nothing."""
EXPLAINED = 0.8
"""Share of the pixels of a view that count: those where the smaller of the two errors is smallest."""
CLEAR_GAIN = 0.1
"""Mean gain, dB, that masks must bring at least."""


def decided(config: Config) -> Config:
    """Return ``config`` with ``train.robust`` decided, if that is to be found out; a line says what was found.

    Raises:
        DyngsError: a capture that cannot be read.
    """
    match config.model:
        case StaticModel() if config.train.robust == "auto":
            pass
        case _:
            return config
    views, steps = read_capture(config.data).splits["train"], min(STEPS, int(SHARE * config.train.steps))
    if config.budget.max_minutes is not None or steps < FEWEST_STEPS or len(views) < FEWEST_VIEWS:
        print("train.robust=auto: too short a run, or too few views, to find out whether it pays; not used", flush=True)
        return _with(config, "never")
    begun, every = time.monotonic(), hold_out_every(views)
    plain, robust = (trained(_with(config, choice), every, steps) for choice in ("never", "always"))
    scores = compared(plain, robust)
    gains = [b - a for a, b in scores]
    pays = is_gain(gains) and fmean(gains) >= CLEAR_GAIN
    print(
        f"two runs of {steps:,} steps in small pictures, {len(scores)} held-out training views: "
        f"{fmean(a for a, _ in scores):.2f} dB as it is, {fmean(b for _, b in scores):.2f} dB without what disagrees "
        f"between views: train.robust {'taken' if pays else 'not taken'} ({time.monotonic() - begun:.0f} s)",
        flush=True,
    )
    return _with(config, "always" if pays else "never")


def compared(one: Trainer, other: Trainer) -> list[tuple[float, float]]:
    """Return the PSNR, dB, of each view held out, drawn by two models, over the pixels that one of them explains."""
    background, found = background_colour(one.background), []
    for index in sorted(one.held_out):
        picture = one.pictures[index]
        truth = picture.composite(background)
        pictures = [drawn(x.scene, picture, x.options, background) for x in (one, other)]
        counts = explained(pictures[0], pictures[1], truth, picture.mask)
        found.append((psnr(pictures[0], truth, counts), psnr(pictures[1], truth, counts)))
    return found


def explained(one: Tensor, other: Tensor, truth: Tensor, mask: Tensor | None) -> Tensor:
    """Return (H, W) the pixels, of those that ``mask`` keeps, where the smaller error of two pictures is smallest.

    Neither picture is favoured: exchanged, they give the same.

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


def _with(config: Config, choice: Literal["never", "always"]) -> Config:
    return config.model_copy(update={"train": config.train.model_copy(update={"robust": choice})})
