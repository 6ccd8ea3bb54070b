"""Reference versions of the native ops in plain torch, for the tests of the kernels.

Everything is dense: every pixel looks at every Gaussian. Meant for float64 and a few Gaussians on a
few pixels. Gradients come from autograd. Sources: Zwicker et al. 2001, Kerbl et al. 2023, Yu et al.
2024 (compensation).
"""

# pyright: reportUnknownMemberType=false, reportUnknownVariableType=false
# pyright: reportUnknownArgumentType=false
# The stubs of torch leave parts of these functions untyped.

from __future__ import annotations

from typing import Any, NamedTuple

import torch
from torch import Tensor

from dyngs.core.camera import Cameras
from dyngs.ops.harmonics import harmonics_basis
from dyngs.ops.projection import Projection, ProjectionOptions
from dyngs.ops.quaternions import rotation_matrices
from dyngs.ops.rasterization import BlendedImages, BlendOptions


def covariances2d(
    means: Tensor, quats: Tensor, scales: Tensor, cameras: Cameras
) -> tuple[Tensor, Tensor]:
    """Return 2D covariances (V, N, 2, 2) in px^2 without low-pass filter, and camera-space means
    (V, N, 3).
    """
    rotation = cameras.cam_from_world[:, :3, :3]
    translation = cameras.cam_from_world[:, :3, 3]
    centers = torch.einsum("vij,nj->vni", rotation, means) + translation[:, None]
    x, y, z = centers.unbind(-1)
    fx = cameras.intrinsics[:, 0, 0, None]
    fy = cameras.intrinsics[:, 1, 1, None]
    cx = cameras.intrinsics[:, 0, 2, None]
    cy = cameras.intrinsics[:, 1, 2, None]
    margin_x = 0.15 * cameras.width / fx
    margin_y = 0.15 * cameras.height / fy
    tan_x = torch.minimum(
        torch.maximum(x / z, -cx / fx - margin_x), (cameras.width - cx) / fx + margin_x
    )
    tan_y = torch.minimum(
        torch.maximum(y / z, -cy / fy - margin_y), (cameras.height - cy) / fy + margin_y
    )
    zero = torch.zeros_like(z)
    jacobian = torch.stack(
        [fx / z, zero, -fx * tan_x / z, zero, fy / z, -fy * tan_y / z], -1
    ).unflatten(-1, (2, 3))
    half = jacobian @ rotation[:, None] @ (rotation_matrices(quats) * scales[:, None, :])
    return half @ half.transpose(-1, -2), centers


def project(
    means: Tensor,
    quats: Tensor,
    scales: Tensor,
    opacities: Tensor,
    cameras: Cameras,
    options: ProjectionOptions = ProjectionOptions(),
) -> Projection:
    """Reference of ``dyngs.ops.projection.project``."""
    bare, centers = covariances2d(means, quats, scales, cameras)
    low_pass = options.eps2d * torch.eye(2, dtype=means.dtype, device=means.device)
    cov = bare + low_pass
    det = cov[..., 0, 0] * cov[..., 1, 1] - cov[..., 0, 1] ** 2
    bare_det = bare[..., 0, 0] * bare[..., 1, 1] - bare[..., 0, 1] ** 2
    compensation = (bare_det / det).clamp_min(0).sqrt()
    var_x = cov[..., 0, 0]
    var_y = cov[..., 1, 1]
    mixed = cov[..., 0, 1]
    factors = torch.stack([(var_y / det).sqrt(), -mixed / (var_y * det).sqrt(), var_y.rsqrt()], -1)
    x, y, z = centers.unbind(-1)
    means2d = torch.stack(
        [
            cameras.intrinsics[:, 0, 0, None] * x / z + cameras.intrinsics[:, 0, 2, None],
            cameras.intrinsics[:, 1, 1, None] * y / z + cameras.intrinsics[:, 1, 2, None],
        ],
        -1,
    )
    with torch.no_grad():
        shown = opacities * compensation if options.antialiased else opacities.expand_as(z)
        reach = (
            2 * (shown / options.alpha_min).log()
            if options.alpha_min > 0
            else torch.full_like(z, float("inf"))
        )
        extents = (
            (reach.clamp_min(0)[..., None] * torch.stack([var_x, var_y], -1))
            .sqrt()
            .ceil()
            .clamp_max(1e9)
        )
        size = torch.tensor([cameras.width, cameras.height], device=means.device)
        visible = (
            (z > options.near)
            & (z < options.far)
            & (reach > 0)
            & (extents > options.radius_clip).any(-1)
        )
        visible &= ((means2d + extents > 0) & (means2d - extents < size)).all(-1)
    keep = visible[..., None]
    return Projection(
        means2d=torch.where(keep, means2d, 0.0),
        depths=torch.where(visible, z, 0.0),
        factors=torch.where(keep, factors, 0.0),
        compensations=torch.where(visible, compensation, 0.0),
        radii=torch.where(keep, extents, 0.0).int(),
    )


def evaluate_harmonics(
    means: Tensor, centers: Tensor, sh: Tensor, radii: Tensor, degree: int
) -> Tensor:
    """Reference of ``dyngs.ops.harmonics.evaluate_harmonics``."""
    offsets = means[None] - centers[:, None]
    directions = offsets / offsets.norm(dim=-1, keepdim=True).clamp_min(1e-12)
    basis = harmonics_basis(directions, degree)
    colors = torch.einsum("vnk,nkc->vnc", basis, sh[:, : basis.shape[-1]]) + 0.5
    return torch.where((radii > 0).all(-1, keepdim=True), colors.clamp_min(0), 0.0)


