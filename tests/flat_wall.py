"""A wall whose images are known: cameras that stand side by side before it, and what they and a
model see."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import torch
from torch import Tensor

from dyngs.core.camera import Cameras
from dyngs.data.loader import Image
from dyngs.models.renderable import Rendering

SIZE = (80, 60)
"""Width and height of the images."""
DISTANCE, FOCAL = 5.0, 80.0
BLACK = torch.zeros(3)


def cameras_before_wall(count: int, step: float = 0.15) -> list[Cameras]:
    """Return cameras that look at the wall z = ``DISTANCE`` from x = 0, ``step``, 2 ``step``,
    ..."""
    width, height = SIZE
    intrinsics = torch.tensor([[FOCAL, 0, width / 2], [0, FOCAL, height / 2], [0, 0, 1.0]])
    found = []
    for i in range(count):
        pose = torch.eye(4)
        pose[0, 3] = -step * i
        found.append(Cameras(pose[None], intrinsics[None], width, height))
    return found


def places(camera: Cameras) -> tuple[Tensor, Tensor]:
    """Return the x and y (H, W) on the wall that the pixels show."""
    width, height = SIZE
    v, u = torch.meshgrid(torch.arange(height) + 0.5, torch.arange(width) + 0.5, indexing="ij")
    x = (u - width / 2) / FOCAL * DISTANCE + float(camera.centers[0, 0])
    return x, (v - height / 2) / FOCAL * DISTANCE


def wall(camera: Cameras) -> Tensor:
    """Return the (H, W, 3) image of a wall of soft colours."""
    x, y = places(camera)
    return torch.stack(
        [0.5 + 0.2 * torch.sin(2 * x), 0.5 + 0.2 * torch.cos(1.5 * y + x), 0.5 + 0 * x], -1
    )


def seen_from(cameras: Sequence[Cameras]) -> list[Image]:
    """Return the images of the wall."""
    return [
        Image(f"{i}", camera, wall(camera), None, None, None) for i, camera in enumerate(cameras)
    ]


def with_block(image: Image, rows: slice, columns: slice) -> Image:
    """Return ``image`` with a red block in front."""
    rgb = image.rgb_premultiplied.clone()
    rgb[rows, columns] = torch.tensor([0.9, 0.05, 0.05])
    return replace(image, rgb_premultiplied=rgb)


def with_depth(cameras: Cameras) -> Rendering:
    """Return an opaque rendering at the depth of the wall."""
    depth = torch.full((1, cameras.height, cameras.width), DISTANCE)
    rgb = torch.zeros(1, cameras.height, cameras.width, 3)
    return Rendering(rgb, torch.zeros_like(depth), depth)


def learned(camera: Cameras, error: float = 0.004) -> Tensor:
    """Return the image of a model that has learned the wall but for waves of an ``error``."""
    x, y = places(camera)
    return wall(camera) + error * (torch.sin(9 * x) * torch.cos(7 * y))[..., None]
