"""Whether anything moves in a capture, found out before a moving scene is trained."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch

from dyngs.config import Config, DefaultStrategy, PointsInit, StaticModel
from dyngs.data.capture import Capture, View
from dyngs.data.frame_selection import evenly_spaced
from dyngs.data.loader import ImageLoader
from dyngs.data.read import read_capture
from dyngs.data.times import are_scattered
from dyngs.deform.evidence import MIN_DIFFERING, Evidence, Verdict, agreement_over_time, differing_fraction
from dyngs.deform.still_error import cameras_in_place, signed_errors
from dyngs.kinds import GaussianTrainer, assemble
from dyngs.models.views import evaluation_background

LONGEST_SIDE = 96
"""Of the images that are looked at, px: enough to see what moves, and soon learned by a small model."""
MAX_CAMERAS, MAX_MOMENTS = 8, 24
"""Cameras that stay in place, and images of each, that are compared."""
MAX_VIEWS = 100
MIN_VIEWS = 24
"""With fewer views, agreement by chance cannot be told from other."""
STEPS, MAX_GAUSSIANS, FIRST_POINTS = 450, 10_000, 5000
"""Of the small static model."""


def motion_evidence(config: Config) -> Evidence:
    """Return whether anything moves in the capture of ``config``, from its training images made small.

    Raises:
        DyngsError: a capture that cannot be read.
    """
    options = config.data.model_copy(
        update={"longest_side": min(config.data.longest_side or LONGEST_SIDE, LONGEST_SIDE)}
    )
    capture = read_capture(options)
    views = capture.splits["train"]
    in_place = cameras_in_place(views)
    if sum(map(len, in_place)) > 0.9 * len(views):
        return _of_fixed_cameras(capture, in_place, config.model_copy(update={"data": options}))
    order = in_order_of_time(views)
    if len(order) < MIN_VIEWS or not are_scattered([views[i] for i in order]):
        return Evidence(Verdict.OPEN, f"{len(views)} views whose time goes with the viewpoint do not tell beforehand")
    return _of_scattered_cameras(capture, order, config.model_copy(update={"data": options}))


def in_order_of_time(views: Sequence[View]) -> list[int]:
    """Return indices of at most ``MAX_VIEWS`` views, evenly chosen, in order of time."""
    order = sorted(range(len(views)), key=lambda i: (views[i].time or 0.0, views[i].name))
    return [order[i] for i in evenly_spaced(len(order), MAX_VIEWS)]


def _of_fixed_cameras(capture: Capture, cameras: Sequence[Sequence[int]], config: Config) -> Evidence:
    loader = ImageLoader(capture.splits["train"], config.data)
    _, background = evaluation_background(config.data.background, capture.has_alpha)
    chosen = [cameras[i] for i in evenly_spaced(len(cameras), MAX_CAMERAS)]
    images = [[loader[seen[i]].composite(background) for i in evenly_spaced(len(seen), MAX_MOMENTS)] for seen in chosen]
    fraction = differing_fraction(images)
    verdict = Verdict.MOVES if fraction > MIN_DIFFERING else Verdict.STILL
    return Evidence(verdict, f"{fraction:.2%} of the pixels of fixed cameras differ from their median")


def _of_scattered_cameras(capture: Capture, order: Sequence[int], config: Config) -> Evidence:
    trainer = assemble(_small(config))
    while trainer.done < STEPS:
        trainer.step()
    errors, weights = _errors(trainer, order, evaluation_background(config.data.background, capture.has_alpha)[1])
    views = capture.splits["train"]
    directions = torch.from_numpy(np.stack([views[i].cam_from_world[2, :3] for i in order]))
    found = agreement_over_time(errors, weights, directions, torch.Generator().manual_seed(config.run.seed))
    reason = f"errors of a small static model at successive times agree by {found.deviations:.1f} standard deviations"
    return Evidence(found.verdict, reason)


def _small(config: Config) -> Config:
    """Return the configuration of the small static model."""
    return config.model_copy(
        update={
            "model": StaticModel(sh_degree=1),
            "init": PointsInit(triangulate=0, num_random=FIRST_POINTS),
            "strategy": DefaultStrategy(max_gaussians=MAX_GAUSSIANS),
            "train": type(config.train)(steps=STEPS),
            "prune": type(config.prune)(),
            "budget": type(config.budget)(),
        }
    )


def _errors(
    trainer: GaussianTrainer, order: Sequence[int], background: torch.Tensor
) -> tuple[torch.Tensor, torch.Tensor]:
    """Return errors and weights as ``agreement_over_time`` wants them."""
    found = []
    for i in order:
        image = trainer.images[i]
        with torch.no_grad():
            shown = trainer.model.scene.render(image.cameras, image.time, background=background).rgb[0]
        gaussians = trainer.model.scene.gaussians.detach()
        found.append(signed_errors(gaussians, image, trainer.model.options, background, shown))
    return torch.stack([x for x, _ in found]), torch.stack([x for _, x in found])
