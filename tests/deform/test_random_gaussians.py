"""Random Gaussians: their box, and unchanged existing Gaussians."""

from __future__ import annotations

import torch
from tiny_fields import cloud

from dyngs.deform.random_gaussians import box_of


def test_box_contains_opaque_gaussians() -> None:
    """All but the outer percent of it, with a tenth to spare."""
    gaussians = cloud(300).replace(logit_opacities=torch.full((300,), 2.0))
    center, half_size = box_of(gaussians, 1.0)
    inside = ((gaussians.means - center).abs() <= half_size).all(1)
    assert inside.float().mean() > 0.93
    far = gaussians.means.clone()
    far[:2] = 1e6
    logits = gaussians.logit_opacities.clone()
    logits[2:40] = -10.0
    far[2:40] = -500.0
    bounded = box_of(gaussians.replace(means=far, logit_opacities=logits), 1.0)
    assert (bounded[1] < 1.5 * half_size).all()
