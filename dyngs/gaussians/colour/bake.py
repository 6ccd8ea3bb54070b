"""Harmonics in place of a network, for programs that know no other colours."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from dyngs.core.camera import Cameras
from dyngs.core.conventions import num_sh_terms
from dyngs.gaussians import Gaussians
from dyngs.gaussians.rendering import Shader
from dyngs.ops.harmonics import harmonics_basis

DIRECTIONS = 96  # Number of directions from which colours are sampled; degree 3 has 16 terms

_FAR = 1e4  # Distance of the camera, in largest distances of a Gaussian from the origin


@dataclass(frozen=True)
class Baked:
    """Gaussians with harmonics, and the root mean squared error of their colours over all
    directions."""

    gaussians: Gaussians
    error: float


@torch.no_grad()
def with_harmonics(gaussians: Gaussians, shader: Shader, degree: int = 3) -> Baked:
    """Return the Gaussians with the harmonics of ``degree`` that come nearest to the colours of
    ``shader``.

    Least squares over directions that are evenly spread on the sphere, those included from which no
    image was taken.
    """
    directions = sphere(DIRECTIONS).to(gaussians.means.dtype)
    basis = harmonics_basis(directions, degree)
    solver = torch.linalg.pinv(basis)
    shown = torch.ones(1, len(gaussians), 2, dtype=torch.int32, device=gaussians.means.device)
    far = _FAR * max(1.0, float(gaussians.means.abs().max())) if len(gaussians) else 1.0
    sh = gaussians.sh.new_zeros(len(gaussians), num_sh_terms(degree), 3)
    squares = 0.0
    for weights, direction in zip(solver.T, directions, strict=True):
        colors = shader(gaussians, _eye(-far * direction), shown)[0] - 0.5
        sh += weights[:, None] * colors[:, None]
        squares += float(colors.double().square().sum())
    # What least squares leaves is orthogonal to what it explains.
    explained = torch.einsum("nkc,kl,nlc->", sh.double(), (basis.T @ basis).double(), sh.double())
    error = math.sqrt(
        max(squares - float(explained), 0.0) / max(3 * DIRECTIONS * len(gaussians), 1)
    )
    return Baked(gaussians.replace(sh=sh), error)


def sphere(count: int) -> Tensor:
    """Return (count, 3) unit vectors spread evenly over all directions: a Fibonacci lattice."""
    z = 1 - (2 * torch.arange(count, dtype=torch.float64, device="cpu") + 1) / count
    angle = math.pi * (3 - math.sqrt(5)) * torch.arange(count, dtype=torch.float64, device="cpu")
    radius = (1 - z * z).sqrt()
    return torch.stack([radius * angle.cos(), radius * angle.sin(), z], dim=1)


def _eye(center: Tensor) -> Cameras:
    pose = torch.eye(4, dtype=center.dtype, device=center.device)
    pose[:3, 3] = -center
    return Cameras(pose[None], torch.eye(3, dtype=center.dtype, device=center.device)[None], 1, 1)
