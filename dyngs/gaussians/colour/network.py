"""Colour networks, and affine colour changes by exposure and white balance."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import torch
from torch import Tensor

from dyngs.core.camera import Cameras
from dyngs.core.conventions import num_sh_terms
from dyngs.core.state import Role, State, with_role
from dyngs.core.tensor_checks import require_positive, require_tensor
from dyngs.data.loader import Image
from dyngs.gaussians import Gaussians
from dyngs.gaussians.rendering import Shader
from dyngs.models.renderable import Rendering
from dyngs.ops.harmonics import harmonics_basis
from dyngs.ops.perceptron import Layer, perceptron
from dyngs.ops.shading import num_inputs, shading_inputs

SATURATED = 254.5 / 255  # A channel this bright may have been any brighter
GAIN_RIDGE, MIXING_RIDGE = 1e-5, 1e-2
"""Weights of squared deviations from the identity, of gains and of all else, against the mean
squared error.

They decide what the pixels do not: the channels of most images are so alike that mixtures of them
can mean anything. With 3e-4 for the latter, halves of the cup in docs/benchmarks.md had 2 dB less
after the fit than before it.
"""
# Fits in turn, each without the saturated channels that the one before shows brighter still
ROUNDS = 3

Shown = tuple[Image, Rendering]  # An image, and the rendering of its one view


def apply_affine_colour(
    affine: Tensor, image: Image, rendering: Rendering, background: Tensor
) -> Tensor:
    """Return (H, W, 3) a rendering as the camera of ``image`` would have made it.

    Where the image has alpha, the background was not in front of the camera and keeps its colour.

    Args:
        affine: (3, 4) M.
    """
    rgb = rendering.rgb[0]
    background = background.to(rgb.device)
    affine = affine.to(rgb.device)
    matrix = affine[:, :3]
    offset = affine[:, 3]
    if image.alpha is None:
        return torch.addmm(offset, rgb.reshape(-1, 3), matrix.T).reshape(rgb.shape)
    through = rendering.transmittance[0][..., None]
    behind = through * background
    shown = torch.addmm(
        offset - offset * through.reshape(-1, 1), (rgb - behind).reshape(-1, 3), matrix.T
    )
    return shown.reshape(rgb.shape) + behind


@torch.no_grad()
def fit_affine_colour(
    shown: Sequence[Shown], background: Tensor, counts: Tensor | None = None
) -> Tensor:
    """Return (3, 4) M, one for all, that brings renderings closest to their images: least squares
    in float64.

    Args:
        shown: one or more; masked pixels do not count.
        counts: (H, W) weights next to the masks; None: 1.
    """
    background = background.to(shown[0][1].rgb.device)
    identity = torch.eye(3, 4, dtype=torch.float64, device=background.device)
    affine = identity
    sums = [_sums(image, rendering, background, counts) for image, rendering in shown]
    is_gain = torch.nn.functional.pad(identity[:, :3], (0, 1))
    total = torch.stack([one.weight for one in sums]).sum()
    ridge = total.clamp_min(1) * torch.diag_embed(
        MIXING_RIDGE + (GAIN_RIDGE - MIXING_RIDGE) * is_gain
    )
    left_out: list[Tensor] = []
    for _ in range(ROUNDS):
        before = left_out
        left_out = [
            one.edge_weight * (one.saturated & (one.edge[:, :4] @ affine.T > 1)) for one in sums
        ]
        if before and all(torch.equal(x, y) for x, y in zip(left_out, before, strict=True)):
            break  # the same equations again
        products = torch.stack([one.products for one in sums]).sum(0).expand(3, 4, 7)
        for one, weights in zip(sums, left_out, strict=True):
            products = products - torch.einsum("pi,pc,pj->cij", one.edge[:, :4], weights, one.edge)
        sides = products[:, :, 4:].diagonal(dim1=0, dim2=2).T
        affine = identity + torch.linalg.solve(products[..., :4] + ridge, sides)
    return affine.float()


class _Sums(NamedTuple):
    """Sums over the pixels of an image, float64, and the B of its pixels that have a saturated
    channel.

    Rows of seven numbers: the four that M is applied to, and what should come out less the first
    three of them.
    """

    weight: Tensor  # () of all pixels
    products: Tensor  # (4, 7) weighted products of the four with all
    edge: Tensor  # (B, 7) rows of the saturated
    edge_weight: Tensor  # (B, 1)
    saturated: Tensor  # (B, 3) bool, which channels are


def _sums(image: Image, rendering: Rendering, background: Tensor, counts: Tensor | None) -> _Sums:
    """Return the sums of the pixels that count."""
    rgb = rendering.rgb[0]
    truth = image.composite(background)
    ones = torch.ones_like(rgb[..., :1])
    through = rendering.transmittance[0][..., None]
    if image.alpha is not None:
        rgb = rgb - through * background
        truth = truth - through * background
        ones = 1 - through
    weight = ones.new_ones(()) if image.mask is None else image.mask
    weight = (weight if counts is None else weight * counts).expand(ones.shape[:2]).reshape(-1, 1)
    rows = torch.cat([rgb, ones, truth], -1).reshape(-1, 7)
    if image.mask is not None or counts is not None:
        counted = torch.nonzero(weight[:, 0] > 0)[:, 0]
        rows = rows[counted]
        weight = weight[counted]
    saturated = rows[:, 4:] >= SATURATED
    rows = rows.double()
    weight = weight.double()
    rows[:, 4:] -= rows[:, :3]
    edge = torch.nonzero(saturated.any(1))[:, 0]
    return _Sums(
        weight.sum(), (weight * rows[:, :4]).T @ rows, rows[edge], weight[edge], saturated[edge]
    )


@dataclass(frozen=True)
class RestPose:
    """Rest pose of a moving body, which its colours follow."""

    means: Tensor  # (N, 3) centres of the drawn Gaussians at rest
    rotation: Tensor  # (3, 3) rotation of the body from rest to the world


@dataclass(frozen=True)
class ColourNetwork:
    """F: what is added to the base colour of a Gaussian, by place, direction, normal and time."""

    layers: tuple[Layer, ...]
    box: Tensor  # (2, 3) centre and half sides of the scene, world units
    uses_time: bool
    # the cosine between the shortest axis of the Gaussian and the direction, and the direction
    # mirrored at that axis, are inputs
    uses_normals: bool

    @property
    def num_values(self) -> int:
        return self.box.numel() + sum(
            layer.weight.numel() + layer.bias.numel() for layer in self.layers
        )

    def state(self) -> State:
        tensors = {
            "box": self.box,
            "sees": torch.tensor([self.uses_time, self.uses_normals], device="cpu"),
        }
        for i, layer in enumerate(self.layers):
            tensors |= {f"weight{i}": layer.weight.detach(), f"bias{i}": layer.bias.detach()}
        return with_role(tensors, Role.SHARED)

    def shader(self, time: float | None, rest_pose: RestPose | None = None) -> Shader:
        """Return the shader at ``time`` (clamped to [0, 1], None is 0); ``frame`` for Gaussians on
        a body."""

        def colors(gaussians: Gaussians, cameras: Cameras, radii: Tensor) -> Tensor:
            views = [
                self._seen_from(gaussians, center, shown[:, 0] > 0, time, rest_pose)
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
        rest_pose: RestPose | None,
    ) -> Tensor:
        """Return (N, 3) colours seen from ``center``; zero, and not computed, for those that are
        not ``drawn`` (N,)."""
        rows = torch.nonzero(drawn)[:, 0]
        dtype = gaussians.means.dtype
        moment = min(max(0.0 if time is None else time, 0.0), 1.0)
        base = gaussians.base_rgb.index_select(0, rows)
        inputs = shading_inputs(
            base,
            gaussians.means,
            gaussians.quats,
            gaussians.log_scales,
            rows,
            center,
            self.box.to(dtype),
            None if rest_pose is None else rest_pose.means.to(dtype),
            None if rest_pose is None else rest_pose.rotation.to(dtype),
            moment if self.uses_time else None,
            self.uses_normals,
        )
        shown = (base + perceptron(inputs, self.layers).to(dtype)).clamp_min(0)
        return shown.new_zeros(len(gaussians), 3).index_copy(0, rows, shown)


def robust_bounding_box(means: Tensor) -> Tensor:
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


def restore_colour_network(state: Mapping[str, Tensor]) -> ColourNetwork | None:
    """Return the network of a checkpoint, from the state of its colours; None where there is
    none."""
    count = sum(name.startswith("weight") for name in state)
    if not count:
        return None
    uses_time, uses_normals = (
        bool(x) for x in require_tensor("sees", state["sees"], (2,), torch.bool)
    )
    require_positive("box", require_tensor("box", state["box"], (2, 3), None)[1])
    layers = []
    width = num_inputs(uses_time=uses_time, uses_normals=uses_normals)
    for i in range(count):
        weight = require_tensor(
            f"weight{i}", state[f"weight{i}"], (3 if i == count - 1 else None, width), None
        )
        width = len(weight)
        layers.append(Layer(weight, require_tensor(f"bias{i}", state[f"bias{i}"], (width,), None)))
    return ColourNetwork(tuple(layers), state["box"], uses_time, uses_normals)


DIRECTIONS = 96  # Number of directions from which colours are sampled; degree 3 has 16 terms

_FAR = 1e4  # Distance of the camera, in largest distances of a Gaussian from the origin


@dataclass(frozen=True)
class BakedHarmonics:
    """Gaussians with harmonics, and the root mean squared error of their colours over all
    directions."""

    gaussians: Gaussians
    error: float


@torch.no_grad()
def bake_harmonics(gaussians: Gaussians, shader: Shader, degree: int = 3) -> BakedHarmonics:
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
    return BakedHarmonics(gaussians.replace(sh=sh), error)


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
