"""An exactly ray-traced ball in two cameras, for tests of stereo."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from dyngs.core.camera import Cameras
from dyngs.data.loader import Image
from dyngs.human.predict.gps.rectification import RectifiedPair

SIZE = 96
CENTER = torch.tensor([0.1, 0.9, -0.05])
RADIUS = 0.5


def pose_at(
    degrees: float, height: float = 1.1, distance: float = 3.0, roll: float = 0.0
) -> Tensor:
    """(4, 4) cam_from_world in OpenCV axes that looks at (0, 0.9, 0); y is up in the world."""
    turn = np.radians(degrees)
    center = np.array([distance * np.sin(turn), height, distance * np.cos(turn)])
    forward = np.array([0, 0.9, 0]) - center
    forward /= np.linalg.norm(forward)
    right = np.cross(forward, [0.0, 1.0, 0.0])
    right /= np.linalg.norm(right)
    rotation = np.stack([right, np.cross(forward, right), forward])
    c = np.cos(np.radians(roll))
    s = np.sin(np.radians(roll))
    rotation = np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]]) @ rotation
    pose = np.eye(4)
    pose[:3, :3] = rotation
    pose[:3, 3] = -rotation @ center
    return torch.from_numpy(pose).float()


def ball(pose: Tensor, focal: float = 130.0, name: str = "a") -> Image:
    """A ray-traced ball: colours are its surface points, depth is along the view axis."""
    intrinsics = torch.tensor(
        [[focal, 0, 0.5 * SIZE + 3], [0, 1.1 * focal, 0.5 * SIZE - 2], [0, 0, 1]]
    )
    rows, columns = torch.meshgrid(
        torch.arange(SIZE) + 0.5, torch.arange(SIZE) + 0.5, indexing="ij"
    )
    rays = (
        torch.stack([columns, rows, torch.ones_like(rows)], dim=2)
        @ torch.linalg.inv(intrinsics).T
        @ pose[:3, :3]
    )
    origin = -pose[:3, :3].T @ pose[:3, 3]
    depth, alpha = hit(origin, rays)
    points = origin + depth[..., None] * rays
    rgb = alpha[..., None] * (0.5 + 0.4 * torch.sin(3 * points))
    return Image(
        name,
        Cameras(pose[None], intrinsics[None], SIZE, SIZE),
        rgb,
        alpha,
        None,
        None,
        depth=depth * alpha,
    )


def hit(origin: Tensor, rays: Tensor) -> tuple[Tensor, Tensor]:
    """Depth of the ball along ``rays`` (..., 3) in units of their length, and the hit mask."""
    a = (rays * rays).sum(-1)
    b = (rays * (origin - CENTER)).sum(-1)
    inside = b * b - a * (((origin - CENTER) ** 2).sum() - RADIUS**2)
    return (-b - inside.clamp_min(0).sqrt()) / a, (inside > 0).float()


def exact_depth(pair: RectifiedPair) -> Tensor:
    """(2, 1, H, W) depth of the ball in the rectified windows."""
    ones = torch.ones_like(pair.alpha)
    rays = pair.points(ones) - pair.centers[:, None, None]
    return torch.stack(
        [hit(center, ray)[0] for center, ray in zip(pair.centers, rays, strict=True)]
    )[:, None]
