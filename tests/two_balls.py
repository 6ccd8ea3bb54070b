"""Two balls, and cameras that turn about them."""

from __future__ import annotations

import math

import torch

from dyngs.core.camera import Cameras
from dyngs.gaussians import Gaussians


def two_balls(distance: float = 4.0) -> Gaussians:
    """A large red ball on the left and a small green one on the right, at ``distance`` from the
    cameras.
    """
    means = torch.tensor([[-0.5, 0.0, 0.0], [0.7, 0.0, 0.0]])
    colours = torch.tensor([[1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])
    sizes = torch.tensor([0.3, 0.15]).log()[:, None].expand(2, 3)
    identity = torch.tensor([[1.0, 0, 0, 0]]).expand(2, 4)
    return Gaussians(
        means,
        identity,
        sizes,
        torch.full((2,), 5.0),
        ((colours - 0.5) / 0.28209479177387814)[:, None],
    )


def cameras_around(count: int, width: int = 24, height: int = 18, distance: float = 4.0) -> Cameras:
    """Cameras on a circle about the vertical axis that look at the origin."""
    poses = torch.eye(4).repeat(count, 1, 1)
    for i in range(count):
        angle = 0.3 * i
        poses[i, 0, 0] = poses[i, 2, 2] = math.cos(angle)
        poses[i, 0, 2], poses[i, 2, 0] = math.sin(angle), -math.sin(angle)
        poses[i, 2, 3] = distance
    intrinsics = torch.tensor([[24.0, 0, width / 2], [0, 24, height / 2], [0, 0, 1]]).repeat(
        count, 1, 1
    )
    return Cameras(poses, intrinsics, width, height)
