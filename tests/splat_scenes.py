"""Gaussians of every kind for the tests of file formats, and images of them."""

from __future__ import annotations

from dataclasses import replace
from importlib.util import find_spec

import torch
from two_balls import cameras_around

from dyngs.core.camera import Cameras
from dyngs.core.conventions import num_sh_terms
from dyngs.gaussians import Gaussians
from dyngs.gaussians.rendering import render
from dyngs.io.formats.formats import FORMATS, Format
from dyngs.ops.quaternions import rotation_matrices

AROUND = cameras_around(3, 48, 36)


def cloud(count: int = 400, degree: int = 3, seed: int = 0) -> Gaussians:
    """Return Gaussians of all sizes and rotations around the origin, seen by ``AROUND``, with
    strong harmonics."""
    generator = torch.Generator().manual_seed(seed)

    def normal(*shape: int) -> torch.Tensor:
        return torch.randn(*shape, generator=generator)

    quats = torch.nn.functional.normalize(normal(count, 4), dim=1)
    sh = normal(count, num_sh_terms(degree), 3) * 0.15
    return Gaussians(
        normal(count, 3) * 0.6, quats, normal(count, 3) * 0.5 - 2.5, normal(count) * 2, sh
    )


def seen(gaussians: Gaussians, cameras: Cameras = AROUND) -> torch.Tensor:
    """Return images (V, H, W, 3) in [0, 1]."""
    return render(gaussians, cameras).rgb.clamp(0, 1)


def cameras_turned(rotation: tuple[float, ...], cameras: Cameras = AROUND) -> Cameras:
    """Return the cameras turned with a scene by a quaternion wxyz."""
    turn = torch.eye(4, dtype=torch.float64)
    turn[:3, :3] = rotation_matrices(torch.tensor(rotation, dtype=torch.float64))
    return replace(cameras, cam_from_world=(cameras.cam_from_world.double() @ turn.T).float())


def psnr(a: torch.Tensor, b: torch.Tensor) -> float:
    """Return the PSNR in dB, at most 100."""
    return float(-10 * torch.log10((a - b).square().mean().clamp_min(1e-10)))


def readable() -> list[Format]:
    """Return the formats whose packages are installed."""
    needs = {"usd": "pxr", "4dgs": "fourdgs"}
    return [f for f in FORMATS if f.name not in needs or find_spec(needs[f.name]) is not None]
