"""Depth bounds and random points of what cameras see; scenes around the origin and elsewhere."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from tiny_captures import opengl_pose

from dyngs.data.capture import View
from dyngs.data.geometry.frusta import FAR_PER_BASELINE, depth_bounds, outside_of_cube, points_in_frusta
from dyngs.data.geometry.intrinsics import pinhole_matrix
from dyngs.data.geometry.poses import cam_from_opengl
from dyngs.data.geometry.projection import projected, times_seen


def circle(offset: tuple[float, float, float] = (0.0, 0.0, 0.0), scale: float = 1.0, count: int = 12) -> list[View]:
    """Cameras on a circle of radius 4 that look at ``offset``."""
    views = []
    for i in range(count):
        pose = opengl_pose(2 * np.pi * i / count)
        pose[:3, 3] = scale * pose[:3, 3] + offset
        k = pinhole_matrix(60.0, 60.0, 20.0, 15.0)
        views.append(View(str(i), Path(f"{i}.png"), cam_from_opengl(pose), k, 40, 30))
    return views


def test_the_cube_is_seen_or_not() -> None:
    assert outside_of_cube(circle(), 1.3) is None
    assert "look at (7, -3, 11)" in (outside_of_cube(circle((7.0, -3.0, 11.0)), 1.3) or "")
    # Far too near: only a few points of the cube are in two images.
    assert "of the cube of half side 1.3" in (outside_of_cube(circle(scale=0.2, count=2), 1.3) or "")


@pytest.mark.parametrize("scale", [0.01, 1.0, 100.0])
def test_bounds_follow_the_unit_of_the_world(scale: float) -> None:
    near, far = depth_bounds(circle((1.0, 2.0, 3.0), scale))
    distance = scale * 4 * np.sqrt(1.25)
    assert near == pytest.approx(distance / 4)
    assert far == pytest.approx(FAR_PER_BASELINE * 8 * scale)


def test_bounds_of_parallel_axes_and_of_one_place() -> None:
    views = [circle()[0]] * 2
    assert depth_bounds(views) == (0.25, FAR_PER_BASELINE)
    pose = views[0].cam_from_world.copy()
    pose[0, 3] += 3.0
    parallel = [views[0], View("b", Path("b.png"), pose, views[0].intrinsics, 40, 30)]
    assert depth_bounds(parallel) == (pytest.approx(0.75), pytest.approx(3 * FAR_PER_BASELINE))


def test_candidates_lie_in_their_view_between_the_bounds() -> None:
    views = circle((5.0, 0.0, 0.0))
    near, far = depth_bounds(views)
    xyz, seen = points_in_frusta(views, np.random.default_rng(0).random((500, 4)))
    assert seen.min() >= 1
    np.testing.assert_array_equal(seen, times_seen(xyz, views))
    depths = np.stack([xyz @ view.cam_from_world[2, :3] + view.cam_from_world[2, 3] for view in views])
    shown = np.stack([projected(xyz, view)[1] for view in views])
    fits = shown & (depths > near * 0.999) & (depths < far * 1.001)
    assert fits.any(axis=0).all()


def test_places_in_a_image() -> None:
    view = View("a", Path("a.png"), np.eye(4), pinhole_matrix(10.0, 10.0, 20.0, 15.0), 40, 30)
    places, inside = projected(np.array([[0.0, 0, 1], [1, 0, 1], [0, 0, -1], [3, 0, 1]]), view)
    np.testing.assert_allclose(places[:2], [[0.5, 0.5], [0.75, 0.5]])
    assert inside.tolist() == [True, True, False, False]
