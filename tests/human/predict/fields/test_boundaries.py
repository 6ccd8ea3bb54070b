"""Depths of meshes and of the boundaries of a body, by known answers."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from dyngs.core.camera import Cameras
from dyngs.human.body.mesh import rasterize
from dyngs.human.predict.people import (
    DILATION,
    EROSION,
    Person,
    PosedBody,
    cameras_in_metres,
    depths,
)

DISTANCE, RADIUS = 3.0, 0.3


def sphere(radius: float) -> tuple[torch.Tensor, torch.Tensor]:
    """Vertices and triangles, anticlockwise from outside, of a fine sphere."""
    rings, steps = 40, 80
    angles = (
        np.linspace(0, np.pi, rings + 1)[:, None],
        np.linspace(0, 2 * np.pi, steps, endpoint=False)[None],
    )
    around = np.ones_like(angles[1])
    ring = np.sin(angles[0])
    x = ring * np.cos(angles[1])
    y = np.cos(angles[0]) * around
    z = ring * np.sin(angles[1])
    vertices = radius * np.stack([x, y, z], -1).reshape(-1, 3)
    i, j = np.meshgrid(np.arange(rings), np.arange(steps), indexing="ij")
    a = i * steps + j
    b = i * steps + (j + 1) % steps
    faces = np.concatenate(
        [np.stack([a, b, b + steps], -1), np.stack([a, b + steps, a + steps], -1)]
    )
    return torch.from_numpy(vertices).float(), torch.from_numpy(faces.reshape(-1, 3))


def body(radius: float) -> PosedBody:
    return PosedBody(torch.zeros(22, 3), *sphere(radius))


def camera() -> Cameras:
    pose = torch.eye(4)[None].clone()
    pose[0, 2, 3] = DISTANCE
    return Cameras(pose, torch.tensor([[[100.0, 0, 16], [0, 100, 12], [0, 0, 1]]]), 32, 24)


def true_depths(radius: float, sign: float) -> torch.Tensor:
    """Return the depth in m at which rays through pixel centres enter (-1) or leave (1) a sphere at
    the origin."""
    y, x = torch.meshgrid(torch.arange(24) + 0.5, torch.arange(32) + 0.5, indexing="ij")
    local = torch.stack([(x - 16) / 100, (y - 12) / 100, torch.ones_like(x)], -1).double()
    a = local.square().sum(-1)
    b = -2 * DISTANCE * local[..., 2]
    c = DISTANCE**2 - radius**2
    root = b.square() - 4 * a * c
    return torch.where(
        root > 0, (-b + sign * root.clamp_min(0).sqrt()) / (2 * a), torch.inf
    ).float()


@pytest.mark.parametrize("last", [False, True])
def test_a_sphere_is_met_first_and_last(last: bool) -> None:
    vertices, faces = sphere(RADIUS)
    found = depths(vertices, faces, camera(), last=last)
    expected = true_depths(RADIUS, 1.0 if last else -1.0)
    both = found.isfinite() & expected.isfinite()
    assert int((found.isfinite() != expected.isfinite()).sum()) < 0.1 * int(both.sum())
    torch.testing.assert_close(found[both], expected[both], atol=0.02, rtol=0)
    assert float((found - expected)[both].abs().mean()) < 2e-3
    if not last:
        assert torch.equal(depths(vertices, faces, camera(), front_faces=True), found)
    turned = depths(vertices, faces.flip(1), camera(), front_faces=True)
    middle = turned[12, 16]
    assert float(middle) == pytest.approx(DISTANCE + RADIUS, abs=2e-3), "seen from inside alone"


def test_boundaries_of_a_ball_are_balls() -> None:
    begin, end, met = body(RADIUS).interval(camera())
    middle = begin[12, 16], met[12, 16], end[12, 16]
    expected = (DISTANCE - RADIUS - DILATION, DISTANCE - RADIUS, DISTANCE - RADIUS + EROSION)
    torch.testing.assert_close(torch.stack(middle), torch.tensor(expected), atol=2e-3, rtol=0)
    outside = met.isinf() & begin.isfinite()
    assert bool(outside.any())
    expected_end = true_depths(RADIUS + DILATION, 1.0)
    sure = outside & expected_end.isfinite() & true_depths(RADIUS, 1.0).isinf()
    assert float((end - expected_end)[sure].abs().median()) < 5e-3, (
        "what misses the body comes out again"
    )


def test_a_thin_body_ends_behind_its_front() -> None:
    """Eroded by more than its radius it is inside out, and its back would come first."""
    _, end, met = body(0.03).interval(camera())
    assert float(end[12, 16]) > float(met[12, 16])


def test_depths_are_those_of_the_mesh_renderer_in_numpy(person: Person) -> None:
    """Of a body whose parts hide each other; in float64."""
    own, scale = person.body_in(person.views[0])
    view = cameras_in_metres(person.images[0].cameras, scale)
    pose, k = (x[0].double().numpy() for x in (view.cam_from_world, view.intrinsics))
    local = own.vertices.double().numpy() @ pose[:3, :3].T + pose[:3, 3]
    inverse = 1 / local[:, 2]
    pixels = (local @ k.T)[:, :2] * inverse[:, None] - 0.5
    for last in (False, True):
        nearness = np.stack([*pixels.T, 10 - inverse if last else inverse], 1)[own.faces.numpy()]
        found = rasterize(nearness, view.width, view.height)
        nearest = 1 / (found.barycentric / nearness[found.faces, :, 2]).sum(1)
        expected = np.full(view.width * view.height, np.inf)
        expected[found.index] = 1 / (10 - nearest if last else nearest)
        ours = depths(own.vertices, own.faces, view, last=last).flatten()
        torch.testing.assert_close(ours, torch.from_numpy(expected).float(), atol=2e-4, rtol=0)


def test_heights_grow_steadily_through_the_surface() -> None:
    """Distances to vertices alone, which lie apart, jump by twice their distance there."""
    ball = body(RADIUS)
    directions = torch.nn.functional.normalize(
        torch.randn(50, 3, generator=torch.Generator().manual_seed(0)), dim=1
    )
    heights = torch.linspace(-0.05, 0.05, 41)
    points = (RADIUS + heights)[:, None, None] * directions
    found = ball.height(points.flatten(0, 1)).view(41, 50)
    assert float((found - heights[:, None]).abs().max()) < 0.012
    steps = found.diff(dim=0)
    assert float(steps.min()) > 0
    assert float(steps.max()) < 0.005, "half a cell apart"
    far = ball.height(torch.tensor([[0.0, 0, RADIUS + 0.3], [9, 9, 9]]))
    torch.testing.assert_close(far, torch.full((2,), 0.08))


def test_heights_of_cells_are_distances_to_the_nearest_vertex() -> None:
    """In float64, of all vertices, inside and outside; at most 8 cm."""
    ball = body(RADIUS)
    grid, low, size = ball._heights
    counts = torch.tensor(grid.shape[2:])
    generator = torch.Generator().manual_seed(0)
    cells = (torch.rand(2000, 3, generator=generator) * counts).long()
    centres = low.double() + (cells + 0.5) * size.double() / counts
    distance, nearest = torch.cdist(centres, ball.vertices.double()).min(1)
    is_inside = ((centres - ball.vertices[nearest]) * ball.vertices[nearest]).sum(1) < 0
    expected = torch.where(is_inside, -distance, distance)
    expected = torch.where(distance < 0.08, expected, 0.08).float()
    torch.testing.assert_close(grid[0, 0][cells.unbind(1)], expected, atol=1e-6, rtol=0)
    assert float((expected < 0).float().mean()) > 0.05
    assert float((expected == 0.08).float().mean()) > 0.3


def test_the_surface_of_a_dressed_person_lies_in_between(person: Person) -> None:
    own, scale = person.body_in(person.views[0])
    image = person.images[0]
    begin, end, met = own.interval(cameras_in_metres(image.cameras, scale))
    assert image.depth is not None
    assert image.alpha is not None
    solid = (image.alpha > 0.99) & (image.depth > 0)
    truth = (image.depth / scale)[solid]
    inside = (begin[solid] <= truth) & (truth <= end[solid])
    assert float(inside.float().mean()) > 0.9
    both = met.isfinite() & begin.isfinite()
    assert bool((end > met)[both].all()), "also of mouth, eyes and fingers"
    assert float(begin.isfinite().float().mean()) < 0.6
