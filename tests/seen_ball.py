"""Exact images of a ball by cameras around it."""

from __future__ import annotations

from functools import cache

import torch
from small_triangles import camera

from dyngs.core.camera import Cameras
from dyngs.gaussians.surface import DepthView

RADIUS, SIZE = 0.8, 48
LOW = torch.full((3,), -1.0)
HIGH = torch.full((3,), 1.0)  # Corners of a box around it


def seen_from(turn: torch.Tensor) -> DepthView:
    """A ball at the origin, red where x > 0; ``turn`` (3, 3) rotates the camera."""
    looking = camera(SIZE)
    pose = looking.cam_from_world.clone()
    pose[0, :3, :3] = turn
    inner = looking.intrinsics[0]
    y, x = torch.meshgrid(torch.arange(SIZE) + 0.5, torch.arange(SIZE) + 0.5, indexing="ij")
    ray = torch.stack(
        [(x - inner[0, 2]) / inner[0, 0], (y - inner[1, 2]) / inner[1, 1], torch.ones_like(x)], -1
    )
    a = ray.square().sum(-1)
    b = 4.0 * ray[..., 2]
    inside = b**2 - a * (16 - RADIUS**2)
    depth = (b - inside.clamp_min(0).sqrt()) / a
    world = (depth[..., None] * ray - torch.tensor([0.0, 0, 4])) @ turn
    colour = torch.zeros(SIZE, SIZE, 3)
    colour[..., 0] = (world[..., 0] > 0).float()
    return DepthView(
        Cameras(pose, looking.intrinsics, SIZE, SIZE), depth, (inside > 0).float(), colour
    )


@cache
def views() -> list[DepthView]:
    turns = [torch.eye(3)]
    for axis, other in ((0, 2), (1, 2)):
        for cosine, sine in ((0.0, 1.0), (-1.0, 0.0), (0.0, -1.0)):
            turn = torch.eye(3)
            turn[axis, axis] = turn[other, other] = cosine
            turn[axis, other] = sine
            turn[other, axis] = -sine
            turns.append(turn)
    return [seen_from(turn) for turn in turns]
