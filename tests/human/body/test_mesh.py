"""Triangles seen from a grid; the brute-force comparison is in test_synthetic.py."""

from __future__ import annotations

import numpy as np

from dyngs.human.body.mesh import interpolate, rasterize, vertex_normals


def test_the_nearer_triangle_is_seen() -> None:
    """Two that overlap: attributes at a grid point are those of the one with the larger
    nearness."""
    far = [[0.0, 0.0, 0.5], [8.0, 0.0, 0.5], [0.0, 8.0, 0.5]]
    near = [[0.0, 0.0, 1.0], [3.0, 0.0, 1.0], [0.0, 3.0, 1.0]]
    fragments = rasterize(np.array([far, near]), 8, 8)
    owner = np.full(64, -1)
    owner[fragments.index] = fragments.faces
    assert owner[0] == 1
    assert owner[9] == 1
    assert owner[4] == 0
    assert owner[63] == -1
    columns = interpolate(fragments.barycentric, np.array([far, near])[fragments.faces][..., :1])[
        :, 0
    ]
    np.testing.assert_allclose(columns, fragments.index % 8, atol=1e-12)  # sums of a few float64
    assert len(np.unique(fragments.index)) == len(fragments.index)


def test_normals_of_a_pyramid() -> None:
    """The tip's points up, by symmetry; those of a single triangle along its own."""
    vertices = np.array([[1.0, 0, 0], [0, 1, 0], [-1, 0, 0], [0, -1, 0], [0, 0, 2]])
    faces = np.array([[0, 1, 4], [1, 2, 4], [2, 3, 4], [3, 0, 4]])
    np.testing.assert_allclose(vertex_normals(vertices, faces)[4], [0, 0, 1], atol=1e-15)
    flat = vertex_normals(np.eye(3), np.array([[0, 1, 2]]))
    np.testing.assert_allclose(flat, np.full((3, 3), 3**-0.5))
