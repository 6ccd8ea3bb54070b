"""Texels of a body template's UV map as samples of its surface.

Symbols: P texels, S texels per side, T triangles, M vertices, U UV vertices, J joints.
"""

from __future__ import annotations

from dataclasses import dataclass, fields

import numpy as np
import torch
from torch import Tensor

from dyngs.core.errors import DyngsError
from dyngs.human.body.body import BodyTemplate
from dyngs.human.body.mesh import rasterize

# Twice the area over the squared longest edge below which a triangle is degenerate.
_MIN_THICKNESS = 1e-9


@dataclass(frozen=True)
class Texels:
    """Surface attributes of the P covered texels of a UV map, in the rest pose, in row-major
    order."""

    # S; the centre of row r, column c is at u = (c + 0.5) / S, v = 1 - (r + 0.5) / S.
    resolution: int
    index: Tensor  # (P,) int64, r * S + c, ascending
    faces: Tensor  # (P,) int64 triangle of the template that covers the texel's centre
    barycentric: Tensor  # (P, 3) of the centre in that triangle, rows sum to 1
    points: Tensor  # (P, 3) on the surface, m
    # (P, 3, 3) rotations; columns are tangent (increasing u), bitangent and smooth outward normal.
    # In mirrored parts of a UV map the bitangent points to decreasing v.
    frames: Tensor
    weights: Tensor  # (P, J) skinning weights, rows sum to 1
    size: Tensor  # (P,) side on the surface, m: sqrt(triangle area / its UV area) / S

    def __len__(self) -> int:
        return len(self.index)

    def select(self, index: Tensor) -> Texels:
        """Return the texels at ``index`` (ascending long, or bool)."""
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
    """Sample the surface of ``body`` at all texels whose centres its UV map covers.

    Where triangles overlap, the first one wins; triangles that are degenerate in the UV map or in
    space cover nothing. Not differentiable.

    Args:
        body: template with a UV map.
        resolution: texels per side S.
        vertices: (M, 3) rest shape, m; None: that of the template.

    Raises:
        DyngsError: no UV map, a resolution below 1, or ``vertices`` of a wrong shape or not
            finite.
    """
    if body.uv is None or body.uv_faces is None:
        raise DyngsError(
            f"the body template '{body.name}' has no UV map; use a template that has one"
        )
    if resolution < 1:
        raise DyngsError(f"the resolution of the UV map must be at least 1, got {resolution}")
    rest_vertices = body.vertices if vertices is None else vertices
    if rest_vertices.shape != body.vertices.shape or not bool(rest_vertices.isfinite().all()):
        raise DyngsError(
            f"the rest shape must be {tuple(body.vertices.shape)} finite numbers, got "
            f"{tuple(rest_vertices.shape)}; check vertices and shape parameters for NaN"
        )
    rest_vertices = rest_vertices.detach().double()
    corners = rest_vertices[body.faces]
    corners_uv = torch.nn.functional.pad(
        body.uv.detach().double()[body.uv_faces], (0, 1), value=1.0
    )
    area = _areas(corners)
    area_uv = _areas(corners_uv)
    usable = (area > 0) & (area_uv > 0)
    index, faces, barycentric = _covered_texels(corners_uv, usable, resolution)
    corner_indices = body.faces[faces]
    dtype = body.vertices.dtype
    normals_smooth = _interpolated(
        barycentric, corner_indices, _vertex_normals(rest_vertices, body.faces)
    )
    normals = _unit_or(normals_smooth, _unit_or(_cross(corners), corners.new_zeros(3))[faces])
    return Texels(
        resolution=resolution,
        index=index,
        faces=faces,
        barycentric=barycentric.to(dtype),
        points=_interpolated(barycentric, corner_indices, rest_vertices).to(dtype),
        frames=_frames(normals, _along_u(corners, corners_uv)[faces]).to(dtype),
        weights=_interpolated(barycentric.to(body.weights), corner_indices, body.weights.detach()),
        size=((area / area_uv)[faces].sqrt() / resolution).to(dtype),
    )


