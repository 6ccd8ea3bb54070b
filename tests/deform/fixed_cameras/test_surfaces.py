"""Surfaces that change their colour at a time, excluding occluded ones."""

from __future__ import annotations

import torch
from static_balls import Ball, filmed

from dyngs.deform.fixed_cameras.initial_motion import detect_surface_changes
from dyngs.gaussians import Gaussians
from dyngs.gaussians.rendering import RenderOptions

TIMES = tuple(i / 5 for i in range(6))
CENTER = torch.tensor([0.0, 0.1, 0.1])
RADIUS = 0.4
RED = (0.9, 0.2, 0.1)
INSIDE = 0.35  # Radius of the Gaussians, which are blurred: none shows what is beside the ball


def shell(count: int = 400) -> Gaussians:
    """Flat red Gaussians on the surface of a ball."""
    i = torch.arange(count)
    z = 1 - (2 * i + 1) / count
    turn = 2.39996 * i
    flat = (1 - z**2).sqrt()
    out = torch.stack([flat * turn.cos(), flat * turn.sin(), z], 1)
    # z to the outward normal
    quats = torch.cat([1 + out[:, 2:], -out[:, 1:2], out[:, :1], torch.zeros(count, 1)], 1)
    scales = torch.tensor([0.04, 0.04, 0.004]).log().expand(count, 3)
    sh = ((torch.tensor(RED) - 0.5) / 0.28209479).expand(count, 1, 3)
    return Gaussians(
        CENTER + INSIDE * out, quats, scales.clone(), torch.full((count,), 4.0), sh.clone()
    )


def test_a_ball_that_is_blue_at_a_time_gets_blue_gaussians_then_just_before_its_own() -> None:
    clips = filmed(
        lambda t: [Ball((0.0, 0.1, 0.1), RADIUS, (0.1, 0.2, 0.9) if t == TIMES[2] else RED)],
        TIMES,
        noise=0.0,
    )
    (found,) = detect_surface_changes(clips, shell(), RenderOptions(), 1000)
    assert found.time == TIMES[2]
    assert len(found.gaussians) > 300
    close = (found.gaussians.base_rgb - torch.tensor([0.1, 0.2, 0.9])).abs().amax(1) < 0.15
    assert close.float().mean() > 0.9
    apart = (found.gaussians.means - CENTER).norm(dim=1)
    assert ((apart - INSIDE).abs() < 0.03).all()
    assert not found.velocity.any()
    fewer = detect_surface_changes(clips, shell(), RenderOptions(), 50)
    assert sum(len(one.gaussians) for one in fewer) <= 50
