"""Orbits and spirals: known circles, invariance under rigid motion, arcs that are not left."""

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
from dyngs.data.aim import look_at
from dyngs.export.camera_paths.orbit import (
    frame_orbit_for_points,
    orbit_of,
    orbit_path,
    spiral_path,
)


@settings(max_examples=15, deadline=None)
@given(st.tuples(*[st.floats(-10, 10)] * 3), st.integers(3, 12))
def test_orbit_of_a_ring_is_the_ring(target: tuple[float, float, float], count: int) -> None:
    ring = ring_of(count, np.array(target))
    orbit = orbit_path(ring, count)
    torch.testing.assert_close(orbit.cam_from_world, ring.cam_from_world, atol=1e-6, rtol=0)
    assert (orbit.width, orbit.height) == (64, 48)


def test_orbit_moves_with_the_scene() -> None:
    """A rigid motion of all cameras moves the orbit alike: no axis of the world is special."""
    motion = look_at(
        np.array([3.0, -2.0, 7.0]), np.array([1.0, 1.0, 1.0]), np.array([0.3, 1.0, 0.2])
    )
    for path, cameras in ((orbit_path, ring_of(5, np.zeros(3))), (spiral_path, forward_facing(5))):
        moved = cameras_at(motion @ np.linalg.inv(cameras.cam_from_world.numpy()))
        expected = path(cameras, 7).cam_from_world @ torch.from_numpy(np.linalg.inv(motion))
        torch.testing.assert_close(path(moved, 7).cam_from_world, expected, atol=1e-6, rtol=0)


@pytest.mark.parametrize(
    "cameras", [ring_of(1, np.zeros(3)), forward_facing(6), ring_of(2, np.ones(3))]
)
@pytest.mark.parametrize("path", [orbit_path, spiral_path])
def test_odd_camera_sets_give_finite_rigid_paths(cameras: Cameras, path: Any) -> None:
    made = path(cameras, 9)
    assert len(made) == 9
    assert torch.isfinite(made.cam_from_world).all()
    assert_rigid(made)


def test_a_spiral_rises_first() -> None:
    """As in LLFF: from the right up to the left, which is counterclockwise in the images."""
    heights = spiral_path(forward_facing(6), 8).centers.double().numpy() @ UP
    assert heights[1] > heights[0] > heights[3]


def test_a_camera_straight_above_still_orbits() -> None:
    made = orbit_path(
        cameras_at(look_at(np.array([0, 0, 5.0]), np.zeros(3), np.array([0, 1.0, 0]))[None]), 6
    )
    assert_rigid(made)
    assert torch.isfinite(made.cam_from_world).all()


def test_spiral_stays_near_the_cameras_and_closes() -> None:
    cameras = forward_facing(20)
    centers = spiral_path(cameras, 40).centers
    assert (centers.abs() < 3 * cameras.centers.abs().max()).all()
    steps = (centers.roll(-1, 0) - centers).norm(dim=1)
    assert steps.max() < 2.5 * steps.median(), "the last frame leads to the first without a jump"


@settings(max_examples=15, deadline=None)
@given(
    st.sampled_from([(0, 0, 1), (0, -1, 0), (1, 2, 3)]), st.floats(0.01, 1000), st.integers(1, 5)
)
def test_points_fill_the_image(up: tuple[float, float, float], scale: float, frames: int) -> None:
    rng = np.random.default_rng(0)
    center = np.array([5.0, -3.0, 2.0]) * scale
    points = center + scale * rng.normal(size=(3000, 3)).clip(-2, 2)
    stray = np.full((5, 3), 1e6 * scale)
    orbit = frame_orbit_for_points(
        np.concatenate([points, stray, [[np.nan] * 3]]), frames, (80, 60), up
    )
    assert_rigid(orbit)
    for pose, k in zip(
        orbit.cam_from_world.double().numpy(), orbit.intrinsics.double().numpy(), strict=True
    ):
        local = points @ pose[:3, :3].T + pose[:3, 3]
        pixels = (local @ k.T)[:, :2] / local[:, 2:]
        inside = ((pixels > 0) & (pixels < [80, 60])).all(axis=1) & (local[:, 2] > 0)
        assert inside.mean() > 0.9
        assert np.ptp(pixels[inside], axis=0).max() > 30
        assert pose[1, :3] @ up < 0, "y points down, away from up"


