"""Fusion of depth maps of a ball into one surface, and mesh simplification."""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest
import torch
from seen_ball import HIGH, LOW, RADIUS, views

from dyngs.gaussians.surface import Mesh, fuse_depths, sample_colours, simplify_mesh


@cache
def ball() -> Mesh:
    found = fuse_depths(views(), LOW, HIGH, 40)
    assert found is not None
    return found


def radii(mesh: Mesh) -> np.ndarray:
    return np.linalg.norm(mesh.vertices[np.unique(mesh.faces)], axis=1)


def test_fused_surface_lies_at_the_observed_depth() -> None:
    assert len(ball().faces) > 2000
    assert abs(radii(ball()).mean() - RADIUS) < 0.02
    assert radii(ball()).std() < 0.03


@pytest.mark.parametrize("most", [40, 300, 10**6])
def test_simplified_mesh_has_requested_faces(most: int) -> None:
    mesh = simplify_mesh(ball(), most)
    assert min(most, len(ball().faces)) / 3 < len(mesh.faces) <= most
    assert np.abs(radii(mesh) - RADIUS).max() < 0.3
    assert (np.diff(np.sort(mesh.faces, axis=1), axis=1) > 0).all()
    # torch takes no arrays that are stored backwards
    assert len(torch.from_numpy(mesh.faces)) == len(mesh.faces)


def test_merged_vertices_lie_on_plane_intersections() -> None:
    """A finely cut cube keeps its corners."""
    axis = np.linspace(-1, 1, 21)
    u, v = (x.reshape(-1) for x in np.meshgrid(axis, axis, indexing="ij"))
    corner = np.arange(20)[:, None] * 21 + np.arange(20)
    flat = np.stack(
        [corner, corner + 21, corner + 1, corner + 22, corner + 1, corner + 21], -1
    ).reshape(-1, 3)
    sides = [
        np.stack([u, v, np.full_like(u, s)], 1)[:, roll]
        for roll in ([0, 1, 2], [2, 0, 1], [1, 2, 0])
        for s in (-1, 1)
    ]
    faces = np.concatenate([flat + k * 441 for k in range(6)])
    mesh = simplify_mesh(Mesh(np.concatenate(sides) + 1e-3, faces), 100)
    for x in (-1, 1):
        for y in (-1, 1):
            distance = np.linalg.norm(mesh.vertices - np.array([x, y, 1]), axis=1).min()
            assert distance < 0.1


def test_vertex_colours_come_from_unoccluded_views() -> None:
    points = torch.tensor([[RADIUS, 0.0, 0.0], [-RADIUS, 0.0, 0.0], [0.0, 0.0, 9.0]])
    colours = sample_colours(views(), points, 0.1)
    torch.testing.assert_close(colours[0], torch.tensor([1.0, 0, 0]), atol=0.02, rtol=0)
    torch.testing.assert_close(colours[1], torch.zeros(3), atol=0.02, rtol=0)
    torch.testing.assert_close(colours[2], torch.full((3,), 0.5))
