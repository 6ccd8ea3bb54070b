"""Few curved triangles, and runs with them, for tests."""

from __future__ import annotations

from pathlib import Path

import torch
from torch import Tensor

from dyngs.baselines.triangles.scene import Patches, flat_triangles
from dyngs.config import Config
from dyngs.config.io import load_config
from dyngs.core.camera import Cameras

KEYS = [
    "model.kind=bg_triangle",
    "model.max_triangles=300",
    "model.gaussian_steps=60",
]


def config_of(capture: Path, *keys: str) -> Config:
    return load_config(None, [f"data.root={capture}", "run.threads=1", *KEYS, *keys])


def triangle(*corners: tuple[float, float, float]) -> Tensor:
    """(1, 6, 3) control points of a flat triangle."""
    return flat_triangles(torch.tensor([corners]))


def bent(count: int = 3, seed: int = 0, degree: int = 1) -> Patches:
    """Random triangles with colours at their control points."""
    generator = torch.Generator().manual_seed(seed)
    corners = torch.randn(count, 3, 3, generator=generator)
    points = flat_triangles(corners) + 0.1 * torch.randn(count, 6, 3, generator=generator)
    terms = (degree + 1) ** 2 - 1
    colours = torch.rand(count, 6, 3, generator=generator)
    return Patches(points, colours, 0.1 * torch.randn(count, terms, 3, generator=generator))


def camera(size: int = 32, distance: float = 4.0) -> Cameras:
    """A camera at the origin that looks along z."""
    pose = torch.eye(4)[None].clone()
    pose[0, 2, 3] = distance
    inner = torch.tensor([[[size * 1.2, 0, size / 2], [0, size * 1.2, size / 2], [0, 0, 1]]])
    return Cameras(pose, inner, size, size)