def test_no_points_or_no_up_is_one_line() -> None:
    with pytest.raises(DyngsError, match="no points"):
        frame_orbit_for_points(np.full((3, 3), np.nan), 4)
    with pytest.raises(DyngsError, match="no length"):
        frame_orbit_for_points(np.zeros((3, 3)), 4, up=(0, 0, 0))
    assert torch.isfinite(frame_orbit_for_points(np.zeros((3, 3)), 4).cam_from_world).all()


def _arc(degrees: float, count: int, tilt: float = 0.0) -> Cameras:
    """Return cameras on an arc around the origin, at radius 4 and height 1.5, the first ``tilt``
    degrees further."""
    angles = np.radians(np.linspace(-degrees / 2, degrees / 2, count) + tilt)
    eyes = np.stack([4 * np.cos(angles), 4 * np.sin(angles), np.full(count, 1.5)], axis=-1)
    return cameras_at(np.stack([look_at(eye, np.zeros(3), UP) for eye in eyes]))


@settings(max_examples=15, deadline=None)
@given(st.floats(20, 230), st.integers(6, 30), st.floats(-180, 180))
def test_an_orbit_stays_on_the_filmed_arc(degrees: float, count: int, turned: float) -> None:
    cameras = _arc(degrees, count, turned)
    orbit = orbit_path(cameras, 24)
    centers = orbit.centers.numpy()
    nearest = np.linalg.norm(centers[:, None] - cameras.centers.numpy(), axis=-1).min(axis=1)
    spacing = 2 * 4 * np.sin(np.radians(degrees / (count - 1)) / 2)
    assert nearest.max() < 0.55 * spacing + 1e-6, "always between two cameras"
    covered = np.linalg.norm(centers[:, None] - centers, axis=-1).max()
    assert covered > 0.98 * 2 * 4 * np.sin(np.radians(min(degrees, 180)) / 2) * (degrees < 180), (
        "to both ends"
    )
    (note,) = orbit_of(cameras).notes
    assert f"arc of {degrees:.0f} degrees" in note
    steps = np.linalg.norm(centers - np.roll(centers, 1, axis=0), axis=1)
    assert steps.max() < 0.5 * np.radians(degrees) * 4 * 2 * np.pi / 24 * 1.01, (
        "the last frame leads to the first"
    )


def test_all_around_there_is_nothing_to_say() -> None:
    assert orbit_of(ring_of(3, np.zeros(3))).notes == ()
    assert orbit_of(ring_of(40, np.zeros(3))).notes == ()


def test_an_arc_orbit_keeps_the_height_of_the_cameras_near() -> None:
    poses = np.stack([look_at(np.array([4 * np.cos(a), 4 * np.sin(a), 2 + 2 * a]), np.zeros(3), UP)
                      for a in np.linspace(-0.8, 0.8, 15)])  # fmt: skip
    centers = orbit_path(cameras_at(poses), 40, UP).centers.numpy()
    heights = centers[:, 2]
    azimuths = np.arctan2(centers[:, 1], centers[:, 0])
    assert np.corrcoef(heights, azimuths)[0, 1] > 0.99
    assert np.ptp(heights) > 1.5


def test_cameras_that_look_outwards_are_told_of_another_path() -> None:
    eyes = ring_of(12, np.zeros(3), radius=0.5, height=0.0).centers.numpy()
    outward = cameras_at(np.stack([look_at(eye, 2 * eye, UP) for eye in eyes]))
    assert "--path along" in orbit_of(outward).notes[0]


def test_another_up_tilts_the_circle() -> None:
    leaning = np.array([0.0, 0.3, 1.0])
    for path in (orbit_path, spiral_path):
        made = path(ring_of(8, np.zeros(3)), 8, leaning)
        assert_rigid(made)
        np.testing.assert_allclose(made.cam_from_world[:, 0, :3].numpy() @ leaning, 0, atol=1e-9)
        assert (made.cam_from_world[:, 1, :3].numpy() @ leaning < 0).all(), (
            "y points down, away from up"
        )
    heights = orbit_path(ring_of(8, np.zeros(3)), 8, leaning).centers.numpy() @ leaning
    np.testing.assert_allclose(heights, heights[0], atol=1e-9)
