"""Colours from three base values per Gaussian and one small network for all of them (MEGA, Zhang et
al. 2024).

MEGA draws sigmoid(c_dc + F(mu, d, t, c_dc)) with F a perceptron, d the unit direction from the
camera to the centre mu. Here F is added to the base colour of the harmonics before their clamp,
max(0, rgb + F(...)): so files that hold the base colours alone stay right, and a network whose last
layer is zero changes nothing. Gradients of F by mu and d are stopped, so that colours do not move
Gaussians.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import torch
from torch import Tensor

from dyngs.core.camera import Cameras
from dyngs.core.state import Role, State, with_role
from dyngs.core.tensor_checks import require_positive, require_tensor
from dyngs.gaussians import Gaussians
from dyngs.gaussians.rendering import Shader
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
