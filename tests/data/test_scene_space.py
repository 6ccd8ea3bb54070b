"""The space that cameras see, random points in it, and scenes far from the origin."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from tiny_captures import opengl_pose

from dyngs.core.errors import DyngsError
from dyngs.data.body_frames import body_frames, of_one_clip
from dyngs.data.capture import Capture, PointCloud, View, all_views
from dyngs.data.geometry import (
    cam_from_opengl,
    camera_center,
    checked_pose,
    inverse_rigid,
    pinhole_matrix,
    projected,
    times_seen,
)
from dyngs.data.scene_space import (
    FAR_PER_BASELINE,
    SMALLEST_EXTENT,
    change_coordinates,
    depth_bounds,
    extent_of,
    normalise_capture,
    outside_of_cube,
    points_in_frusta,
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
        views.append(View(str(i), Path(f"{i}.png"), cam_from_opengl(pose), k, 40, 30))
    return views


def test_the_cube_is_seen_or_not() -> None:
    assert outside_of_cube(circle(), 1.3) is None
    assert "look at (7, -3, 11)" in (outside_of_cube(circle((7.0, -3.0, 11.0)), 1.3) or "")
    # Far too near: only a few points of the cube are in two images.
    assert "of the cube of half side 1.3" in (
        outside_of_cube(circle(scale=0.2, count=2), 1.3) or ""
    )


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
    depths = np.stack(
        [xyz @ view.cam_from_world[2, :3] + view.cam_from_world[2, 3] for view in views]
    )
    shown = np.stack([projected(xyz, view)[1] for view in views])
    fits = shown & (depths > near * 0.999) & (depths < far * 1.001)
    assert fits.any(axis=0).all()


def test_places_in_a_image() -> None:
    view = View("a", Path("a.png"), np.eye(4), pinhole_matrix(10.0, 10.0, 20.0, 15.0), 40, 30)
    places, inside = projected(np.array([[0.0, 0, 1], [1, 0, 1], [0, 0, -1], [3, 0, 1]]), view)
    np.testing.assert_allclose(places[:2], [[0.5, 0.5], [0.75, 0.5]])
    assert inside.tolist() == [True, True, False, False]


def capture_at(offset: np.ndarray, radius: float = 4.0, count: int = 6) -> Capture:
    poses = [opengl_pose(0.5 * i, radius) for i in range(count)]
    for pose in poses:
        pose[:3, 3] += offset
    views = tuple(
        View(str(i), Path(f"{i}.png"), cam_from_opengl(pose), np.eye(3), 1, 1)
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


@pytest.mark.parametrize("scale", [1.0, 1e-4, 300.0])
def test_projection_does_not_change(scale: float) -> None:
    before = scaled(capture_at(np.array([1e6, -2e6, 3e5])), scale)
    after = normalise_capture(before)
    assert before.points is not None
    assert after.points is not None
    for old, new in zip(before.splits["train"], after.splits["train"], strict=True):
        wanted = before.points.xyz @ old.cam_from_world[:3, :3].T + old.cam_from_world[:3, 3]
        found = after.points.xyz @ new.cam_from_world[:3, :3].T + new.cam_from_world[:3, 3]
        np.testing.assert_allclose(found * after.world_scale, wanted, atol=1e-8 * scale)


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


@pytest.mark.parametrize("scale", [1e-6, 0.05, 0.7, 1.0, 1e5])
def test_extent_of_a_normalised_scene(scale: float) -> None:
    capture = normalise_capture(scaled(capture_at(np.zeros(3)), scale))
    centers = np.array([camera_center(view.cam_from_world) for view in all_views(capture.splits)])
    assert SMALLEST_EXTENT <= extent_of(centers) < 2 * SMALLEST_EXTENT


@pytest.mark.parametrize(
    ("distance", "radius", "moves"), [(5.0, 4.0, False), (350, 4.0, False), (900, 4.0, True)]
)
def test_only_far_scenes_move(distance: float, radius: float, moves: bool) -> None:
    capture = capture_at(np.array([distance, 0, 0]), radius)
    assert normalise_capture(capture).world_offset.any() == moves


def test_small_capture_at_utm_coordinates_without_points() -> None:
    """Cameras 20 cm apart, 4,600 km from the origin: in float32 they would coincide."""
    capture = capture_at(np.array([5e5, 4.6e6, 100.0]), radius=0.2).replace(points=None)
    capture = normalise_capture(capture)
    centers = np.array([camera_center(view.cam_from_world) for view in all_views(capture.splits)])
    assert SMALLEST_EXTENT <= extent_of(centers) < 2 * SMALLEST_EXTENT
    assert np.abs(centers).max() < 10 * SMALLEST_EXTENT


@pytest.mark.parametrize("jitter", [0.0, 1e-9])
def test_fixed_camera_stays_where_it_is(jitter: float) -> None:
    """All centres coincide, so nothing tells a length; random points around the origin must stay in
    its view."""
    view = capture_at(np.zeros(3)).splits["train"][0]
    moved = [view.cam_from_world + np.diag([jitter * i, 0, 0], 1) for i in range(5)]
    views = tuple(
        View(str(i), view.image_path, pose, np.eye(3), 1, 1) for i, pose in enumerate(moved)
    )
    capture = Capture(Path(), "blender", {"train": views})
    assert normalise_capture(capture) is capture


def test_fixed_camera_gets_its_unit_from_the_points() -> None:
    before = scaled(capture_at(np.zeros(3)), 1e-3)
    view = before.splits["train"][0]
    capture = normalise_capture(before.replace(splits={"train": (view,)}))
    assert capture.points is not None
    depth = np.median(
        np.linalg.norm(
            capture.points.xyz - camera_center(capture.splits["train"][0].cam_from_world)
        )
    )
    assert 1 < depth < 20


def test_capture_in_the_coordinates_of_its_files_and_back() -> None:
    before = capture_at(np.array([3e4, 0.0, 0.0]), radius=0.01)
    after = normalise_capture(before)
    assert after.world_scale != 1
    assert after.world_offset.any()
    np.testing.assert_allclose(
        file_centers(change_coordinates(after, 1.0, np.zeros(3))), file_centers(before), atol=1e-11
    )
    assert change_coordinates(after, after.world_scale, after.world_offset) is after


def test_inverse_of_a_pose() -> None:
    pose = opengl_pose(1.1)
    np.testing.assert_allclose(inverse_rigid(pose) @ pose, np.eye(4), atol=1e-14)


def test_checked_pose_reports_how_far_off_it_was() -> None:
    pose = opengl_pose(1.1)
    pose[:3, :3] *= 1 + 1e-4
    repaired, error = checked_pose(pose[:3], "here")
    assert error == pytest.approx(2e-4, rel=1e-3)
    np.testing.assert_allclose(repaired, opengl_pose(1.1), atol=1e-12)


def test_infinite_position_is_an_error() -> None:
    pose = opengl_pose(0.0)
    pose[1, 3] = np.inf
    with pytest.raises(DyngsError, match="here: the pose holds NaN"):
        checked_pose(pose, "here")


def test_bodies_move_and_scale_with_the_cameras() -> None:
    body = body_frames(
        Path("b"), [0], np.zeros((1, 72)), [[1e6, 2.0, 3.0]], np.zeros(10), scale=0.5
    )
    capture = Capture(Path("x"), "blender", {}).replace(body=of_one_clip(body))
    moved = change_coordinates(capture, 0.5, np.array([1e6, 0.0, 0.0]))
    assert moved.body is not None
    assert moved.body["train"].trans.tolist() == [[0.0, 4.0, 6.0]]
    assert moved.body["train"].scale.tolist() == [1.0]


def test_unit_of_people_is_the_metre() -> None:
    body = body_frames(
        Path("b"), [0], np.zeros((1, 72)), [[0.1, 2.0, 3.0]], np.zeros(10), scale=1e-3
    )
    capture = normalise_capture(capture_at(np.zeros(3)).replace(body=of_one_clip(body)))
    assert capture.world_scale == 2.0**-10
    assert capture.body is not None
    assert capture.body["train"].scale.tolist() == [1.024]
