"""Cells outside all view frusta stay empty."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from dyngs.baselines.fields.ngp import cells_in_view
from dyngs.data.capture import View
from dyngs.data.geometry import project_points
from dyngs.ops.rays import Space


def view_from(position: tuple[float, float, float], turn: float) -> View:
    """A camera with a field of view of 53 by 37 degrees, rotated about the vertical axis."""
    rotation = np.array(
        [[np.cos(turn), 0, np.sin(turn)], [0, 1, 0], [-np.sin(turn), 0, np.cos(turn)]]
    )
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = rotation, -rotation @ np.array(position)
    return View("a", Path("a.png"), pose, np.array([[30.0, 0, 15], [0, 30, 10], [0, 0, 1]]), 30, 20)


VIEWS = [view_from((0.3, 0.1, -2.5), 0.0), view_from((0.5, -0.2, 0.4), 1.9)]


@pytest.mark.parametrize("cells", [12, 9])
def test_cells_in_any_frustum_may_be_occupied(cells: int) -> None:
    space = Space((0.2, 0.0, -0.3), 1.0, 3, cells)
    seen = cells_in_view(space, VIEWS)
    rng = np.random.default_rng(0)
    assert seen.shape == space.shape
    points = rng.uniform(-space.outermost, space.outermost, (20_000, 3)) + space.centre
    offsets = points - space.centre
    cascade = np.ceil(np.log2(np.maximum(np.abs(offsets).max(1), 1.0))).astype(int)
    cell = (
        np.floor((offsets / 2.0 ** cascade[:, None] + 1) * cells / 2).astype(int).clip(0, cells - 1)
    )
    may = seen.numpy()[cascade, cell[:, 2], cell[:, 1], cell[:, 0]]
    in_image = project_points(points, VIEWS[0])[1] | project_points(points, VIEWS[1])[1]
    assert 0.1 < in_image.mean() < 0.5
    assert may[in_image].all()
    assert may.mean() < in_image.mean() + 0.35, "not much more than that"
