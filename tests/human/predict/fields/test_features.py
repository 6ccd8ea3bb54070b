"""Image features sampled at points, and the small networks."""

from __future__ import annotations

from typing import Any

import torch

from dyngs.human.predict.fields.network import ImageEncoder, SourceFeatures
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


def test_features_are_sampled_where_convolutions_centre_them() -> None:
    """Feature i at 1/4 of the resolution is that of pixel 4 i, not of the middle of four."""
    down: Any = ImageEncoder(8).levels.down
    layers = [layer[0] for layer in down][:2]
    images = torch.randn(2, 4, HEIGHT, WIDTH, generator=torch.Generator().manual_seed(0))
    found = images
    for layer, stride in zip(layers, (2, 4), strict=True):
        torch.nn.init.dirac_(layer.weight)
        torch.nn.init.zeros_(layer.bias)
        found = layer(found)
        torch.testing.assert_close(found[:, :4], images[..., ::stride, ::stride])
    points = torch.tensor([[0.5, -0.25, 0.0], [0.2, 0.1, 1.0], [-0.4, 0.3, -0.5]])
    looked = seen().sample(points)
    colours = 0.5 * looked.rgb  # premultiplied, and linear in the image
    torch.testing.assert_close(looked.features[..., :2], colours[..., :2])
    torch.testing.assert_close(looked.features[..., 3:], colours[..., :2])
