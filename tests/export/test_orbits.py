"""Orbits: the centre that cameras face, their up direction and the camera paths."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import torch
from camera_rings import UP, assert_rigid, cameras_at, forward_facing, ring_of
from hypothesis import given, settings
from hypothesis import strategies as st

from dyngs.core.camera import Cameras
from dyngs.core.errors import DyngsError
from dyngs.data.geometry import estimate_focus, look_at, up_direction
from dyngs.export.orbits import frame_orbit_for_points, orbit_path, path_along, spiral_path

ORIGIN = np.zeros(3)


def orbit(cameras: Cameras, count: int, up: np.ndarray | None = None) -> Cameras:
    return orbit_path(cameras, count, up)[0].cameras


def looking_in(eyes: list[tuple[float, float, float]], target: np.ndarray = ORIGIN) -> Cameras:
    return cameras_at(np.stack([look_at(np.array(eye), target, UP) for eye in eyes]))


def test_parallel_cameras_look_forward() -> None:
    cameras = forward_facing(8)
    assert estimate_focus(cameras)[1] > 1.0
    np.testing.assert_allclose(up_direction(cameras), UP, atol=1e-9)


@settings(max_examples=15, deadline=None)
@given(st.floats(0.5, 8), st.floats(0.6, 3))
def test_cameras_on_one_side_that_look_down_know_what_is_up(height: float, arc: float) -> None:
    angles = np.linspace(0, arc, 9)
    cameras = looking_in([(4 * np.cos(a), 4 * np.sin(a), height) for a in angles])
    np.testing.assert_allclose(up_direction(cameras), UP, atol=1e-9)


@pytest.mark.parametrize(("roll", "is_level"), [(5.0, True), (15.0, False)])
def test_cameras_that_are_not_held_level_have_the_mean_of_their_ups(
    roll: float, is_level: bool
) -> None:
    """Half a circle of cameras that look down by 30 degrees, rolled to either side by turns."""
    poses = []
    for k, azimuth in enumerate(np.linspace(0, np.pi, 40)):
        forward = np.array([np.cos(azimuth) * 0.866, np.sin(azimuth) * 0.866, -0.5])
        pose = look_at(ORIGIN, forward, UP)
        c, s = np.cos(np.radians(roll)), np.sin(np.radians(roll)) * (-1) ** k
        pose[:3, :3] = pose[:3, :3] @ np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]])
        poses.append(pose)
    assert (up_direction(cameras_at(np.stack(poses))) @ UP > 0.99) == is_level


@settings(max_examples=15, deadline=None)
@given(st.tuples(*[st.floats(-10, 10)] * 3), st.integers(3, 12))
def test_orbit_of_a_ring_is_the_ring(target: tuple[float, float, float], count: int) -> None:
    ring = ring_of(count, np.array(target))
    path, is_all_around = orbit_path(ring, count)
    torch.testing.assert_close(path.cameras.cam_from_world, ring.cam_from_world, atol=1e-6, rtol=0)
    assert (path.notes, is_all_around) == ((), True)


def test_orbit_moves_with_the_scene() -> None:
    motion = look_at(
        np.array([3.0, -2.0, 7.0]), np.array([1.0, 1.0, 1.0]), np.array([0.3, 1.0, 0.2])
    )
    for path, cameras in ((orbit, ring_of(5, ORIGIN)), (spiral_path, forward_facing(5))):
        moved = cameras_at(motion @ np.linalg.inv(cameras.cam_from_world.numpy()))
        expected = path(cameras, 7).cam_from_world @ torch.from_numpy(np.linalg.inv(motion))
        torch.testing.assert_close(path(moved, 7).cam_from_world, expected, atol=1e-6, rtol=0)


ABOVE = cameras_at(look_at(np.array([0, 0, 5.0]), ORIGIN, np.array([0, 1.0, 0]))[None])


@pytest.mark.parametrize(
    "cameras", [ring_of(1, ORIGIN), forward_facing(6), ring_of(2, np.ones(3)), ABOVE]
)
@pytest.mark.parametrize(
    "path", [orbit, spiral_path, lambda cameras, count: path_along(cameras, count).cameras]
)
def test_odd_camera_sets_give_finite_rigid_paths(cameras: Cameras, path: Any) -> None:
    made = path(cameras, 9)
    assert len(made) == 9
    assert torch.isfinite(made.cam_from_world).all()
    assert_rigid(made)


def test_a_spiral_rises_first_stays_near_and_closes() -> None:
    heights = spiral_path(forward_facing(6), 8).centers.double().numpy() @ UP
    assert heights[1] > heights[0] > heights[3]  # as in LLFF
    cameras = forward_facing(20)
    centers = spiral_path(cameras, 40).centers
    assert (centers.abs() < 3 * cameras.centers.abs().max()).all()
    steps = (centers.roll(-1, 0) - centers).norm(dim=1)
    assert steps.max() < 2.5 * steps.median()


@settings(max_examples=15, deadline=None)
@given(
    st.sampled_from([(0, 0, 1), (0, -1, 0), (1, 2, 3)]), st.floats(0.01, 1000), st.integers(1, 5)
)
def test_points_fill_the_image(up: tuple[float, float, float], scale: float, frames: int) -> None:
    rng = np.random.default_rng(0)
    points = scale * (np.array([5.0, -3.0, 2.0]) + rng.normal(size=(3000, 3)).clip(-2, 2))
    stray = np.concatenate([points, np.full((5, 3), 1e6 * scale), [[np.nan] * 3]])
    made = frame_orbit_for_points(stray, frames, (80, 60), up)
    assert_rigid(made)
    for pose, k in zip(made.cam_from_world.double(), made.intrinsics.double(), strict=True):
        local = points @ pose[:3, :3].numpy().T + pose[:3, 3].numpy()
        pixels = (local @ k.numpy().T)[:, :2] / local[:, 2:]
        inside = ((pixels > 0) & (pixels < [80, 60])).all(axis=1) & (local[:, 2] > 0)
        assert inside.mean() > 0.9
        assert np.ptp(pixels[inside], axis=0).max() > 30
        assert pose[1, :3].numpy() @ up < 0, "y points down, away from up"


def test_no_points_are_one_line() -> None:
    with pytest.raises(DyngsError, match="no points"):
        frame_orbit_for_points(np.full((3, 3), np.nan), 4)
    assert torch.isfinite(frame_orbit_for_points(np.zeros((3, 3)), 4).cam_from_world).all()


@settings(max_examples=15, deadline=None)
@given(st.floats(20, 230), st.integers(6, 30), st.floats(-180, 180))
def test_an_orbit_stays_on_the_filmed_arc(degrees: float, count: int, turned: float) -> None:
    angles = np.radians(np.linspace(-degrees / 2, degrees / 2, count) + turned)
    cameras = looking_in([(4 * np.cos(a), 4 * np.sin(a), 1.5) for a in angles])
    path, is_all_around = orbit_path(cameras, 24)
    centers = path.cameras.centers.numpy()
    nearest = np.linalg.norm(centers[:, None] - cameras.centers.numpy(), axis=-1).min(axis=1)
    spacing = 2 * 4 * np.sin(np.radians(degrees / (count - 1)) / 2)
    assert nearest.max() < 0.55 * spacing + 1e-6, "always between two cameras"
    covered = np.linalg.norm(centers[:, None] - centers, axis=-1).max()
    reach = 2 * 4 * np.sin(np.radians(min(degrees, 180)) / 2)
    assert covered > 0.98 * reach * (degrees < 180), "to both ends"
    assert f"arc of {degrees:.0f} degrees" in path.notes[0]
    assert not is_all_around
    steps = np.linalg.norm(centers - np.roll(centers, 1, axis=0), axis=1)
    assert steps.max() < 0.5 * np.radians(degrees) * 4 * 2 * np.pi / 24 * 1.01, "it closes"


def test_an_arc_orbit_keeps_the_height_of_the_cameras_near() -> None:
    angles = np.linspace(-0.8, 0.8, 15)
    cameras = looking_in([(4 * np.cos(a), 4 * np.sin(a), 2 + 2 * a) for a in angles])
    centers = orbit(cameras, 40, UP).centers.numpy()
    azimuths = np.arctan2(centers[:, 1], centers[:, 0])
    assert np.corrcoef(centers[:, 2], azimuths)[0, 1] > 0.99
    assert np.ptp(centers[:, 2]) > 1.5


def test_error_for_outward_cameras_names_another_path() -> None:
    eyes = ring_of(12, ORIGIN, radius=0.5, height=0.0).centers.numpy()
    outward = cameras_at(np.stack([look_at(eye, 2 * eye, UP) for eye in eyes]))
    assert "--path along" in orbit_path(outward, 4)[0].notes[0]


def test_another_up_tilts_the_circle() -> None:
    leaning = np.array([0.0, 0.3, 1.0])
    for path in (orbit, spiral_path):
        made = path(ring_of(8, ORIGIN), 8, leaning)
        np.testing.assert_allclose(made.cam_from_world[:, 0, :3].numpy() @ leaning, 0, atol=1e-9)
        assert (made.cam_from_world[:, 1, :3].numpy() @ leaning < 0).all()
    heights = orbit(ring_of(8, ORIGIN), 8, leaning).centers.numpy() @ leaning
    np.testing.assert_allclose(heights, heights[0], atol=1e-9)


def walk(count: int, shake: float = 0.0) -> np.ndarray:
    """Poses of a walk along x that looks at a wall, shaken by a normal distribution."""
    rng = np.random.default_rng(1)
    eyes = np.stack([np.linspace(0, 10, count), np.zeros(count), np.ones(count)], axis=-1)
    eyes += shake * rng.normal(size=eyes.shape)
    return np.stack(
        [look_at(eye, eye + [0, 5, 0] + shake * rng.normal(size=3), UP) for eye in eyes]
    )


def test_a_shaken_walk_becomes_smooth() -> None:
    shaken = cameras_at(walk(60, shake=0.05))
    path = path_along(shaken, 60)
    assert_rigid(path.cameras)
    assert path.times is None
    centers = path.cameras.centers.numpy()
    unrest = [np.abs(np.diff(x, 2, axis=0)).mean() for x in (centers, shaken.centers.numpy())]
    assert unrest[0] < 0.2 * unrest[1]
    assert centers[0, 0] < 0.6
    assert centers[-1, 0] > 9.4
    steps = np.linalg.norm(np.diff(centers, axis=0), axis=1)
    assert steps.max() < 2.5 * steps.mean(), "at even speed"


@pytest.mark.parametrize("factor", [1e-9, 1e3])
def test_a_path_is_the_same_in_any_unit(factor: float) -> None:
    poses = walk(40, shake=0.05)[np.random.default_rng(2).permutation(40)]
    scaled = poses.copy()
    scaled[:, :3, 3] *= factor
    wanted, found = (path_along(cameras_at(x), 30).cameras.centers for x in (poses, scaled))
    np.testing.assert_allclose(found.numpy() / factor, wanted.numpy(), rtol=0, atol=1e-4)


def test_photos_in_any_order_become_a_walk() -> None:
    mixed = np.random.default_rng(2).permutation(40)
    mixed = np.concatenate([[0], mixed[mixed != 0]])
    centers = path_along(cameras_at(walk(40)[mixed]), 50).cameras.centers.numpy()
    assert (np.diff(centers[:, 0]) > 0).all(), "from the first photo to the other end, never back"


def test_a_clip_plays_in_its_own_time() -> None:
    times = (np.arange(20) / 19) ** 2
    path = path_along(cameras_at(walk(20)), 11, times.tolist())
    assert path.times is not None
    np.testing.assert_allclose(path.times, np.linspace(0, 1, 11))
    centers = path.cameras.centers.numpy()[:, 0]
    np.testing.assert_allclose(centers[3:9], 10 * np.sqrt(np.linspace(0, 1, 11))[3:9], atol=0.6)
    mixed = np.random.default_rng(3).permutation(20)
    again = path_along(cameras_at(walk(20)[mixed]), 11, times[mixed].tolist())
    np.testing.assert_allclose(again.cameras.centers.numpy()[:, 0], centers, atol=1e-9)


def test_fixed_cameras_are_visited_once_each() -> None:
    """Five cameras that stand, at four times each: the path is that of five cameras."""
    poses = np.linalg.inv(ring_of(5, ORIGIN).cam_from_world.numpy())
    times = np.repeat([0.0, 0.3, 0.6, 1.0], 5).tolist()
    many = path_along(cameras_at(np.tile(poses, (4, 1, 1))), 9, times)
    once = path_along(cameras_at(poses), 9).cameras
    np.testing.assert_allclose(many.cameras.centers.numpy(), once.centers.numpy(), atol=1e-9)
    assert many.times is None
