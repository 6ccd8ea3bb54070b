"""Image features sampled at points, and the small networks."""

from __future__ import annotations

import torch

from dyngs.human.predict.fields.network import SourceFeatures
from dyngs.human.predict.people import Sources

FOCAL, WIDTH, HEIGHT = 20.0, 32, 24


def seen() -> SourceFeatures:
    """Two cameras 4 m before and behind the origin; red is the column, green the row, px, times
    alpha 0.5."""
    poses = torch.eye(4).repeat(2, 1, 1)
    poses[1, :3, :3] = torch.diag(torch.tensor([-1.0, 1.0, -1.0]))
    poses[:, 2, 3] = 4.0
    k = torch.tensor([[FOCAL, 0, WIDTH / 2], [0, FOCAL, HEIGHT / 2], [0, 0, 1]]).repeat(2, 1, 1)
    rows, columns = torch.meshgrid(
        torch.arange(HEIGHT) + 0.5, torch.arange(WIDTH) + 0.5, indexing="ij"
    )
    half = torch.full_like(rows, 0.5)
    rgba = torch.stack([0.5 * columns, 0.5 * rows, 0 * rows, half]).repeat(2, 1, 1, 1)
    return SourceFeatures(Sources(rgba, poses, k), rgba[:, :3, ::4, ::4], rgba[:, :2, ::2, ::2])


def test_points_show_what_their_pixels_show() -> None:
    points = torch.tensor([[0.5, -0.25, 0.0], [0.2, 0.1, 1.0], [0.0, 0.0, -9.0], [9.0, 0.0, 0.0]])
    looked = seen().sample(points)
    for view, sign in ((0, 1.0), (1, -1.0)):
        depth = sign * points[:2, 2] + 4
        column = sign * FOCAL * points[:2, 0] / depth + WIDTH / 2
        row = FOCAL * points[:2, 1] / depth + HEIGHT / 2
        torch.testing.assert_close(looked.rgb[view, :2, :2], torch.stack([column, row], 1))
    torch.testing.assert_close(looked.alpha[:, :2], torch.full((2, 2), 0.5))
    assert looked.alpha[0, 2] == 0, "behind the camera"
    assert looked.alpha[1, 2] == 0.5, "13 m before the other one"
    assert bool((looked.alpha[:, 3] == 0).all()), "beside the images"
    assert looked.features.shape == (2, 4, 5)
