"""Ray-traced balls at known positions before fixed cameras."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
import torch

from dyngs.core.camera import Cameras
from dyngs.data.loader import Image
from dyngs.deform.fixed_cameras import FixedCameraClip, build_fixed_camera_clip

SIZE, FOCAL = 64, 80.0
BLACK = torch.zeros(3)


@dataclass(frozen=True)
class Ball:
    """A ball of one colour; an optional second colour covers the side of +x rotated by ``turn``
    radians about z.
    """

    center: tuple[float, float, float]
    radius: float = 0.2
    color: tuple[float, float, float] = (0.9, 0.2, 0.1)
    other: tuple[float, float, float] | None = None
    turn: float = 0.0


Balls = Callable[[float], Sequence[Ball]]
"""Function of a time that returns the balls that there are then; the nearest to a camera hides the
others."""


def cameras(count: int) -> list[Cameras]:
    """Cameras at distance 3, alternately high and low, that look at the origin."""
    intrinsics = torch.tensor([[FOCAL, 0, SIZE / 2], [0, FOCAL, SIZE / 2], [0, 0, 1]])
    found = []
    for i in range(count):
        azimuth = 2 * math.pi * i / max(count, 1)
        elevation = 0.2 + 0.4 * (i % 2)
        flat = math.cos(elevation)
        forward = -torch.tensor(
            [flat * math.cos(azimuth), flat * math.sin(azimuth), math.sin(elevation)]
        )
        right = torch.tensor([-math.sin(azimuth), math.cos(azimuth), 0.0])
        pose = torch.eye(4)
        pose[:3, :3] = torch.stack([right, torch.linalg.cross(forward, right), forward])
        pose[2, 3] = 3.0
        found.append(Cameras(pose[None], intrinsics[None], SIZE, SIZE))
    return found


def drawn(
    camera: Cameras, balls: Sequence[Ball], noise: float = 0.0, seed: int = 0
) -> torch.Tensor:
    """Return the (H, W, 3) image before a wall of grey stripes."""
    pose = camera.cam_from_world[0].double().numpy()
    intrinsics = camera.intrinsics[0].double().numpy()
    y, x = np.mgrid[:SIZE, :SIZE] + 0.5
    rays = np.stack([x, y, np.ones_like(x)], -1) @ np.linalg.inv(intrinsics).T @ pose[:3, :3]
    rays /= np.linalg.norm(rays, axis=-1, keepdims=True)
    origin = -pose[:3, :3].T @ pose[:3, 3]
    rgb = np.repeat(0.5 + 0.2 * np.sin(0.9 * x + 0.4 * y + 3 * pose[2, 0])[..., None], 3, -1)
    nearest = np.full(x.shape, np.inf)
    for ball in balls:
        offset = origin - np.array(ball.center)
        half_b = rays @ offset
        inside = half_b**2 - offset @ offset + ball.radius**2
        distance = np.where(inside > 0, -half_b - np.sqrt(np.maximum(inside, 0)), np.inf)
        hit = (distance > 0) & (distance < nearest)
        nearest[hit] = distance[hit]
        local = origin + distance[hit][:, None] * rays[hit] - np.array(ball.center)
        lit = local @ np.array([math.cos(ball.turn), math.sin(ball.turn), 0.0]) > 0.3 * ball.radius
        rgb[hit] = np.where(
            lit[:, None] & (ball.other is not None), ball.other or ball.color, ball.color
        )
    rgb += noise * np.random.default_rng(seed).standard_normal(rgb.shape)
    return torch.from_numpy(rgb.clip(0, 1)).float()


def filmed(
    balls: Balls, times: Sequence[float], count: int = 6, noise: float = 0.01
) -> list[FixedCameraClip]:
    """Return the clips of ``count`` cameras."""
    return [
        build_fixed_camera_clip(
            (
                Image("view", camera, drawn(camera, balls(t), noise, 100 * i + j), None, None, t)
                for j, t in enumerate(times)
            ),
            BLACK,
        )
        for i, camera in enumerate(cameras(count))
    ]
