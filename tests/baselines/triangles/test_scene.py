"""Curved triangles drawn: colour, alpha, depth, directions, and edges that stay sharp when
enlarged."""

from __future__ import annotations

from dataclasses import replace

import torch
from small_triangles import bent, camera, triangle

from dyngs.baselines.triangles.scene import Patches, TriangleOptions, TriangleScene

RED = torch.tensor([0.8, 0.1, 0.2])
PLAIN = TriangleOptions()


def scene_of(*triangles: torch.Tensor) -> TriangleScene:
    """Red ones."""
    points = torch.cat(triangles)
    return TriangleScene(
        Patches(points, RED.expand(len(points), 6, 3).clone(), torch.zeros(len(points), 0, 3)), 1.0
    )


SQUARE = triangle((-1, -1, 0), (1, -1, 0), (-1, 1, 0)), triangle((1, 1, 0), (1, -1, 0), (-1, 1, 0))


def test_a_square_of_two_triangles_is_opaque_and_of_its_colour() -> None:
    drawn = scene_of(*SQUARE).render(
        camera(), background=torch.ones(3), options=replace(PLAIN, depth="expected")
    )
    inside = slice(10, 22)  # of 32: the square covers those from 6.4 to 25.6
    torch.testing.assert_close(drawn.rgb[0, inside, inside], RED.expand(12, 12, 3))
    assert drawn.alpha[0, inside, inside].min() == 1
    assert drawn.depth is not None
    torch.testing.assert_close(drawn.depth[0, inside, inside], torch.full((12, 12), 4.0))
    assert drawn.rgb[0, :3].min() == 1
    assert drawn.alpha[0, :3].max() == 0


def test_edges_are_as_sharp_when_enlarged() -> None:
    """A row has equally many partly covered pixels at 8 times the resolution."""
    rows = [scene_of(*SQUARE).render(camera(size)).alpha[0, size // 2] for size in (32, 256)]
    soft = [int(((row > 0.01) & (row < 0.99)).sum()) for row in rows]
    assert 0 < soft[0] <= 8
    assert soft[1] == soft[0]


def test_harmonics_tell_directions_apart() -> None:
    patches = bent(1)
    there = camera()
    back = camera()
    # from behind, half a turn about y
    back.cam_from_world[0, 0, 0] = back.cam_from_world[0, 2, 2] = -1
    front, behind = (TriangleScene(patches, 1.0).render(x) for x in (there, back))
    assert front.rgb.sum() > 0
    assert behind.rgb.sum() > 0
    plain = replace(patches, harmonics=torch.zeros_like(patches.harmonics))
    for view, cam in ((front, there), (behind, back)):
        without = TriangleScene(plain, 1.0).render(cam)
        change = (view.rgb - without.rgb)[without.transmittance < 0.01]
        assert change.abs().max() > 0.01


def test_gradients_reach_everything() -> None:
    patches = bent(4)
    leaves = {name: x.clone().requires_grad_() for name, x in patches.tensors.items()}
    learned = replace(patches, **leaves)
    TriangleScene(learned, 1.0).render(
        camera(), background=torch.ones(3)
    ).rgb.square().sum().backward()
    for x in learned.tensors.values():
        assert x.grad is not None
        assert x.grad.abs().sum() > 0
        assert bool(x.grad.isfinite().all())


def test_triangles_without_area_are_not_drawn_and_keep_gradients_finite() -> None:
    """All points equal, on a line, not a number, behind the camera and much larger than the scene,
    with a good one."""
    nan = SQUARE[0].clone()
    nan[0, 2, 1] = torch.nan
    wide = triangle((-1e5, 1e5, -9), (1e5, 1e5, -9), (0, -1e5, -9))
    prunable = [
        triangle(*[(0.2, 0.1, -1)] * 3),
        triangle((-1, 0, -1), (0, 0, -1), (1, 0, -1)),
        nan,
        wide,
    ]
    alone = scene_of(SQUARE[0])
    together = scene_of(SQUARE[0], *prunable)
    points = together.patches.points.clone().requires_grad_()
    drawn = replace(together, patches=replace(together.patches, points=points)).render(camera())
    assert torch.equal(drawn.rgb, alone.render(camera()).rgb)
    drawn.rgb.square().sum().backward()
    assert points.grad is not None
    assert points.grad[0].abs().sum() > 0
    assert points.grad[1:].abs().max() == 0
