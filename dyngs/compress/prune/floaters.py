"""Floaters: Gaussians close before one camera that explain its image alone, and haze all views from
next to it.

A Gaussian that belongs to a surface contributes to the images of many cameras. One that hangs
between a camera and the scene shows mostly there. It is cheap to tell: most of its blending weight,
over all training views, lies in one of them, and it is much nearer to that camera than the scene
usually is.
"""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor

from dyngs.core.errors import counted
from dyngs.gaussians.rendering import depths_and_contributions
from dyngs.static.keys import StaticModel
from dyngs.training.events import Event, Message, StepDone, TopologyChanged
from dyngs.training.loop import Loop
from dyngs.training.new_trainer import GaussianTrainer

MAIN_FRACTION = 0.5  # Fraction of the weight of a Gaussian that must lie in one view
# Depth of a Gaussian in that view, over the median depth of the view, below which it is near
NEAR = 0.6
SEEN = 0.3  # Sum of weights over all views, px, from which a Gaussian shows at all
# Of the views that are drawn, px: what hangs in the way shows in small ones, too
LONGEST_SIDE = 200
SOLID = 0.5  # Alpha from which a pixel has a depth
FEWEST_VIEWS, MOST = 20, 0.01
"""With fewer views, or with a larger fraction of such Gaussians, much of the scene is seen by one
view only."""


class FloaterRemoval:
    """Listener that removes floaters when training ends, if that is asked for; static scenes
    only."""

    def __init__(self, loop: Loop, trainer: Callable[[], GaussianTrainer]) -> None:
        self._loop, self._trainer = loop, trainer

    def __call__(self, event: Event) -> None:
        match event:
            case StepDone() if event.step == self._trainer().config.train.steps:
                self._remove(event.step)

    def _remove(self, step: int) -> None:
        trainer = self._trainer()
        match trainer.config.model:
            case StaticModel() if (
                trainer.config.train.remove_floaters and len(trainer.images) >= FEWEST_VIEWS
            ):
                found = floaters(trainer)
            case _:
                return
        before = len(trainer.model.scene)
        count = int(found.sum())
        if not count:
            return
        fraction = f"{count:,} of {counted(before, 'Gaussian')} hang close before single cameras"
        if count > MOST * before:
            self._loop.tell(Message(f"{fraction}: too many to be floaters, none is removed"))
            return
        trainer.model.keep(~found, trainer.done)
        self._loop.tell(Message(f"{fraction}: removed (train.remove_floaters)"))
        self._loop.tell(TopologyChanged(step, before, len(trainer.model.scene)))


@torch.no_grad()
def floaters(trainer: GaussianTrainer) -> Tensor:
    """Return (N,) bool which Gaussians of a static scene are floaters, by all of its training
    views."""
    gaussians = trainer.model.scene.gaussians.detach()
    total = torch.zeros_like(gaussians.logit_opacities)
    most = torch.zeros_like(gaussians.logit_opacities)
    nearness = torch.full_like(total, torch.inf)
    for camera in trainer.images.cameras():
        small = camera.scaled(min(1.0, LONGEST_SIDE / max(camera.width, camera.height)))
        drawn, weights = depths_and_contributions(gaussians, small, trainer.model.options)
        weight = weights[0]
        alpha = 1 - drawn.transmittance[0]
        is_solid = alpha > SOLID
        depths = drawn.color[0, ..., 0][is_solid] / alpha[is_solid]
        pose = small.cam_from_world[0]
        depth = depths.median() if depths.numel() else depths.new_zeros(())
        is_main = weight > most
        nearness = torch.where(
            is_main, (gaussians.means @ pose[2, :3] + pose[2, 3]) / depth, nearness
        )
        total = total + weight
        most = torch.where(is_main, weight, most)
    return (total > SEEN) & (most > MAIN_FRACTION * total) & (nearness < NEAR)
