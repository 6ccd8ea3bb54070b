"""Curved triangles as a mesh."""

from __future__ import annotations

import numpy as np
import torch
from small_triangles import bent, triangle

from dyngs.baselines.triangles.mesh import surface_of
from dyngs.baselines.triangles.patches import Patches
from dyngs.baselines.triangles.scene import TriangleScene


def test_a_flat_triangle_keeps_its_area_at_any_subdivision() -> None:
    points = triangle((0, 0, 0), (3, 0, 0), (0, 4, 0))
    patches = Patches(points, torch.full((1, 6, 3), 0.25), torch.zeros(1, 0, 3))
    for segments in (1, 5):
        surface = surface_of(TriangleScene(patches, 1.0), segments)
        assert surface.faces.shape == (segments**2, 3)
        a, b, c = (surface.vertices[surface.faces[:, i]] for i in range(3))
        normals = np.cross(b - a, c - a)
        np.testing.assert_allclose(normals.sum(0) / 2, [0, 0, 6], atol=1e-5)
        np.testing.assert_allclose(surface.colours, 0.25, rtol=1e-6)


def test_triangles_do_not_share_vertices() -> None:
    surface = surface_of(TriangleScene(bent(3), 1.0), 2)
    assert len(surface.vertices) == 3 * 6
    assert sorted({int(i) // 6 for i in surface.faces[4:8].ravel()}) == [1]
