"""Paths along the cameras of a capture."""

from __future__ import annotations

import numpy as np
import pytest
from camera_rings import UP, assert_rigid, cameras_at, ring_of

from dyngs.data.aim import look_at
from dyngs.export.camera_paths.along import path_along


def _walk(count: int, shake: float = 0.0) -> np.ndarray:
    """Return poses of a walk along x that looks at a wall, shaken by a normal distribution."""
    rng = np.random.default_rng(1)
    eyes = np.stack([np.linspace(0, 10, count), np.zeros(count), np.ones(count)], axis=-1)
    eyes += shake * rng.normal(size=eyes.shape)
    return np.stack(
        [look_at(eye, eye + [0, 5, 0] + shake * rng.normal(size=3), UP) for eye in eyes]
    )


def test_a_shaken_walk_becomes_smooth() -> None:
    shaken = cameras_at(_walk(60, shake=0.05))
    path = path_along(shaken, 60)
    assert_rigid(path.cameras)
    assert path.times is None

    def unrest(centers: np.ndarray) -> float:
        return float(np.abs(np.diff(centers, 2, axis=0)).mean())

    assert unrest(path.cameras.centers.numpy()) < 0.2 * unrest(shaken.centers.numpy())
    centers = path.cameras.centers.numpy()
    assert centers[0, 0] < 0.6
    assert centers[-1, 0] > 9.4
    steps = np.linalg.norm(np.diff(centers, axis=0), axis=1)
    assert steps.max() < 2.5 * steps.mean(), "at even speed"


@pytest.mark.parametrize("factor", [1e-9, 1e-4, 1e3])
def test_a_path_is_the_same_in_any_unit(factor: float) -> None:
    poses = _walk(40, shake=0.05)[np.random.default_rng(2).permutation(40)]
    scaled = poses.copy()
    scaled[:, :3, 3] *= factor
    wanted, found = (path_along(cameras_at(x), 30).cameras for x in (poses, scaled))
    np.testing.assert_allclose(
        found.centers.numpy() / factor, wanted.centers.numpy(), rtol=0, atol=1e-4
    )


def test_photos_in_any_order_become_a_walk() -> None:
    poses = _walk(40)
    mixed = np.random.default_rng(2).permutation(40)
    mixed = np.concatenate([[0], mixed[mixed != 0]])
    centers = path_along(cameras_at(poses[mixed]), 50).cameras.centers.numpy()
    assert (np.diff(centers[:, 0]) > 0).all(), "from the first photo to the other end, never back"


def test_a_clip_plays_in_its_own_time() -> None:
    times = (np.arange(20) / 19) ** 2
    path = path_along(cameras_at(_walk(20)), 11, times.tolist())
    assert path.times is not None
    np.testing.assert_allclose(path.times, np.linspace(0, 1, 11))
    centers = path.cameras.centers.numpy()[:, 0]
    np.testing.assert_allclose(centers[3:9], 10 * np.sqrt(np.linspace(0, 1, 11))[3:9], atol=0.6)
    mixed = np.random.default_rng(3).permutation(20)
    again = path_along(cameras_at(_walk(20)[mixed]), 11, times[mixed].tolist())
    np.testing.assert_allclose(again.cameras.centers.numpy()[:, 0], centers, atol=1e-9)


@pytest.mark.parametrize("count", [1, 2, 3])
def test_few_cameras_give_a_path(count: int) -> None:
    path = path_along(ring_of(count, np.zeros(3)), 7)
    assert len(path) == 7
    assert np.isfinite(path.cameras.cam_from_world.numpy()).all()
    assert_rigid(path.cameras)


def test_fixed_cameras_are_visited_once_each() -> None:
    """Five cameras that stand, at four times each, in the order of time: the path is that of five
    cameras."""
    poses = np.linalg.inv(ring_of(5, np.zeros(3)).cam_from_world.numpy())
    times = np.repeat([0.0, 0.3, 0.6, 1.0], 5).tolist()
    many = path_along(cameras_at(np.tile(poses, (4, 1, 1))), 9, times)
    once = path_along(cameras_at(poses), 9)
    np.testing.assert_allclose(
        many.cameras.centers.numpy(), once.cameras.centers.numpy(), atol=1e-9
    )
    assert many.times is None


def test_another_up_levels_the_path() -> None:
    up = np.array([0.0, 0.1, 1.0])
    path = path_along(cameras_at(_walk(30, shake=0.1)), 30, up=up)
    rights = path.cameras.cam_from_world[:, 0, :3].numpy()
    np.testing.assert_allclose(rights @ up, 0, atol=1e-9)
