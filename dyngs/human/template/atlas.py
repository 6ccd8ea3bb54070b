"""Texels of a body template's texture atlas as places on its surface, and shells of such places above it.

Local letters: T triangles, U vertices of the atlas, P texels, Q places on shells.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from dyngs.errors import DyngsError
from dyngs.human.template.body import BodyTemplate

_THINNEST = 1e-9
"""Twice the area over the square of the longest edge at which a triangle counts as degenerate."""


@dataclass(frozen=True)
class Texels:
    """What every covered texel of an atlas knows of the rest surface; P texels in row-major order of the atlas.

    Attributes:
        resolution: S, texels per side. The centre of row r, column c lies at u = (c + 0.5) / S, v = 1 - (r + 0.5) / S.
        index: (P,) int64, r * S + c, ascending.
        faces: (P,) int64, the triangle of the template that covers the texel's centre.
        barycentric: (P, 3) of the centre in that triangle, in [0, 1], rows sum to 1.
        points: (P, 3) rest surface points, m.
        frames: (P, 3, 3) rotations; columns are the tangent (along growing u), the bitangent and the outward normal,
            smooth over edges. In mirrored parts of an atlas the bitangent points along falling v.
        weights: (P, J) skinning weights, rows sum to 1.
        size: (P,) side of the texel on the surface, m: sqrt(area of the triangle / its area in the atlas) / S.
    """

    resolution: int
    index: Tensor
    faces: Tensor
    barycentric: Tensor
    points: Tensor
    frames: Tensor
    weights: Tensor
    size: Tensor

    def __len__(self) -> int:
        return len(self.index)

    @property
    def normals(self) -> Tensor:
        """(P, 3) outward unit normals."""
        return self.frames[..., 2]


@dataclass(frozen=True)
class ScaffoldPoints:
    """Places above the texels of an atlas, in any order and number: scaffolds for clothing and hair.

    Attributes:
        texel: (Q,) int64 rows of a ``Texels``.
        height: (Q,) along the normal, m.
    """

    texel: Tensor
    height: Tensor

    def __len__(self) -> int:
        return len(self.texel)

    def select(self, index: Tensor) -> ScaffoldPoints:
        """The places at ``index`` (long or bool)."""
        return ScaffoldPoints(self.texel[index], self.height[index])

    def points(self, texels: Texels) -> Tensor:
        """(Q, 3) rest positions, m, above the surface of ``texels``, x + height * normal."""
        return texels.points[self.texel] + self.height[:, None] * texels.normals[self.texel]


def atlas_texels(body: BodyTemplate, resolution: int, vertices: Tensor | None = None) -> Texels:
    """The texels whose centres the atlas of ``body`` covers; where triangles touch or overlap, the first one has it.

    Triangles that are degenerate, in the atlas or on the surface, cover nothing. Gradients do not flow through.

    Args:
        body: a template with texture coordinates.
        resolution: S, texels per side, at least 1.
        vertices: (M, 3) another rest shape than the template's, m.

    Raises:
        DyngsError: no texture coordinates, a resolution below 1, or ``vertices`` of another shape or not finite.
    """
    if body.uv is None or body.uv_faces is None:
        raise DyngsError(f"the body template '{body.name}' has no texture coordinates; give one with a texture atlas")
    if resolution < 1:
        raise DyngsError(f"the resolution of the texture atlas must be at least 1, got {resolution}")
    rest = body.vertices if vertices is None else vertices
    if rest.shape != body.vertices.shape or not bool(rest.isfinite().all()):
        raise DyngsError(
            f"the rest shape must be {tuple(body.vertices.shape)} finite numbers, got {tuple(rest.shape)}; check the "
            "vertices and shape coefficients for NaN"
        )
    rest = rest.detach().double()
    corners = rest[body.faces]
    corners_uv = torch.nn.functional.pad(body.uv.detach().double()[body.uv_faces], (0, 1))
    area, area_uv = _areas(corners), _areas(corners_uv)
    usable = (area > 0) & (area_uv > 0)
    index, faces, barycentric = _rasterized(corners_uv.numpy(), usable.numpy(), resolution)
    around, dtype = body.faces[faces], body.vertices.dtype
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


def scaffold_points(texels: Texels, heights: Sequence[float]) -> ScaffoldPoints:
    """Places at all ``heights`` (m, along the normal) above all texels: those of the first height, then of the next.

    Raises:
        DyngsError: no height, or one that is not finite.
    """
    levels = texels.points.new_tensor(heights)
    if levels.numel() == 0 or not bool(levels.isfinite().all()):
        raise DyngsError(f"the heights of shells must be one or more finite numbers of metres, got {list(heights)}")
    return ScaffoldPoints(torch.arange(len(texels)).repeat(len(levels)), levels.repeat_interleave(len(texels)))


def _rasterized(corners: np.ndarray, usable: np.ndarray, resolution: int) -> tuple[Tensor, Tensor, Tensor]:
    """Texels (P,) covered by triangles (T, 3, 2 or 3) of the atlas, ascending, their triangles and barycentrics (P, 3).

    Exact along shared edges: an edge's sign is computed from its ends in an order that both triangles agree on.
    """
    triangles = np.flatnonzero(usable)
    x, y = corners[triangles, :, 0] * resolution - 0.5, (1 - corners[triangles, :, 1]) * resolution - 0.5
    left, width = _span(x, resolution)
    top, height = _span(y, resolution)
    counts = width * height
    owner = np.repeat(np.arange(len(triangles)), counts)
    within = np.arange(len(owner)) - np.repeat(np.cumsum(counts) - counts, counts)
    column, row = left[owner] + within % width[owner], top[owner] + within // width[owner]
    turn = np.sign((x[:, 1] - x[:, 0]) * (y[:, 2] - y[:, 0]) - (y[:, 1] - y[:, 0]) * (x[:, 2] - x[:, 0]))
    sides = np.empty((len(owner), 3))
    for k, (i, j) in enumerate(((1, 2), (2, 0), (0, 1))):
        swap = (x[:, j] < x[:, i]) | ((x[:, j] == x[:, i]) & (y[:, j] < y[:, i]))
        ax, ay = np.where(swap, x[:, j], x[:, i]), np.where(swap, y[:, j], y[:, i])
        dx, dy = np.where(swap, x[:, i], x[:, j]) - ax, np.where(swap, y[:, i], y[:, j]) - ay
        sign = np.where(swap, -turn, turn)
        sides[:, k] = sign[owner] * (dx[owner] * (row - ay[owner]) - dy[owner] * (column - ax[owner]))
    inside = (sides >= 0).all(1)
    texels, first = np.unique((row * resolution + column)[inside], return_index=True)
    shares = sides[inside][first]
    shares /= shares.sum(1, keepdims=True)
    return (
        torch.from_numpy(texels.astype(np.int64)),
        torch.from_numpy(triangles[owner[inside][first]].astype(np.int64)),
        torch.from_numpy(shares),
    )


def _span(ends: np.ndarray, resolution: int) -> tuple[np.ndarray, np.ndarray]:
    """First texel and number of texels (T,) whose centres, whole numbers, lie between the ``ends`` (T, 3)."""
    first = np.ceil(ends.min(1)).clip(0, resolution).astype(np.int64)
    last = np.floor(ends.max(1)).clip(-1, resolution - 1).astype(np.int64)
    return first, np.maximum(last - first + 1, 0)


def _interpolated(barycentric: Tensor, around: Tensor, values: Tensor) -> Tensor:
    """(P, D) values at places between the vertices ``around`` (P, 3) of values (M, D) at the vertices."""
    total = barycentric[:, :1] * values[around[:, 0]]
    for k in (1, 2):
        total.addcmul_(barycentric[:, k, None], values[around[:, k]])
    return total


def _cross(corners: Tensor) -> Tensor:
    """(T, 3) normals of triangles (T, 3, 3), twice their area long."""
    return torch.linalg.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0], dim=-1)


def _areas(corners: Tensor) -> Tensor:
    """(T,) areas of triangles (T, 3, 3); zero where degenerate or not finite."""
    double = _cross(corners).norm(dim=-1)
    longest = (corners.roll(-1, 1) - corners).square().sum(-1).amax(-1)
    return torch.where(double > _THINNEST * longest, 0.5 * double, 0.0)


def _vertex_normals(vertices: Tensor, faces: Tensor) -> Tensor:
    """(M, 3) unit normals: of the faces around, weighted by their angles (Thürmer and Wüthrich 1998); 0 without any."""
    corners = vertices[faces]
    flat = _unit_or(_cross(corners), corners.new_zeros(3))
    ahead = _unit_or(corners.roll(-1, 1) - corners, corners.new_zeros(3))
    cosines = -(ahead * ahead.roll(1, 1)).sum(-1)
    total = torch.zeros_like(vertices)
    for k in range(3):
        total.index_add_(0, faces[:, k], flat * cosines[:, k].clamp(-1, 1).acos()[:, None])
    return _unit_or(total, corners.new_zeros(3))


def _along_u(corners: Tensor, corners_uv: Tensor) -> Tensor:
    """(T, 3) directions on triangles (T, 3, 3) in which u grows and v stays; NaN where degenerate in the atlas."""
    (first, second), (uv1, uv2) = ((x[:, 1:] - x[:, :1]).unbind(1) for x in (corners, corners_uv))
    determinant = _cross(corners_uv)[:, 2:]
    return (first * uv2[:, 1:2] - second * uv1[:, 1:2]) / determinant


def _frames(normals: Tensor, tangents: Tensor) -> Tensor:
    """(P, 3, 3) right-handed rotations with the columns tangent, bitangent and normal; the unit normals stay."""
    along = tangents - normals * (normals * tangents).sum(-1, keepdim=True)
    least = torch.nn.functional.one_hot(normals.abs().argmin(-1), 3).to(normals)
    across = torch.linalg.cross(normals, least, dim=-1)  # where the tangent is along the normal, at folds
    tangents = _unit_or(along, _unit_or(across, across))
    return torch.stack([tangents, torch.linalg.cross(normals, tangents, dim=-1), normals], dim=-1)


def _unit_or(vectors: Tensor, otherwise: Tensor) -> Tensor:
    """(..., 3) ``vectors`` normalised; ``otherwise`` where they are too short to have a direction."""
    length = vectors.norm(dim=-1, keepdim=True)
    is_short = length <= 1e-12
    return torch.where(is_short, otherwise, vectors / torch.where(is_short, 1.0, length))