def rasterize(
    projection: Projection,
    opacities: Tensor,
    colors: Tensor,
    size: tuple[int, int],
    *,
    background: Tensor | None = None,
    options: BlendOptions = BlendOptions(),
    weights: Tensor | None = None,
) -> BlendedImages:
    """Reference of ``dyngs.ops.rasterization.rasterize`` without probe: a loop over Gaussians.

    ``weights``: factors (V, N, H, W) of alpha.
    """
    raised = colors.new_zeros(*opacities.shape, size[1], size[0])
    return _rasterize(projection, opacities, colors, raised, background, options, weights)


def squared_slopes(
    projection: Projection,
    opacities: Tensor,
    colors: Tensor,
    size: tuple[int, int],
    *,
    background: Tensor | None = None,
    options: BlendOptions = BlendOptions(),
) -> Tensor:
    """Reference of ``dyngs.ops.rasterization.tally`` for ``SQUARED_SLOPES``: (V, N), by autograd
    per pixel.
    """
    raised = colors.new_zeros(*opacities.shape, size[1], size[0], requires_grad=True)
    image = _rasterize(
        projection, opacities.detach(), colors.detach(), raised, background, options
    ).color
    (slopes,) = torch.autograd.grad(image.sum(), raised)  # a pixel depends on its own values only
    return slopes.square().sum((2, 3))


def _rasterize(
    projection: Projection,
    opacities: Tensor,
    colors: Tensor,
    raised: Tensor,
    background: Tensor | None,
    options: BlendOptions,
    weights: Tensor | None = None,
) -> BlendedImages:
    """``rasterize`` with ``raised`` (V, N, H, W) added to the value of each 2D Gaussian per pixel."""
    height, width = raised.shape[2:]
    rows, columns = (
        torch.arange(n, dtype=colors.dtype, device=colors.device) + 0.5 for n in (height, width)
    )
    y, x = torch.meshgrid(rows, columns, indexing="ij")
    images: list[Tensor] = []
    remains: list[Tensor] = []
    for v in range(len(opacities)):
        transmittance = colors.new_ones(height, width)
        image = colors.new_zeros(height, width, colors.shape[-1])
        full = colors.new_zeros(height, width, dtype=torch.bool)
        visible = torch.nonzero((projection.radii[v] > 0).all(-1))[:, 0]
        for i in visible[projection.depths[v, visible].argsort(stable=True)]:
            u_x, u_y, v_y = projection.factors[v, i]
            dx = projection.means2d[v, i, 0] - x
            dy = projection.means2d[v, i, 1] - y
            power = -0.5 * ((u_x * dx + u_y * dy) ** 2 + (v_y * dy) ** 2)
            alpha = opacities[v, i] * (power.exp() + raised[v, i])
            if weights is not None:
                alpha = alpha * weights[v, i]
            alpha = alpha.clamp_max(options.alpha_max)
            alpha = torch.where((alpha >= options.alpha_min) & ~full, alpha, 0.0)
            after = transmittance * (1 - alpha)
            full = full | ((after < options.transmittance_min) & (alpha > 0))
            alpha = torch.where(full, 0.0, alpha)
            image = image + (alpha * transmittance)[..., None] * colors[v, i]
            transmittance = transmittance * (1 - alpha)
        if background is not None:
            image = image + transmittance[..., None] * background[v]
        images.append(image)
        remains.append(transmittance)
    return BlendedImages(torch.stack(images), torch.stack(remains))


class Sight(NamedTuple):
    """Arguments of ``dyngs.ops.shading.shading_inputs`` after ``base``."""

    means: Tensor
    quats: Tensor
    log_scales: Tensor
    rows: Tensor
    eye: Tensor
    box: Tensor
    rest: Tensor | None = None
    turn: Tensor | None = None
    time: float | None = None
    normals: bool = True


def shading_inputs(base: Tensor, *arguments: Any) -> Tensor:
    """Reference of ``dyngs.ops.shading.shading_inputs``.

    Contracted position in the box, view direction, |cosine| between the shortest axis and the view
    direction, reflected direction, base colour less 1/2, and time in [-1, 1]. Bodies use
    positions, directions and normals of the rest pose.
    """
    sight = Sight(*arguments)
    means = sight.means[sight.rows]
    directions = torch.nn.functional.normalize(means - sight.eye, dim=1)
    normals = shortest_axes(sight.quats[sight.rows], sight.log_scales[sight.rows])
    places = means
    if sight.rest is not None and sight.turn is not None:
        places = sight.rest[sight.rows]
        directions = directions @ sight.turn
        normals = normals @ sight.turn
    center, half_size = sight.box
    inputs = [contracted((places - center) / half_size), directions]
    if sight.normals:
        cosine = (normals * directions).sum(1, keepdim=True)
        inputs += [cosine.abs(), directions - 2 * cosine * normals]
    inputs.append(base - 0.5)
    if sight.time is not None:
        inputs.append(torch.full_like(base[:, :1], 2 * sight.time - 1))
    return torch.cat(inputs, dim=1)


def contracted(points: Tensor) -> Tensor:
    """Return ``points`` (M, 3) contracted into a ball of radius 2; the unit ball is unchanged.

    (2 - 1 / |x|) x / |x| (Barron et al. 2022, mip-NeRF 360) bounds distant points.
    """
    length = points.norm(dim=1, keepdim=True).clamp_min(1)
    return points * (2 - 1 / length) / length


def shortest_axes(quats: Tensor, log_scales: Tensor) -> Tensor:
    """Return (M, 3) unit vectors along the shortest axes: normals of flat Gaussians up to sign."""
    shortest = log_scales.argmin(dim=1)
    return rotation_matrices(quats).gather(2, shortest[:, None, None].expand(-1, 3, 1))[..., 0]
