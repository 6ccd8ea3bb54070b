"""Coarse cells of images, represented as pixels of low-resolution cameras.

Local letters: V views, P points.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor
from torch.nn.functional import adaptive_avg_pool2d

from dyngs.core.camera import Cameras

CELLS = 40  # Cells along the longest side of an image
_TINY = 1e-6


def cell_camera(cameras: Cameras) -> Cameras:
    """Return the camera whose pixels are the coarse cells of an image of ``cameras``."""
    width, height = cameras.width, cameras.height
    fraction = CELLS / max(width, height)
    return cameras.resized(max(1, round(fraction * width)), max(1, round(fraction * height)))


def pool_to_cells(pixels: Tensor, camera: Cameras) -> Tensor:
    """Return the means (K, h, w) of ``pixels`` (H, W, K) over cells of ``camera``, on the CPU."""
    size = (camera.height, camera.width)
    return adaptive_avg_pool2d(pixels.cpu().permute(2, 0, 1), size)


def unproject_pixels(camera: Cameras, which: Tensor, depth: Tensor) -> Tensor:
    """Return the world points (P, 3) of pixels at given depths.

    Args:
        which: (P,) flat pixel indices, row by row.
        depth: (P,) depth along the optical axis.
    """
    pose = camera.cam_from_world[0]
    k = camera.intrinsics[0]
    pixels = torch.stack([which % camera.width, which // camera.width], -1) + 0.5
    rays = torch.cat([(pixels - k[:2, 2]) / k.diagonal()[:2], torch.ones_like(pixels[:, :1])], 1)
    return (rays * depth[:, None] - pose[:3, 3]) @ pose[:3, :3]


def project_points(camera: Cameras, world: Tensor) -> tuple[Tensor, Tensor]:
    """Return the image coordinates (P, 2), px, of world points (P, 3), and their depths (P,)."""
    pose = camera.cam_from_world[0]
    k = camera.intrinsics[0]
    local = world @ pose[:3, :3].T + pose[:3, 3]
    depth = local[:, 2]
    return local[:, :2] / depth.clamp_min(_TINY)[:, None] * k.diagonal()[:2] + k[:2, 2], depth


def project_to_pixels(camera: Cameras, world: Tensor) -> tuple[Tensor, Tensor]:
    """Return the flat pixel indices (P,) of world points (P, 3), and their depths (P,).

    The index is -1 outside the image and behind the camera.
    """
    at, z = project_points(camera, world)
    inside = (
        (z > _TINY) & (at >= 0).all(1) & (at < at.new_tensor([camera.width, camera.height])).all(1)
    )
    x, y = at.floor().long().unbind(1)
    return torch.where(inside, y * camera.width + x, -1), z


def camera_distances(cameras: Sequence[Cameras]) -> Tensor:
    """Return the pairwise distances (V, V) of camera centres."""
    centres = torch.cat([camera.centers for camera in cameras]).cpu()
    return torch.cdist(centres, centres, compute_mode="donot_use_mm_for_euclid_dist")
