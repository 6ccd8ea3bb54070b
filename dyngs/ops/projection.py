"""Projection of 3D Gaussians to image planes."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from dyngs.core.camera import Cameras
from dyngs.ops.native import num_threads
from dyngs.ops.registration import (
    Backward,
    Struct,
    call_core,
    check_memory,
    check_number,
    check_size,
    empty_like,
    register,
)


@dataclass(frozen=True)
class ProjectionOptions:
    """Options of the projection."""

    eps2d: float = 0.3  # low-pass variance added to the 2D covariance, px^2
    # Gaussians with a centre outside [near, far] are culled, world units.
    near: float = 0.2
    far: float = 1e10
    alpha_min: float = 1 / 255  # smallest rendered alpha; sets the extent of a splat
    radius_clip: float = 0.0  # splats with no larger half extent are culled, px
    antialiased: bool = False  # compute the extent from the compensated opacity

    def __post_init__(self) -> None:
        check_number("eps2d", self.eps2d, 0)
        check_number("near", self.near, 0)
        check_number("far", self.far, self.near, math.inf)
        check_number("alpha_min", self.alpha_min, 0, 1)
        check_number("radius_clip", self.radius_clip, 0)


@dataclass(frozen=True)
class Projection:
    """Splats of N Gaussians in V views; rows of culled Gaussians are zero."""

    means2d: Tensor  # (V, N, 2) px, centre of the first pixel at (0.5, 0.5)
    depths: Tensor  # (V, N) view-space z
    factors: Tensor  # (V, N, 3) entries U, W, V of F = [[U, W], [0, V]] with conic = F^T F, 1/px
    compensations: Tensor  # (V, N) sqrt of the determinant ratio before / after the low-pass
    radii: Tensor  # (V, N, 2) int32 half extents, px; 0 = culled

    @property
    def conics(self) -> Tensor:
        """(V, N, 3) inverse 2D covariances a, b, c: power = -(a dx^2 + 2 b dx dy + c dy^2) / 2."""
        u, w, v = self.factors.unbind(-1)
        return torch.stack([u * u, u * w, w * w + v * v], dim=-1)


def _settings(size: list[int], limits: list[float], antialiased: bool) -> Struct:
    check_size(*size)
    return Struct("ProjectSettings", (*size, *limits, antialiased, num_threads()))


def _arrays(*tensors: Tensor) -> Struct:
    return Struct(
        "GaussianArraysF32" if tensors[0].dtype == torch.float32 else "GaussianArraysF64", tensors
    )


def _project(
    means: Tensor,
    quats: Tensor,
    scales: Tensor,
    opacities: Tensor,
    viewmats: Tensor,
    intrinsics: Tensor,
    size: list[int],
    limits: list[float],
    antialiased: bool,
) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:
    rows = (viewmats.shape[0], means.shape[0])
    per_splat = 7 * means.element_size() + 8
    settings = _settings(size, limits, antialiased)
    what = f"the splats of {rows[1]} Gaussians in {rows[0]} view(s)"
    check_memory(rows[0] * rows[1] * per_splat, what, means)
    means2d = means.new_empty(*rows, 2)
    depths = means.new_empty(rows)
    factors = means.new_empty(*rows, 3)
    compensations = means.new_empty(rows)
    splats = means2d, depths, factors, compensations, means.new_empty(*rows, 2, dtype=torch.int32)
    arrays = _arrays(means, quats, scales, opacities, viewmats, intrinsics)
    call_core(means, "project_forward", arrays, settings, *splats)
    return splats


def _project_backward(x: Backward) -> Sequence[Tensor | None]:
    *gaussians, size, limits, antialiased = x.inputs
    means, quats, scales, _, *cameras = gaussians
    by_gaussians = [empty_like(y) for y in (means, quats, scales)]
    wanted = x.needs[3] or x.needs[4]
    by_cameras = [y.new_zeros(y.shape) if wanted else None for y in cameras]
    results = *by_gaussians, *by_cameras
    settings = _settings(size, limits, antialiased)
    given = _arrays(*gaussians), settings, *x.outputs, tuple(x.grads), results
    call_core(means, "project_backward", *given)
    return results


project_op = register(
    "project",
    _project,
    _project_backward,
    "means quats scales viewmats intrinsics",
    keeps=[4],
    constant=[4],
)


def project(
    means: Tensor,
    quats: Tensor,
    scales: Tensor,
    opacities: Tensor,
    cameras: Cameras,
    options: ProjectionOptions = ProjectionOptions(),
) -> Projection:
    """Project the Gaussians to splats in every camera (EWA splatting; Zwicker et al. 2001).

    Differentiable in means, quats, scales and cameras. ``quats`` (N, 4) wxyz of any norm, zero is
    the identity; ``scales`` (N, 3) standard deviations; ``opacities`` (N,) in [0, 1] only set the
    extents. Raises DyngsError for images with sides above 2^23 px, or splats that do not fit in
    memory.
    """
    check_size(cameras.width, cameras.height)  # before torch, which rejects integers from 2^63 on
    limits = [options.eps2d, options.near, options.far, options.alpha_min, options.radius_clip]
    outputs = project_op(
        means,
        quats,
        scales,
        opacities,
        cameras.cam_from_world,
        cameras.intrinsics,
        [cameras.width, cameras.height],
        limits,
        options.antialiased,
    )
    return Projection(*outputs)
