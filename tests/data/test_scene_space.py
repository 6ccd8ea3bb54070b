"""The space that cameras see, random points in it, and scenes far from the origin."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from tiny_captures import opengl_pose

from dyngs.data.capture import Capture, PointCloud, View, all_views
from dyngs.data.geometry import (
    camera_center,
    count_visible_views,
    from_opengl_pose,
    pinhole_matrix,
    project_points,
    validate_pose,
)
from dyngs.data.scene_space import (
    FAR_PER_BASELINE,
    change_coordinates,
    cube_mismatch_reason,
    depth_bounds,
    normalise_capture,
    sample_points_in_frusta,
)


def circle(
    offset: tuple[float, float, float] = (0.0, 0.0, 0.0), scale: float = 1.0, count: int = 12
) -> list[View]:
    """Cameras on a circle of radius 4 that look at ``offset``."""
    views = []
    for i in range(count):
        pose = opengl_pose(2 * np.pi * i / count)
        pose[:3, 3] = scale * pose[:3, 3] + offset
        k = pinhole_matrix(60.0, 60.0, 20.0, 15.0)
        views.append(View(str(i), Path(f"{i}.png"), from_opengl_pose(pose), k, 40, 30))
    return views


def test_the_cube_is_seen_or_not() -> None:
    assert cube_mismatch_reason(circle(), 1.3) is None
    assert "look at (7, -3, 11)" in (cube_mismatch_reason(circle((7.0, -3.0, 11.0)), 1.3) or "")
    # Far too near: only a few points of the cube are in two images.
    assert "of the cube of half side 1.3" in (
        cube_mismatch_reason(circle(scale=0.2, count=2), 1.3) or ""
    )


@pytest.mark.parametrize("scale", [0.01, 1.0, 100.0])
def test_bounds_follow_the_unit_of_the_world(scale: float) -> None:
    near, far = depth_bounds(circle((1.0, 2.0, 3.0), scale))
    distance = scale * 4 * np.sqrt(1.25)
    assert near == pytest.approx(distance / 4)
    assert far == pytest.approx(FAR_PER_BASELINE * 8 * scale)


def capture_at(offset: np.ndarray, radius: float = 4.0, count: int = 6) -> Capture:
    poses = [opengl_pose(0.5 * i, radius) for i in range(count)]
    for pose in poses:
        pose[:3, 3] += offset
    views = tuple(
        View(str(i), Path(f"{i}.png"), from_opengl_pose(pose), np.eye(3), 1, 1)
        for i, pose in enumerate(poses)
    )
    points = PointCloud(offset + np.arange(6.0).reshape(2, 3), np.zeros((2, 3), np.uint8))
    return Capture(Path(), "colmap", {"train": views[:-1], "test": views[-1:]}, points)


def scaled(capture: Capture, factor: float) -> Capture:
    """Return the capture as if its files had a unit of length ``1 / factor`` as long."""
    capture = change_coordinates(capture, 1 / factor, np.zeros(3))
    return capture.replace(world_scale=1.0)


def file_centers(capture: Capture) -> np.ndarray:
    """Return the camera centres (V, 3) in the coordinates of the files."""
    centers = np.array([camera_center(view.cam_from_world) for view in all_views(capture.splits)])
    return capture.world_scale * centers + capture.world_offset


@settings(max_examples=25, deadline=None)
@given(
    st.lists(st.floats(-5e6, 5e6), min_size=3, max_size=3).filter(
        lambda xs: np.linalg.norm(xs) > 2e5
    )
)
def test_far_world_comes_to_the_origin_and_back(offset: list[float]) -> None:
    """The scene keeps its shape to 1e-8 units (float64 at 1e6 has 1e-10), and the offset restores
    it."""
    before = capture_at(np.array(offset))
    after = normalise_capture(before)
    assert np.linalg.norm(after.world_offset - offset) < 10
    np.testing.assert_allclose(file_centers(after), file_centers(before), rtol=0, atol=1e-8)
    for moved, view in zip(all_views(after.splits), all_views(before.splits), strict=True):
        np.testing.assert_array_equal(moved.cam_from_world[:3, :3], view.cam_from_world[:3, :3])
    assert after.points is not None
    assert before.points is not None
    xyz = after.world_scale * after.points.xyz + after.world_offset
    np.testing.assert_allclose(xyz, before.points.xyz, rtol=0, atol=1e-8)


@pytest.mark.parametrize("scale", [2.0**-13, 2.0**-4, 2.0**10])
@pytest.mark.parametrize("offset", [0.0, 5e7])
def test_power_of_two_scale_gives_the_same_scene_coordinates(scale: float, offset: float) -> None:
    before = capture_at(np.array([offset, 0.0, 0.0]))
    one = normalise_capture(before)
    other = normalise_capture(scaled(before, scale))
    assert other.world_scale == scale * one.world_scale
    np.testing.assert_array_equal(other.world_offset, scale * one.world_offset)
    for a, b in zip(all_views(one.splits), all_views(other.splits), strict=True):
        np.testing.assert_array_equal(a.cam_from_world, b.cam_from_world)
    assert one.points is not None
    assert other.points is not None
    np.testing.assert_array_equal(one.points.xyz, other.points.xyz)


@pytest.mark.parametrize("jitter", [0.0, 1e-9])
def test_fixed_camera_stays_where_it_is(jitter: float) -> None:
    """Coinciding camera centres give no scale, and random points around the origin must stay in
    view."""
    view = capture_at(np.zeros(3)).splits["train"][0]
    moved = [view.cam_from_world + np.diag([jitter * i, 0, 0], 1) for i in range(5)]
    views = tuple(
        View(str(i), view.image_path, pose, np.eye(3), 1, 1) for i, pose in enumerate(moved)
    )
    capture = Capture(Path(), "blender", {"train": views})
    assert normalise_capture(capture) is capture


def test_checked_pose_reports_how_far_off_it_was() -> None:
    pose = opengl_pose(1.1)
    pose[:3, :3] *= 1 + 1e-4
    repaired, error = validate_pose(pose[:3], "here")
    assert error == pytest.approx(2e-4, rel=1e-3)
    np.testing.assert_allclose(repaired, opengl_pose(1.1), atol=1e-12)


def test_candidates_lie_in_their_view_between_the_bounds() -> None:
    views = circle((5.0, 0.0, 0.0))
    near, far = depth_bounds(views)
    xyz, seen = sample_points_in_frusta(views, np.random.default_rng(0).random((500, 4)))
    assert seen.min() >= 1
    np.testing.assert_array_equal(seen, count_visible_views(xyz, views))
    depths = np.stack(
        [xyz @ view.cam_from_world[2, :3] + view.cam_from_world[2, 3] for view in views]
    )
    shown = np.stack([project_points(xyz, view)[1] for view in views])
    fits = shown & (depths > near * 0.999) & (depths < far * 1.001)
    assert fits.any(axis=0).all()
