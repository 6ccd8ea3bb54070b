"""Light that is fixed in the world: a factor on colours that depends on where the surface faces.

Without it, the light of the training poses is baked into the colours, and stays on an arm that turns away from it. The
factor is 1 + y(n) A for the outward normal n in the world, with the quadratic harmonics y, which hold nearly all of the
light that a matt surface receives (Ramamoorthi and Hanrahan, An Efficient Representation for Irradiance Environment
Maps, 2001). Local letters: N Gaussians.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from dyngs.conventions import SH_C0
from dyngs.gaussians import Gaussians
from dyngs.ops.quaternions import rotation_matrices

LEFT_OUT = "the learned light is left out: colours are those in even light"
"""Message of files that cannot hold it."""
TERMS = 8
"""Number of harmonics of degree 1 and 2; degree 0 is the colour itself."""


@dataclass(frozen=True)
class Light:
    """Light that falls on N Gaussians.

    Attributes:
        normals: (N, 3) outward at rest, of any length.
        factors: (8, 3) A, red, green and blue.
    """

    normals: Tensor
    factors: Tensor

    def on(self, sh: Tensor, linear: Tensor) -> Tensor:
        """Return harmonics (N, K, 3) with their colours times the light, of Gaussians moved by (N, 3, 3)."""
        facing = torch.nn.functional.normalize((linear * self.normals[:, None]).sum(-1), dim=1)
        factor = (1 + harmonics(facing) @ self.factors)[:, None]
        lit = sh * factor
        return torch.cat([lit[:, :1] + (factor - 1) * (0.5 / SH_C0), lit[:, 1:]], dim=1)


def harmonics(directions: Tensor) -> Tensor:
    """Return the harmonics (N, 8) of degree 1 and 2, not normalised, in unit directions (N, 3)."""
    x, y, z = directions.unbind(1)
    return torch.stack([x, y, z, x * y, y * z, x * z, x * x - y * y, 3 * z * z - 1], dim=1)


def rest_normals(gaussians: Gaussians) -> Tensor:
    """Return the outward normals (N, 3) at rest of the first Gaussians, which are discs in the tangent plane."""
    return rotation_matrices(gaussians.quats)[..., 2]


def difference_of_sides(gaussians: Gaussians, images: Tensor, is_image: Tensor) -> Tensor:
    """Return the mean squared difference () between base colours and those of the mirror images.

    Clothes are mostly the same on both sides and light is not: this tells one from the other where nobody turns.

    Args:
        gaussians: N.
        images: (N,) rows of the mirror images, and ``is_image`` (N,) if there is one.
        is_image: see ``images``.
    """
    colours = gaussians.sh[:, 0] * SH_C0
    return ((colours - colours.index_select(0, images)).square().sum(1) * is_image).mean()
