"""Rectified views against known answers: rows correspond, true depth gives back points, faults are
told."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from ray_traced_ball import CENTER, RADIUS, SIZE, ball, exact_depth, pose_at

from dyngs.core.camera import Cameras
from dyngs.core.errors import DyngsError
from dyngs.human.predict.gps.rectification import RectifiedPair, rectify_views
from dyngs.human.predict.people import crop_to_person


@pytest.fixture(params=[(0, 30, 0.0, 0.0), (-10, 35, 0.15, 4.0), (170, 192, -0.1, -3.0)])
def pair(request: pytest.FixtureRequest) -> RectifiedPair:
    """Level cameras; cameras at other heights, rolled; behind the ball."""
    first, second, rise, roll = request.param
    return rectify_views(ball(pose_at(first)), ball(pose_at(second, 1.1 + rise, 3.2, roll)), 64)


def test_true_depth_gives_back_the_points(pair: RectifiedPair) -> None:
    """To 1e-4, through offsets and back."""
    depth = exact_depth(pair)
    offsets = pair.focal * pair.baseline / depth - pair.shift
    points = pair.points(pair.depth(offsets))[pair.alpha[:, 0] > 0.999]
    away = (points - CENTER).norm(dim=1)
    assert (away - RADIUS).abs().max() < 1e-4


def test_rows_correspond(pair: RectifiedPair) -> None:
    """A point of one window is seen in the other one in the same row, shifted by its disparity."""
    left, right = pair.points(exact_depth(pair))
    for points, own, other in ((left, 0, 1), (right, 1, 0)):
        seen = (points - pair.centers[other]) @ pair.rect_from_world.T
        column = pair.focal * seen[..., 0] / seen[..., 2] + pair.principal[other, 0]
        row = pair.focal * seen[..., 1] / seen[..., 2] + pair.principal[other, 1]
        height, width = row.shape
        solid = pair.alpha[own, 0] > 0.999
        rows = (torch.arange(height) + 0.5)[:, None].expand(-1, width)
        assert (row - rows)[solid].abs().max() < 2e-3
        offsets = pair.focal * pair.baseline / seen[..., 2] - pair.shift
        side = 1.0 if own == 0 else -1.0
        columns = (torch.arange(width) + 0.5)[None].expand(height, -1)
        assert (column - (columns - side * offsets))[solid].abs().max() < 2e-3
        expected = 0.5 + 0.4 * torch.sin(3 * points)
        inner = solid
        assert (pair.rgb[own].permute(1, 2, 0) - expected)[inner].abs().max() < 0.03, (
            "bilinear, at 96 px"
        )


def test_depth_maps_become_true_offsets(pair: RectifiedPair) -> None:
    exact = pair.focal * pair.baseline / exact_depth(pair) - pair.shift
    known = pair.offsets.isfinite() & (pair.alpha > 0.999)
    assert known.sum() > 1000
    error = (pair.offsets - exact)[known]
    assert error.abs().median() < 0.02
    assert error.abs().quantile(0.9) < 0.5, (
        "at the outline, where depth is steep, that of the nearest pixel"
    )
    without = rectify_views(*(replace(ball(pose_at(x)), depth=None) for x in (0, 30)), 64)
    assert without.offsets.isnan().all()


def test_views_that_cannot_show_the_same_are_refused() -> None:
    left = ball(pose_at(0))
    right = ball(pose_at(30), name="b")
    camera = right.cameras
    longer = camera.intrinsics * torch.tensor([[1.4], [1.4], [1.0]])
    with pytest.raises(DyngsError, match="a and b: silhouettes do not match the cameras"):
        rectify_views(left, replace(right, cameras=replace(camera, intrinsics=longer)), 64)
    with pytest.raises(DyngsError, match="a and b: silhouettes do not match the cameras"):
        rectify_views(
            replace(left, cameras=aside(left.cameras, 25)),
            replace(right, cameras=aside(camera, -25)),
            64,
        )
    for alpha in (None, torch.zeros(SIZE, SIZE)):
        with pytest.raises(DyngsError, match="b: no silhouette"):
            rectify_views(left, replace(right, alpha=alpha), 64)


def aside(camera: Cameras, degrees: float) -> Cameras:
    """Turned about its vertical, while it shows the same."""
    c = np.cos(np.radians(degrees))
    s = np.sin(np.radians(degrees))
    turn = torch.tensor(
        [[c, 0, s, 0], [0, 1, 0, 0], [-s, 0, c, 0], [0, 0, 0, 1]], dtype=torch.float32
    )
    return replace(camera, cam_from_world=(turn @ camera.cam_from_world[0])[None])


def test_a_crop_is_the_same_part_of_the_view() -> None:
    whole = ball(pose_at(0))
    part = crop_to_person(whole, 4)
    assert whole.alpha is not None
    assert part.alpha is not None
    assert part.alpha.sum() == whole.alpha.sum()
    rows, columns = ((part.alpha > 0).any(side).nonzero() for side in (1, 0))
    assert (int(rows.min()), int(columns.min())) == (4, 4)
    assert part.alpha.shape == (part.cameras.height, part.cameras.width)
    first, second = (
        (
            image.cameras.intrinsics[0]
            @ (
                image.cameras.cam_from_world[0, :3, :3] @ CENTER
                + image.cameras.cam_from_world[0, :3, 3]
            )
        )
        for image in (whole, part)
    )
    moved = first[:2] / first[2] - second[:2] / second[2]
    row, column = (int(x) for x in moved.round().flip(0))
    height, width = part.alpha.shape
    assert torch.equal(
        whole.rgb_premultiplied[row : row + height, column : column + width], part.rgb_premultiplied
    )
