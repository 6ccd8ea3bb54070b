"""Depths of meshes and of the boundaries of a body, by known answers."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from dyngs.core.camera import Cameras
from dyngs.human.predict.people import (
    DILATION,
    EROSION,
    BodyBoundaries,
    Person,
    PosedBody,
    cameras_in_metres,
    depths,
)

DISTANCE, RADIUS = 3.0, 0.3


def sphere(radius: float) -> tuple[np.ndarray, np.ndarray]:
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
    return vertices, faces.reshape(-1, 3)


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
    turned = depths(vertices, faces[:, ::-1], camera(), front_faces=True)
    middle = turned[12, 16]
    assert float(middle) == pytest.approx(DISTANCE + RADIUS, abs=2e-3), "seen from inside alone"


def test_boundaries_of_a_ball_are_balls() -> None:
    vertices, faces = sphere(RADIUS)
    body = PosedBody(
        torch.zeros(22, 3), torch.from_numpy(vertices).float(), torch.from_numpy(faces.copy())
    )
    begin, end, met = BodyBoundaries(body).interval(camera())
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
    vertices, faces = sphere(0.03)
    body = PosedBody(
        torch.zeros(22, 3), torch.from_numpy(vertices).float(), torch.from_numpy(faces.copy())
    )
    _, end, met = BodyBoundaries(body).interval(camera())
    assert float(end[12, 16]) > float(met[12, 16])


def test_the_surface_of_a_dressed_person_lies_in_between(person: Person) -> None:
    body, scale = person.body_in(person.views[0])
    image = person.images[0]
    begin, end, met = BodyBoundaries(body).interval(cameras_in_metres(image.cameras, scale))
    assert image.depth is not None
    assert image.alpha is not None
    solid = (image.alpha > 0.99) & (image.depth > 0)
    truth = (image.depth / scale)[solid]
    inside = (begin[solid] <= truth) & (truth <= end[solid])
    assert float(inside.float().mean()) > 0.9
    both = met.isfinite() & begin.isfinite()
    assert bool((end > met)[both].all()), "also of mouth, eyes and fingers"
    assert float(begin.isfinite().float().mean()) < 0.6