def _covered_texels(
    corners_uv: Tensor, usable: Tensor, resolution: int
) -> tuple[Tensor, Tensor, Tensor]:
    """Return the covered texels (P,), their triangles (P,) and barycentrics (P, 3).

    Args:
        corners_uv: (T, 3, 3) corners in the UV map, the third coordinate 1.
        usable: (T,) triangles that may cover texels.
        resolution: texels per side.
    """
    triangles = np.flatnonzero(usable.cpu().numpy())
    corners = corners_uv.cpu().numpy()[triangles]
    corners = corners * [resolution, -resolution, 1] + [-0.5, resolution - 0.5, 0]
    texels = rasterize(corners, resolution, resolution)
    rows = (texels.index, triangles[texels.faces], texels.barycentric)
    index, faces, barycentric = (torch.from_numpy(x).to(corners_uv.device) for x in rows)
    return index, faces, barycentric


def _interpolated(barycentric: Tensor, around: Tensor, values: Tensor) -> Tensor:
    """Interpolate ``values`` (M, D) at the vertices ``around`` (P, 3) with barycentrics (P, 3)."""
    total = barycentric[:, :1] * values[around[:, 0]]
    for k in (1, 2):
        total.addcmul_(barycentric[:, k, None], values[around[:, k]])
    return total


def _cross(corners: Tensor) -> Tensor:
    """Return the normals (T, 3) of triangles (T, 3, 3); their length is twice the area."""
    return torch.linalg.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0], dim=-1)


def _areas(corners: Tensor) -> Tensor:
    """Return the areas (T,) of triangles (T, 3, 3); 0 for degenerate or non-finite ones."""
    double = _cross(corners).norm(dim=-1)
    longest = (corners.roll(-1, 1) - corners).square().sum(-1).amax(-1)
    return torch.where(double > _MIN_THICKNESS * longest, 0.5 * double, 0.0)


def _vertex_normals(vertices: Tensor, faces: Tensor) -> Tensor:
    """Return unit vertex normals (M, 3), weighted by angle (Thürmer and Wüthrich 1998); 0 without
    faces."""
    import trimesh

    mesh = trimesh.Trimesh(vertices.cpu().numpy(), faces.cpu().numpy(), process=False)
    return torch.tensor(mesh.vertex_normals, dtype=vertices.dtype, device=vertices.device)


def _along_u(corners: Tensor, corners_uv: Tensor) -> Tensor:
    """Return the directions (T, 3) of increasing u on triangles (T, 3, 3); NaN for degenerate
    ones."""
    (first, second), (uv1, uv2) = ((x[:, 1:] - x[:, :1]).unbind(1) for x in (corners, corners_uv))
    determinant = _cross(corners_uv)[:, 2:]
    return (first * uv2[:, 1:2] - second * uv1[:, 1:2]) / determinant


def _frames(normals: Tensor, tangents: Tensor) -> Tensor:
    """Return right-handed frames (P, 3, 3) with columns tangent, bitangent and the given unit
    normal."""
    along = tangents - normals * (normals * tangents).sum(-1, keepdim=True)
    least = torch.nn.functional.one_hot(normals.abs().argmin(-1), 3).to(normals)
    # Fallback where the tangent is parallel to the normal, as at folds.
    across = torch.linalg.cross(normals, least, dim=-1)
    tangents = _unit_or(along, _unit_or(across, across))
    return torch.stack([tangents, torch.linalg.cross(normals, tangents, dim=-1), normals], dim=-1)


def _unit_or(vectors: Tensor, otherwise: Tensor) -> Tensor:
    """Normalise ``vectors`` (..., 3); zero vectors become ``otherwise``."""
    length = vectors.norm(dim=-1, keepdim=True)
    is_short = length <= 1e-12
    return torch.where(is_short, otherwise, vectors / torch.where(is_short, 1.0, length))
