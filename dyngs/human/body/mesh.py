"""Triangle meshes in numpy: rasterization with a depth buffer, vertex normals, interpolation.

Independent of the rasterizer of Gaussians, so that it can give ground truth. Local letters: M
vertices, T triangles, H fragments.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class Fragments:
    """The visible triangle of H covered grid points, each point at most once."""

    index: np.ndarray  # (H,) row * width + column
    faces: np.ndarray  # (H,) int64 triangle
    # (H, 3) coordinates on the triangle in space (perspective-correct), rows sum to 1
    barycentric: np.ndarray


def rasterize(corners: np.ndarray, width: int, height: int) -> Fragments:
    """Return the nearest triangle at every covered grid point (whole numbers of column and row).

    ``corners`` (T, 3, 3) are column, row and inverse depth, which is linear in the image, and 1
    without perspective. Triangles without area cover nothing; edges belong to both sides.
    """
    x, y, near = np.ascontiguousarray(corners.transpose(2, 1, 0))
    left, across = span(x, width)
    top, down = span(y, height)
    some = np.flatnonzero(across * down)  # of small images most triangles have no grid point at all
    (x0, x1, x2), (y0, y1, y2), left, across, top, down = (
        v[..., some] for v in (x, y, left, across, top, down)
    )
    area = (x1 - x0) * (y2 - y0) - (y1 - y0) * (x2 - x0)
    counts = np.where(area != 0, across * down, 0)
    owner, column, row = grid_points(counts, left, top, across)
    right = column - x0[owner]
    below = row - y0[owner]
    second = (right * (y2 - y0)[owner] - below * (x2 - x0)[owner]) / area[owner]
    third = ((x1 - x0)[owner] * below - (y1 - y0)[owner] * right) / area[owner]
    barycentric = np.stack([1.0 - second - third, second, third])
    # with a margin, so that no gaps open between neighbours
    inside = barycentric.min(axis=0) >= -1e-9
    barycentric = barycentric[:, inside]
    owner = some[owner[inside]]
    index = (row * width + column)[inside]
    barycentric = barycentric * near[:, owner]
    inverse = barycentric.sum(axis=0)
    nearest = np.zeros(width * height)
    np.maximum.at(nearest, index, inverse)
    first = np.flatnonzero(inverse == nearest[index])
    index, chosen = np.unique(index[first], return_index=True)
    first = first[chosen]
    return Fragments(index, owner[first], (barycentric[:, first] / inverse[first]).T)


def vertex_normals(vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Return unit normals (M, 3) at the vertices: of the adjacent triangles, weighted by area."""
    a, b, c = vertices[faces].transpose(1, 0, 2)
    flat = np.repeat(np.cross(b - a, c - a), 3, axis=0)
    total = [
        np.bincount(faces.ravel(), weights=flat[:, k], minlength=len(vertices)) for k in range(3)
    ]
    return normalized(np.stack(total, axis=-1))


def interpolate(barycentric: np.ndarray, values: np.ndarray) -> np.ndarray:
    """Return values (H, D) at barycentric coordinates (H, 3) between those of the corners (H, 3,
    D)."""
    return np.einsum("hk,hkd->hd", barycentric, values)


def normalized(vectors: np.ndarray) -> np.ndarray:
    """Return the vectors (..., 3) at length 1; zero stays zero."""
    return vectors / np.maximum(np.linalg.norm(vectors, axis=-1, keepdims=True), 1e-12)


def grid_points(
    counts: np.ndarray, left: np.ndarray, top: np.ndarray, across: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return triangle, column and row of the grid points in the boxes of T triangles, ``counts`` of
    them each, ``across`` in a row."""
    owner = np.repeat(np.arange(len(counts)), counts)
    within = np.arange(len(owner)) - np.repeat(np.cumsum(counts) - counts, counts)
    return owner, left[owner] + within % across[owner], top[owner] + within // across[owner]


def span(ends: np.ndarray, size: int) -> tuple[np.ndarray, np.ndarray]:
    """Return the first and the number of whole numbers in [0, size) between the ``ends`` (3, T) of
    triangles."""
    first = np.ceil(ends.min(axis=0) - 1e-6).clip(0, size).astype(np.int64)
    last = np.floor(ends.max(axis=0) + 1e-6).clip(-1, size - 1).astype(np.int64)
    return first, np.maximum(last - first + 1, 0)
