"""Triangles as a grid of pixels or texels sees them, in numpy: the nearest one at every point, normals, attributes.

It shares no formula with the rasterizer of Gaussians. Local letters: M vertices, T triangles, H hits.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class Fragments:
    """Which triangle is seen where; H grid points that see one, none of them twice.

    Attributes:
        index: (H,) row * width + column.
        faces: (H,) int64.
        shares: (H, 3) of the triangle's corners on the surface: barycentric coordinates, sum 1.
    """

    index: np.ndarray
    faces: np.ndarray
    shares: np.ndarray


def rasterize(corners: np.ndarray, width: int, height: int) -> Fragments:
    """The nearest triangle at every grid point, whole numbers of column and row, that sees one.

    Args:
        corners: (T, 3, 3) column, row and nearness of the corners; nearness is 1 / depth, linear in the picture, or 1
            where there is no perspective. Triangles without area cover nothing; edges belong to both sides.
        width: of the grid.
        height: of the grid.
    """
    x, y, near = np.ascontiguousarray(corners.transpose(2, 1, 0))
    (x0, x1, x2), (y0, y1, y2) = x, y
    area = (x1 - x0) * (y2 - y0) - (y1 - y0) * (x2 - x0)
    left, across = _span(x, width)
    top, down = _span(y, height)
    counts = np.where(area != 0, across * down, 0)
    owner = np.repeat(np.arange(len(corners)), counts)
    within = np.arange(len(owner)) - np.repeat(np.cumsum(counts) - counts, counts)
    column, row = left[owner] + within % across[owner], top[owner] + within // across[owner]
    right, below = column - x0[owner], row - y0[owner]
    second = (right * (y2 - y0)[owner] - below * (x2 - x0)[owner]) / area[owner]
    third = ((x1 - x0)[owner] * below - (y1 - y0)[owner] * right) / area[owner]
    shares = np.stack([1.0 - second - third, second, third])
    inside = shares.min(axis=0) >= -1e-9  # a little more than the triangle: no gaps between neighbours
    shares, owner, index = shares[:, inside], owner[inside], (row * width + column)[inside]
    shares = shares * near[:, owner]
    nearness = shares.sum(axis=0)
    nearest = np.zeros(width * height)
    np.maximum.at(nearest, index, nearness)
    first = np.flatnonzero(nearness == nearest[index])
    index, chosen = np.unique(index[first], return_index=True)
    first = first[chosen]
    return Fragments(index, owner[first], (shares[:, first] / nearness[first]).T)


def vertex_normals(vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """(M, 3) unit normals: of the triangles around, weighted by their areas."""
    a, b, c = vertices[faces].transpose(1, 0, 2)
    flat = np.repeat(np.cross(b - a, c - a), 3, axis=0)
    total = [np.bincount(faces.ravel(), weights=flat[:, k], minlength=len(vertices)) for k in range(3)]
    return normalized(np.stack(total, axis=-1))


def interpolate(shares: np.ndarray, values: np.ndarray) -> np.ndarray:
    """(H, D) values at hits between their corners' (H, 3, D)."""
    return np.einsum("hk,hkd->hd", shares, values)


def normalized(vectors: np.ndarray) -> np.ndarray:
    """(..., 3) of length 1; zero stays zero."""
    return vectors / np.maximum(np.linalg.norm(vectors, axis=-1, keepdims=True), 1e-12)


def _span(ends: np.ndarray, size: int) -> tuple[np.ndarray, np.ndarray]:
    """First whole number in [0, size) between the ``ends`` (3, T) of each triangle, and how many there are (T,)."""
    first = np.ceil(ends.min(axis=0) - 1e-6).clip(0, size).astype(np.int64)
    last = np.floor(ends.max(axis=0) + 1e-6).clip(-1, size - 1).astype(np.int64)
    return first, np.maximum(last - first + 1, 0)
