"""Texels of a body template's texture atlas as points of its surface.

Local letters: T triangles, U vertices of the atlas, P texels.
"""

from __future__ import annotations

from dataclasses import dataclass, fields

import numpy as np
import torch
from torch import Tensor

from dyngs.core.errors import DyngsError
from dyngs.human.body.body import BodyTemplate
from dyngs.human.body.mesh import grid_points, span

# twice the area over the square of the longest edge at which a triangle counts as degenerate
_THINNEST = 1e-9


@dataclass(frozen=True)
class Texels:
    """Surface attributes at rest of the P covered texels of an atlas, in row-major order of the
    atlas."""

    # S, texels per side. The centre of row r, column c lies at u = (c + 0.5) / S, v = 1 - (r + 0.5)
    # / S.
    resolution: int
    index: Tensor  # (P,) int64, r * S + c, ascending
    faces: Tensor  # (P,) int64 triangle of the template that covers the texel's centre
    # (P, 3) coordinates of the centre in that triangle, in [0, 1], rows sum to 1
    barycentric: Tensor
    points: Tensor  # (P, 3) on the surface at rest, m
    # (P, 3, 3) rotations; columns are the tangent (along increasing u), the bitangent and the
    # outward normal, smooth over edges. In mirrored parts of an atlas the bitangent points along
    # decreasing v.
    frames: Tensor
    weights: Tensor  # (P, J) skinning weights, rows sum to 1
    # (P,) side of the texel on the surface, m: sqrt(area of the triangle / its area in the atlas) /
    # S
    size: Tensor

    def __len__(self) -> int:
        return len(self.index)

    def select(self, index: Tensor) -> Texels:
        """Return the texels at ``index`` (long, ascending, or bool)."""
        rows = {
            field.name: getattr(self, field.name)[index]
            for field in fields(self)
            if field.name != "resolution"
        }
        return Texels(resolution=self.resolution, **rows)

    @property
    def normals(self) -> Tensor:
        """Outward unit normals (P, 3)."""
        return self.frames[..., 2]


def atlas_texels(body: BodyTemplate, resolution: int, vertices: Tensor | None = None) -> Texels:
    """Return the texels whose centres the atlas of ``body`` covers; of overlapping triangles the
    first one wins.

    Triangles that are degenerate in the atlas or on the surface cover nothing. Not differentiable.
    ``resolution`` is S, texels per side; ``vertices`` (M, 3) the rest shape, m, None for that of
    the template. Raises DyngsError: no texture coordinates, a resolution below 1, or ``vertices``
    of a wrong shape or not finite.
    """
    if body.uv is None or body.uv_faces is None:
        raise DyngsError(
            f"the body template '{body.name}' has no texture coordinates; give one with a texture atlas"
        )
    if resolution < 1:
        raise DyngsError(
            f"the resolution of the texture atlas must be at least 1, got {resolution}"
        )
    rest = body.vertices if vertices is None else vertices
    if rest.shape != body.vertices.shape or not bool(rest.isfinite().all()):
        raise DyngsError(
            f"the rest shape must be {tuple(body.vertices.shape)} finite numbers, got {tuple(rest.shape)}; check the "
            "vertices and shape coefficients for NaN"
        )
    rest = rest.detach().double()
    corners = rest[body.faces]
    corners_uv = torch.nn.functional.pad(body.uv.detach().double()[body.uv_faces], (0, 1))
    area = _areas(corners)
    area_uv = _areas(corners_uv)
    usable = (area > 0) & (area_uv > 0)
    index, faces, barycentric = _rasterized(corners_uv, usable, resolution)
    around = body.faces[faces]
    dtype = body.vertices.dtype
    smooth = _interpolated(barycentric, around, _vertex_normals(rest, body.faces))
    normals = _unit_or(smooth, _unit_or(_cross(corners), corners.new_zeros(3))[faces])
    return Texels(
        resolution=resolution,
        index=index,
        faces=faces,
        barycentric=barycentric.to(dtype),
        points=_interpolated(barycentric, around, rest).to(dtype),
        frames=_frames(normals, _along_u(corners, corners_uv)[faces]).to(dtype),
        weights=_interpolated(barycentric.to(body.weights), around, body.weights.detach()),
        size=((area / area_uv)[faces].sqrt() / resolution).to(dtype),
    )


