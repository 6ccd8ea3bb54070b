"""Floaters: Gaussians close before one camera that explain its image alone, and haze all views from
next to it.

A Gaussian that belongs to a surface contributes to the images of many cameras. One that hangs
between a camera and the scene shows mostly there. It is cheap to tell: most of its blending weight,
over all training views, lies in one of them, and it is much nearer to that camera than the scene
usually is.
"""

from __future__ import annotations

import torch
from torch import Tensor

from dyngs.core.errors import counted
from dyngs.gaussians.rendering import depths_and_contributions
from dyngs.models.kind import kind_of
from dyngs.training.loop import Loop
from dyngs.training.new_trainer import GaussianTrainer
from dyngs.training.trainer import Edit, Trainer

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


def remove_floaters(loop: Loop) -> Edit | None:
    """Editor that removes floaters when training ends, if that is requested; static scenes only."""
    trainer = loop.trainer
    assert isinstance(trainer, Trainer)
    options = trainer.config.train
    if trainer.done != options.steps or not options.remove_floaters:
        return None
    is_still = "init.scene" in kind_of(trainer.config.model).uses
    if not is_still or len(trainer.images) < FEWEST_VIEWS:
        return None
    found = floaters(trainer)
    count = int(found.sum())
    if not count:
        return None
    before = counted(len(found), "Gaussian")
    message = f"{count:,} of {before} hang close before single cameras"
    if count > MOST * len(found):
        return Edit(f"{message}: too many to be floaters, none is removed")
    return Edit(f"{message}: removed (train.remove_floaters)", ~found)


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
