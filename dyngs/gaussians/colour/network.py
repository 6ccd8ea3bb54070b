"""Colours from three base values per Gaussian and one small network for all of them (MEGA, Zhang et
al. 2024).

MEGA draws sigmoid(c_dc + F(mu, d, t, c_dc)) with F a perceptron, d the unit direction from the
camera to the centre mu. Here F is added to the base colour of the harmonics before their clamp,
max(0, rgb + F(...)): so files that hold the base colours alone stay right, and a network whose last
layer is zero changes nothing. Gradients of F by mu and d are stopped, so that colours do not move
Gaussians.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass

import torch
from torch import Tensor

from dyngs.core.camera import Cameras
from dyngs.core.conventions import num_sh_terms
from dyngs.core.state import Role, State, with_role
from dyngs.core.tensor_checks import require_positive, require_tensor
from dyngs.gaussians import Gaussians
from dyngs.gaussians.rendering import Shader
from dyngs.ops.harmonics import harmonics_basis
from dyngs.ops.perceptron import Layer, perceptron
from dyngs.ops.shading import Sight, num_inputs, shading_inputs


@dataclass(frozen=True)
class RestFrame:
    """Rest pose of a moving body, which its colours follow."""

    places: Tensor  # (N, 3) centres of the drawn Gaussians at rest
    turn: Tensor  # (3, 3) rotation of the body from rest to the world


@dataclass(frozen=True)
class ColourNetwork:
    """F: what is added to the base colour of a Gaussian, by place, direction, normal and time."""

    layers: tuple[Layer, ...]
    box: Tensor  # (2, 3) centre and half sides of the scene, world units
    sees_time: bool
    # the cosine between the shortest axis of the Gaussian and the direction, and the direction
    # mirrored at that axis, are inputs
    sees_normals: bool

    @property
    def num_values(self) -> int:
        return self.box.numel() + sum(
            layer.weight.numel() + layer.bias.numel() for layer in self.layers
        )

    def state(self) -> State:
        tensors = {
            "box": self.box,
            "sees": torch.tensor([self.sees_time, self.sees_normals], device="cpu"),
        }
        for i, layer in enumerate(self.layers):
            tensors |= {f"weight{i}": layer.weight.detach(), f"bias{i}": layer.bias.detach()}
        return with_role(tensors, Role.SHARED)

    def shader(self, time: float | None, frame: RestFrame | None = None) -> Shader:
        """Return the shader at ``time`` (clamped to [0, 1], None is 0); ``frame`` for Gaussians on
        a body."""

        def colors(gaussians: Gaussians, cameras: Cameras, radii: Tensor) -> Tensor:
            views = [
                self._seen_from(gaussians, center, shown[:, 0] > 0, time, frame)
                for center, shown in zip(cameras.centers, radii, strict=True)
            ]
            return torch.stack(views) if views else gaussians.means.new_empty(0, len(gaussians), 3)

        return colors

    def _seen_from(
        self,
        gaussians: Gaussians,
        center: Tensor,
        drawn: Tensor,
        time: float | None,
        frame: RestFrame | None,
    ) -> Tensor:
        """Return (N, 3) colours seen from ``center``; zero, and not computed, for those that are
        not ``drawn`` (N,)."""
        rows = torch.nonzero(drawn)[:, 0]
        dtype = gaussians.means.dtype
        moment = min(max(0.0 if time is None else time, 0.0), 1.0)
        sight = Sight(
            gaussians.means,
            gaussians.quats,
            gaussians.log_scales,
            rows,
            center,
            self.box.to(dtype),
            None if frame is None else (frame.places.to(dtype), frame.turn.to(dtype)),
            moment if self.sees_time else None,
            self.sees_normals,
        )
        base = gaussians.base_rgb.index_select(0, rows)
        shown = (base + perceptron(shading_inputs(sight, base), self.layers).to(dtype)).clamp_min(0)
        return shown.new_zeros(len(gaussians), 3).index_copy(0, rows, shown)


def box_around(means: Tensor) -> Tensor:
    """Return (2, 3) centre and half sides of the box of ``means`` (N, 3) but their outer percent;
    no side is zero."""
    if not len(means):
        return torch.stack(
            [torch.zeros(3, device=means.device), torch.ones(3, device=means.device)]
        )
    ordered = means.detach().sort(dim=0).values
    last = len(ordered) - 1
    low = ordered[round(0.01 * last)]
    high = ordered[round(0.99 * last)]
    half_size = 0.5 * (high - low)
    return torch.stack(
        [0.5 * (low + high), half_size.clamp_min(max(1e-3 * float(half_size.max()), 1e-6))]
    )


def network_of(state: Mapping[str, Tensor]) -> ColourNetwork | None:
    """Return the network of a checkpoint, from the state of its colours; None where there is
    none."""
    count = sum(name.startswith("weight") for name in state)
    if not count:
        return None
    sees_time, sees_normals = (
        bool(x) for x in require_tensor("sees", state["sees"], (2,), torch.bool)
    )
    require_positive("box", require_tensor("box", state["box"], (2, 3), None)[1])
    layers = []
    width = num_inputs(sees_time=sees_time, sees_normals=sees_normals)
    for i in range(count):
        weight = require_tensor(
            f"weight{i}", state[f"weight{i}"], (3 if i == count - 1 else None, width), None
        )
        width = len(weight)
        layers.append(Layer(weight, require_tensor(f"bias{i}", state[f"bias{i}"], (width,), None)))
    return ColourNetwork(tuple(layers), state["box"], sees_time, sees_normals)


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
