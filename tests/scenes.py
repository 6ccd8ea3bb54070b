"""Small random scenes, and the three ops in a row, native or reference, for the tests of the
rasterizer."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace

import reference
import torch
from torch import Tensor

from dyngs.core.camera import Cameras
from dyngs.gaussians import Gaussians
from dyngs.ops import harmonics, projection, rasterization
from dyngs.ops.projection import Projection, ProjectionOptions
from dyngs.ops.rasterization import BlendedImages, BlendOptions


@dataclass(frozen=True)
class Limits:
    """The options of the projection and of the blending."""

    projecting: ProjectionOptions
    blending: BlendOptions


USUAL = Limits(ProjectionOptions(), BlendOptions())
EXACT = Limits(ProjectionOptions(alpha_min=0.0), BlendOptions(alpha_min=0.0, transmittance_min=0.0))
"""No threshold that a rounding error could cross: every pixel sees every Gaussian."""


@dataclass(frozen=True)
class Scene:
    """N Gaussians after their activations, V cameras, one background per view."""

    means: Tensor
    quats: Tensor
    scales: Tensor
    opacities: Tensor
    sh: Tensor
    cam_from_world: Tensor
    intrinsics: Tensor
    background: Tensor
    width: int
    height: int

    @property
    def cameras(self) -> Cameras:
        return Cameras(self.cam_from_world, self.intrinsics, self.width, self.height)

    @property
    def size(self) -> tuple[int, int]:
        return self.width, self.height

    @property
    def degree(self) -> int:
        return math.isqrt(self.sh.shape[1]) - 1

    @property
    def gaussians(self) -> Gaussians:
        return Gaussians(self.means, self.quats, self.scales.log(), self.opacities.logit(), self.sh)

    def tensors(self) -> dict[str, Tensor]:
        return {name: x for name, x in vars(self).items() if isinstance(x, Tensor)}

    def map(self, f: Callable[[Tensor], Tensor]) -> Scene:
        return replace(self, **{name: f(x) for name, x in self.tensors().items()})

    def to(self, dtype: torch.dtype) -> Scene:
        return self.map(lambda x: x.to(dtype))

    def leaves(self) -> Scene:
        """Copies that collect gradients."""
        return self.map(lambda x: x.detach().clone().requires_grad_())

    def view(self, index: int) -> Scene:
        picked = {
            k: getattr(self, k)[index : index + 1]
            for k in ("cam_from_world", "intrinsics", "background")
        }
        return replace(self, **picked)


def look_around(views: int, dtype: torch.dtype = torch.float64) -> Tensor:
    """(V, 4, 4) cameras 3 units from the origin, turned by 0.3 rad from one to the next."""
    poses = torch.eye(4, dtype=dtype).repeat(views, 1, 1)
    for v in range(views):
        c = math.cos(0.3 * v)
        s = math.sin(0.3 * v)
        poses[v, :3, :3] = torch.tensor([[c, 0, s], [0, 1, 0], [-s, 0, c]], dtype=dtype)
    poses[:, :3, 3] = torch.tensor([0.1, 0.0, 3.0], dtype=dtype)
    return poses


def random_scene(
    n: int = 20, views: int = 2, size: tuple[int, int] = (37, 29), seed: int = 0, degree: int = 1
) -> Scene:
    """Gaussians of 1 to 10 px around the origin, float64; no dimension of the image is a multiple
    of the tile."""
    g = torch.Generator().manual_seed(seed)
    width, height = size

    def uniform(*shape: int) -> Tensor:
        return torch.rand(shape, generator=g, dtype=torch.float64)

    def normal(*shape: int) -> Tensor:
        return torch.randn(shape, generator=g, dtype=torch.float64)

    focal = 0.8 * max(width, height)
    intrinsics = torch.tensor(
        [[focal, 0, width / 2 + 1], [0, 1.1 * focal, height / 2 - 1], [0, 0, 1]]
    )
    return Scene(
        means=0.7 * normal(n, 3),
        quats=normal(n, 4),
        scales=0.3 * uniform(n, 3) + 0.02,
        opacities=0.9 * uniform(n) + 0.05,
        sh=0.2 * normal(n, (degree + 1) ** 2, 3),
        cam_from_world=look_around(views),
        intrinsics=intrinsics.double().repeat(views, 1, 1),
        background=uniform(views, 3),
        width=width,
        height=height,
    )


@dataclass(frozen=True)
class Ops:
    """One implementation of the three ops."""

    project: Callable[..., Projection]
    evaluate_harmonics: Callable[..., Tensor]
    rasterize: Callable[..., BlendedImages]


NATIVE = Ops(projection.project, harmonics.evaluate_harmonics, rasterization.rasterize)
REFERENCE = Ops(reference.project, reference.evaluate_harmonics, reference.rasterize)


@dataclass(frozen=True)
class Drawn:
    projection: Projection
    colors: Tensor
    blended: BlendedImages


def draw(scene: Scene, ops: Ops = NATIVE, limits: Limits = USUAL) -> Drawn:
    """The scene through all three ops, opacities compensated in antialiased mode."""
    p = ops.project(
        scene.means, scene.quats, scene.scales, scene.opacities, scene.cameras, limits.projecting
    )
    colors = ops.evaluate_harmonics(
        scene.means, scene.cameras.centers, scene.sh, p.radii, scene.degree
    )
    opacities = scene.opacities.expand_as(p.depths)
    if limits.projecting.antialiased:
        opacities = opacities * p.compensations
    blended = ops.rasterize(
        p, opacities, colors, scene.size, background=scene.background, options=limits.blending
    )
    return Drawn(p, colors, blended)


def weights(x: Tensor) -> Tensor:
    """Fixed numbers in [-1, 1], one per element, all different."""
    return torch.sin(torch.arange(1, x.numel() + 1, dtype=torch.float64)).view(x.shape).to(x.dtype)


def loss(drawn: Drawn) -> Tensor:
    """A scalar in which every output takes part."""
    outputs = (drawn.blended.color, drawn.blended.transmittance, 0.01 * drawn.projection.depths)
    return torch.stack([(x * weights(x)).sum() for x in outputs]).sum()


def gradients(scene: Scene, ops: Ops = NATIVE, limits: Limits = USUAL) -> dict[str, Tensor]:
    """Of the loss of ``draw`` with respect to every tensor of the scene but the intrinsics."""
    leaves = scene.leaves()
    inputs = {name: x for name, x in leaves.tensors().items() if x.requires_grad}
    found = torch.autograd.grad(loss(draw(leaves, ops, limits)), list(inputs.values()))
    return dict(zip(inputs, found, strict=True))


def relative_error(x: Tensor, truth: Tensor) -> float:
    """Largest difference, relative to the largest value."""
    if truth.numel() == 0:
        return 0.0
    return float(
        (x.double() - truth.double()).abs().max() / truth.double().abs().max().clamp_min(1e-300)
    )
