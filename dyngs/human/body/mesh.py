"""Triangle meshes in NumPy: rasterisation with a depth buffer, vertex normals, interpolation.

Independent of the Gaussian rasteriser, so that it can provide ground truth. Symbols: M vertices, T
triangles, H fragments.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class Fragments:
    """Visible triangle at each of H covered grid points."""

    index: np.ndarray  # (H,) row * width + column
    faces: np.ndarray  # (H,) int64 triangle
    barycentric: np.ndarray  # (H, 3) perspective-correct, rows sum to 1
    depth: np.ndarray  # (H,)


def rasterize(corners: np.ndarray, width: int, height: int) -> Fragments:
    """Return the nearest triangle at every covered grid point (integer column and row).

    ``corners`` (T, 3, 3) are column, row and inverse depth, which is linear in the image (1 for an
    orthographic view). Edges belong to both triangles, and the first of equally near triangles is
    returned; degenerate triangles cover nothing.
    """
    x, y, near = np.ascontiguousarray(corners.transpose(2, 1, 0))
    left, across = _span(x, width)
    top, down = _span(y, height)
    candidates = np.flatnonzero(across * down)  # in small images most triangles cover no grid point
    (x0, x1, x2), (y0, y1, y2), left, across, top, down = (
        v[..., candidates] for v in (x, y, left, across, top, down)
    )
    area = (x1 - x0) * (y2 - y0) - (y1 - y0) * (x2 - x0)
    counts = np.where(area != 0, across * down, 0)
    owner = np.repeat(np.arange(len(counts)), counts)
    within = np.arange(len(owner)) - np.repeat(np.cumsum(counts) - counts, counts)
    column = left[owner] + within % across[owner]
    row = top[owner] + within // across[owner]
    right = column - x0[owner]
    below = row - y0[owner]
    second = (right * (y2 - y0)[owner] - below * (x2 - x0)[owner]) / area[owner]
    third = ((x1 - x0)[owner] * below - (y1 - y0)[owner] * right) / area[owner]
    barycentric = np.stack([1.0 - second - third, second, third])
    # The tolerance avoids gaps between neighbouring triangles.
    inside = barycentric.min(axis=0) >= -1e-9
    owner = candidates[owner[inside]]
    index = (row * width + column)[inside]
    barycentric = barycentric[:, inside].clip(0.0) * near[:, owner]
    inverse = barycentric.sum(axis=0)
    # Without rounding, chance would decide between triangles of the same depth.
    rounded = inverse.round(12)
    nearest = np.zeros(width * height)
    np.maximum.at(nearest, index, rounded)
    first = np.flatnonzero(rounded == nearest[index])
    index, chosen = np.unique(index[first], return_index=True)
    first = first[chosen]
    depth = 1.0 / inverse[first]
    return Fragments(index, owner[first], (barycentric[:, first] * depth).T, depth)


def vertex_normals(vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Return unit vertex normals (M, 3), weighted by the area of the adjacent triangles."""
    a, b, c = vertices[faces].transpose(1, 0, 2)
    flat = np.repeat(np.cross(b - a, c - a), 3, axis=0)
    total = [
        np.bincount(faces.ravel(), weights=flat[:, k], minlength=len(vertices)) for k in range(3)
    ]
    return normalized(np.stack(total, axis=-1))


def interpolate(barycentric: np.ndarray, values: np.ndarray) -> np.ndarray:
    """Interpolate corner values (H, 3, D) with barycentric coordinates (H, 3); return (H, D)."""
    return np.einsum("hk,hkd->hd", barycentric, values)


def normalized(vectors: np.ndarray) -> np.ndarray:
    """Return vectors (..., 3) scaled to length 1; zero vectors stay zero."""
    return vectors / np.maximum(np.linalg.norm(vectors, axis=-1, keepdims=True), 1e-12)


def _span(ends: np.ndarray, size: int) -> tuple[np.ndarray, np.ndarray]:
    """Return the first integer in [0, size) within the extent of triangles (3, T), and their
    number."""
    first = np.ceil(ends.min(axis=0) - 1e-6).clip(0, size).astype(np.int64)
    last = np.floor(ends.max(axis=0) + 1e-6).clip(-1, size - 1).astype(np.int64)
    return first, np.maximum(last - first + 1, 0)