def _rasterized(
    corners_uv: Tensor, usable: Tensor, resolution: int
) -> tuple[Tensor, Tensor, Tensor]:
    """Return the covered texels (P,), ascending, their triangles (P,) and barycentric coordinates
    (P, 3).

    Exact along shared edges: both triangles compute an edge's sign from its ends in the same order.
    ``corners_uv`` are (T, 3, 2 or 3), ``usable`` (T,) says which triangles may cover texels.
    """
    corners = corners_uv.cpu().numpy()
    triangles = np.flatnonzero(usable.cpu().numpy())
    x = corners[triangles, :, 0] * resolution - 0.5
    y = (1 - corners[triangles, :, 1]) * resolution - 0.5
    left, across = span(x.T, resolution)
    top, down = span(y.T, resolution)
    owner, column, row = grid_points(across * down, left, top, across)
    turn = np.sign(
        (x[:, 1] - x[:, 0]) * (y[:, 2] - y[:, 0]) - (y[:, 1] - y[:, 0]) * (x[:, 2] - x[:, 0])
    )
    sides = np.empty((len(owner), 3))
    for k, (i, j) in enumerate(((1, 2), (2, 0), (0, 1))):
        swap = (x[:, j] < x[:, i]) | ((x[:, j] == x[:, i]) & (y[:, j] < y[:, i]))
        ax = np.where(swap, x[:, j], x[:, i])
        ay = np.where(swap, y[:, j], y[:, i])
        dx = np.where(swap, x[:, i], x[:, j]) - ax
        dy = np.where(swap, y[:, i], y[:, j]) - ay
        sign = np.where(swap, -turn, turn)
        sides[:, k] = sign[owner] * (
            dx[owner] * (row - ay[owner]) - dy[owner] * (column - ax[owner])
        )
    inside = (sides >= 0).all(1)
    texels, first = np.unique((row * resolution + column)[inside], return_index=True)
    barycentric = sides[inside][first]
    barycentric /= barycentric.sum(1, keepdims=True)
    found = (texels.astype(np.int64), triangles[owner[inside][first]].astype(np.int64), barycentric)
    index, faces, coordinates = (torch.from_numpy(x).to(corners_uv.device) for x in found)
    return index, faces, coordinates


def _interpolated(barycentric: Tensor, around: Tensor, values: Tensor) -> Tensor:
    """Return values (P, D) interpolated between the vertices ``around`` (P, 3) of ``values`` (M,
    D)."""
    total = barycentric[:, :1] * values[around[:, 0]]
    for k in (1, 2):
        total.addcmul_(barycentric[:, k, None], values[around[:, k]])
    return total


def _cross(corners: Tensor) -> Tensor:
    """Return the normals (T, 3) of triangles (T, 3, 3), with twice their area as length."""
    return torch.linalg.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0], dim=-1)


def _areas(corners: Tensor) -> Tensor:
    """Return the areas (T,) of triangles (T, 3, 3); zero where degenerate or not finite."""
    double = _cross(corners).norm(dim=-1)
    longest = (corners.roll(-1, 1) - corners).square().sum(-1).amax(-1)
    return torch.where(double > _THINNEST * longest, 0.5 * double, 0.0)


def _vertex_normals(vertices: Tensor, faces: Tensor) -> Tensor:
    """Return unit normals (M, 3): of adjacent faces, weighted by angle (Thürmer and Wüthrich 1998);
    0 without."""
    corners = vertices[faces]
    flat = _unit_or(_cross(corners), corners.new_zeros(3))
    ahead = _unit_or(corners.roll(-1, 1) - corners, corners.new_zeros(3))
    cosines = -(ahead * ahead.roll(1, 1)).sum(-1)
    total = torch.zeros_like(vertices)
    for k in range(3):
        total.index_add_(0, faces[:, k], flat * cosines[:, k].clamp(-1, 1).acos()[:, None])
    return _unit_or(total, corners.new_zeros(3))


def _along_u(corners: Tensor, corners_uv: Tensor) -> Tensor:
    """Return directions (T, 3) of increasing u at constant v on triangles (T, 3, 3); NaN where
    degenerate."""
    (first, second), (uv1, uv2) = ((x[:, 1:] - x[:, :1]).unbind(1) for x in (corners, corners_uv))
    determinant = _cross(corners_uv)[:, 2:]
    return (first * uv2[:, 1:2] - second * uv1[:, 1:2]) / determinant


def _frames(normals: Tensor, tangents: Tensor) -> Tensor:
    """Return right-handed rotations (P, 3, 3) with columns tangent, bitangent and normal; the unit
    normals are kept."""
    along = tangents - normals * (normals * tangents).sum(-1, keepdim=True)
    least = torch.nn.functional.one_hot(normals.abs().argmin(-1), 3).to(normals)
    # for folds, where the tangent is parallel to the normal
    across = torch.linalg.cross(normals, least, dim=-1)
    tangents = _unit_or(along, _unit_or(across, across))
    return torch.stack([tangents, torch.linalg.cross(normals, tangents, dim=-1), normals], dim=-1)


def _unit_or(vectors: Tensor, otherwise: Tensor) -> Tensor:
    """Return ``vectors`` (..., 3) normalised; ``otherwise`` where they are too short to have a
    direction."""
    length = vectors.norm(dim=-1, keepdim=True)
    is_short = length <= 1e-12
    return torch.where(is_short, otherwise, vectors / torch.where(is_short, 1.0, length))
