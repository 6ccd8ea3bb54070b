"""Colour networks, baking into spherical harmonics, and affine colour correction of renderings."""

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

SATURATED = 254.5 / 255  # a channel of at least this value may be clipped
GAIN_RIDGE, MIXING_RIDGE = 1e-5, 1e-2
"""Ridge weights of the affine fit: on the gains (diagonal), and on all other entries.

Both pull towards the identity, relative to the mean squared error. The channels of most images are
highly correlated, so that pixels alone do not determine the mixing of channels.
"""
# Passes of the affine fit; each leaves out the clipped channels that the previous one predicts
# above 1.
ROUNDS = 3

Shown = tuple[Image, Rendering]  # an image and the rendering of its only view


def apply_affine_colour(
    affine: Tensor, image: Image, rendering: Rendering, background: Tensor
) -> Tensor:
    """Return the rendering (H, W, 3) with the affine colour transform of its camera applied.

    Where the image has alpha, the background is not transformed.

    Args:
        affine: (3, 4) matrix on (r, g, b, 1).
    """
    rgb = rendering.rgb[0]
    background = background.to(rgb.device)
    affine = affine.to(rgb.device)
    matrix = affine[:, :3]
    offset = affine[:, 3]
    through = rgb.new_zeros(()) if image.alpha is None else rendering.transmittance[0][..., None]
    behind = through * background
    shown = torch.addmm(
        offset - offset * through.reshape(-1, 1), (rgb - behind).reshape(-1, 3), matrix.T
    )
    return shown.reshape(rgb.shape) + behind


@torch.no_grad()
def fit_affine_colour(
    shown: Sequence[Shown], background: Tensor, counts: Tensor | None = None
) -> Tensor:
    """Fit one affine colour transform (3, 4) that maps renderings to their images.

    Least squares in float64 with a ridge towards the identity.

    Args:
        shown: one or more images with their renderings; masked pixels are ignored.
        counts: (H, W) pixel weights on top of the masks; None: 1.
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
    for _ in range(ROUNDS):
        left_out = [
            one.edge_weight * (one.saturated & (one.edge[:, :4] @ affine.T > 1)) for one in sums
        ]
        products = torch.stack([one.products for one in sums]).sum(0).expand(3, 4, 7)
        for one, weights in zip(sums, left_out, strict=True):
            products = products - torch.einsum("pi,pc,pj->cij", one.edge[:, :4], weights, one.edge)
        sides = products[:, :, 4:].diagonal(dim1=0, dim2=2).T
        affine = identity + torch.linalg.solve(products[..., :4] + ridge, sides)
    return affine.float()


class _Sums(NamedTuple):
    """Normal equations of one image in float64, and its B pixels with a clipped channel.

    A row has seven numbers: the input (r, g, b, 1) and the target residual (truth minus input).
    """

    weight: Tensor  # () sum of the pixel weights
    products: Tensor  # (4, 7) weighted products of the input with the row
    edge: Tensor  # (B, 7) rows of the pixels with a clipped channel
    edge_weight: Tensor  # (B, 1)
    saturated: Tensor  # (B, 3) bool, clipped channels


def _sums(image: Image, rendering: Rendering, background: Tensor, counts: Tensor | None) -> _Sums:
    """Accumulate the normal equations over the unmasked pixels."""
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
    """Rest pose of a moving body; the colour network is evaluated in it."""

    means: Tensor  # (N, 3) means in the rest pose
    rotation: Tensor  # (3, 3) rotation of the body, world from rest


@dataclass(frozen=True)
class ColourNetwork:
    """A network that adds to each Gaussian's base colour, given position, direction, normal and
    time."""

    layers: tuple[Layer, ...]
    box: Tensor  # (2, 3) centre and half sides of the scene, world units
    uses_time: bool
    # The normal is the shortest axis of the Gaussian. Its cosine with the view direction and the
    # mirrored direction are inputs.
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
        """Return the shader at ``time`` (clamped to [0, 1], None is 0).

        ``rest_pose``: pose of the body that carries the Gaussians, if any.
        """

        def colors(gaussians: Gaussians, cameras: Cameras, radii: Tensor) -> Tensor:
            views = [
                self._colours_from(gaussians, center, shown[:, 0] > 0, time, rest_pose)
                for center, shown in zip(cameras.centers, radii, strict=True)
            ]
            return torch.stack(views) if views else gaussians.means.new_empty(0, len(gaussians), 3)

        return colors

    def _colours_from(
        self,
        gaussians: Gaussians,
        center: Tensor,
        drawn: Tensor,
        time: float | None,
        rest_pose: RestPose | None,
    ) -> Tensor:
        """Return colours (N, 3) seen from ``center``; zero in rows not in ``drawn`` (N,)."""
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
    """Return (2, 3) centre and half sizes of the box of the central 98 % of ``means`` (N, 3).

    No half size is zero.
    """
    if not len(means):
        return torch.tensor([[0.0] * 3, [1.0] * 3], device=means.device)
    ordered = means.detach().sort(dim=0).values
    last = len(ordered) - 1
    low = ordered[round(0.01 * last)]
    high = ordered[round(0.99 * last)]
    half_size = 0.5 * (high - low)
    return torch.stack(
        [0.5 * (low + high), half_size.clamp_min(max(1e-3 * float(half_size.max()), 1e-6))]
    )


def restore_colour_network(state: Mapping[str, Tensor]) -> ColourNetwork | None:
    """Return the colour network in a state, or None if the state has none."""
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


DIRECTIONS = 96  # sampled directions; degree 3 has 16 terms

_FAR = 1e4  # camera distance, in units of the largest distance of a Gaussian from the origin


@dataclass(frozen=True)
class BakedHarmonics:
    """Gaussians with SH coefficients, and the RMS colour error of the fit over all directions."""

    gaussians: Gaussians
    error: float


@torch.no_grad()
def bake_harmonics(gaussians: Gaussians, shader: Shader, degree: int = 3) -> BakedHarmonics:
    """Bake the colours of ``shader`` into SH coefficients of ``degree``.

    Least squares over directions that cover the whole sphere, including those without training
    views.
    """
    directions = fibonacci_sphere(DIRECTIONS).to(gaussians.means.dtype)
    basis = harmonics_basis(directions, degree)
    solver = torch.linalg.pinv(basis)
    shown = torch.ones(1, len(gaussians), 2, dtype=torch.int32, device=gaussians.means.device)
    far = _FAR * max(1.0, float(gaussians.means.abs().max())) if len(gaussians) else 1.0
    sh = gaussians.sh.new_zeros(len(gaussians), num_sh_terms(degree), 3)
    squares = 0.0
    for weights, direction in zip(solver.T, directions, strict=True):
        colors = shader(gaussians, _camera_at(-far * direction), shown)[0] - 0.5
        sh += weights[:, None] * colors[:, None]
        squares += float(colors.double().square().sum())
    # The residual of least squares is orthogonal to the fitted part.
    explained = torch.einsum("nkc,kl,nlc->", sh.double(), (basis.T @ basis).double(), sh.double())
    error = math.sqrt(
        max(squares - float(explained), 0.0) / max(3 * DIRECTIONS * len(gaussians), 1)
    )
    return BakedHarmonics(gaussians.replace(sh=sh), error)


def fibonacci_sphere(count: int) -> Tensor:
    """Return (count, 3) evenly spread unit vectors: a Fibonacci lattice."""
    z = 1 - (2 * torch.arange(count, dtype=torch.float64, device="cpu") + 1) / count
    angle = math.pi * (3 - math.sqrt(5)) * torch.arange(count, dtype=torch.float64, device="cpu")
    radius = (1 - z * z).sqrt()
    return torch.stack([radius * angle.cos(), radius * angle.sin(), z], dim=1)


def _camera_at(center: Tensor) -> Cameras:
    pose = torch.eye(4, dtype=center.dtype, device=center.device)
    pose[:3, 3] = -center
    return Cameras(pose[None], torch.eye(3, dtype=center.dtype, device=center.device)[None], 1, 1)
