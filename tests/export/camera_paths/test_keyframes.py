"""Cameras between keys: known poses, smoothness, stillness, no axis of the world special."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from dyngs.export.camera_paths.keyframes import Keyframes, interpolate_keyframes


def _poses(rotations: Rotation, centers: np.ndarray) -> np.ndarray:
    """(K, 4, 4) cam_from_world of cameras at ``centers``."""
    poses = np.tile(np.eye(4), (len(centers), 1, 1))
    poses[:, :3, :3] = rotations.as_matrix()
    poses[:, :3, 3] = -np.einsum("kij,kj->ki", poses[:, :3, :3], centers)
    return poses


def _turns(degrees: list[float], axis: str) -> Rotation:
    return Rotation.from_rotvec(
        np.outer(np.radians(degrees), [axis == "x", axis == "y", axis == "z"])
    )


def _centers(keys: Keyframes) -> np.ndarray:
    rotation = keys.cam_from_world[:, :3, :3]
    translation = keys.cam_from_world[:, :3, 3]
    return -np.einsum("kji,kj->ki", rotation, translation)


def _matrices(focals: np.ndarray) -> np.ndarray:
    matrices = np.tile(np.eye(3), (len(focals), 1, 1))
    matrices[:, 0, 0] = focals
    matrices[:, 1, 1] = 2 * focals
    matrices[:, :2, 2] = np.stack([focals / 2, focals / 4], axis=1)
    return matrices


def _at(centers: np.ndarray, seconds: np.ndarray, period: float | None = None) -> Keyframes:
    """Keys at ``centers`` that all face one way."""
    count = len(seconds)
    return Keyframes(
        _poses(Rotation.identity(count), centers),
        _matrices(np.full(count, 50.0)),
        seconds,
        None,
        period,
    )


@st.composite
def keyframes(draw: st.DrawFn) -> Keyframes:
    """One to six keys at uneven seconds, looping or not, some of them equal to the one before."""
    count = draw(st.integers(1, 6))
    rng = np.random.default_rng(draw(st.integers(0, 2**32)))
    same = np.maximum.accumulate(np.where(rng.random(count) < 0.7, np.arange(count), 0))
    rotations = Rotation.random(count, rng)[same]
    centers = rng.normal(size=(count, 3))[same] * draw(st.floats(0, 1e4))
    seconds = np.cumsum(rng.uniform(0.01, 2, count)) - draw(st.floats(0, 2))
    period = seconds[-1] - seconds[0] + draw(st.floats(0.01, 2)) if draw(st.booleans()) else None
    return Keyframes(
        _poses(rotations, centers),
        _matrices(rng.uniform(1, 99, count)),
        seconds,
        rng.random(count),
        period,
    )


@settings(max_examples=50, deadline=None)
@given(keyframes(), st.integers(-2, 2))
def test_the_path_passes_through_its_keys(keys: Keyframes, rounds: int) -> None:
    made = interpolate_keyframes(keys, keys.seconds + (rounds * keys.period if keys.period else 0))
    scale = 1 + np.abs(keys.cam_from_world).max()
    np.testing.assert_allclose(made.cam_from_world, keys.cam_from_world, atol=1e-6 * scale)
    np.testing.assert_allclose(made.intrinsics, keys.intrinsics, rtol=1e-6)
    np.testing.assert_allclose(made.times, keys.times, atol=1e-6)


@settings(max_examples=50, deadline=None)
@given(keyframes(), st.lists(st.floats(-5, 20), min_size=1, max_size=20))
def test_every_pose_is_rigid_and_between(keys: Keyframes, seconds: list[float]) -> None:
    made = interpolate_keyframes(keys, np.array(seconds))
    rotation = made.cam_from_world[:, :3, :3]
    np.testing.assert_allclose(
        rotation @ rotation.transpose(0, 2, 1), np.tile(np.eye(3), (len(made), 1, 1)), atol=1e-9
    )
    assert (np.linalg.det(rotation) > 0).all()
    assert (made.cam_from_world[:, 3] == [0, 0, 0, 1]).all()
    reach = np.ptp(_centers(keys), axis=0).max()
    assert np.abs(_centers(made) - _centers(keys)[0]).max() <= 3 * reach + 1e-6, "no wild swings"
    assert made.times is not None
    assert keys.times is not None
    assert (
        keys.times.min() - 1e-12 <= made.times.min() <= made.times.max() <= keys.times.max() + 1e-12
    )


@settings(max_examples=25, deadline=None)
@given(keyframes(), st.integers(0, 2**32))
def test_a_path_moves_with_the_world(keys: Keyframes, seed: int) -> None:
    rng = np.random.default_rng(seed)
    motion = _poses(Rotation.random(1, rng), rng.normal(size=(1, 3)))[0]
    seconds = np.linspace(-1, 9, 23)
    moved = Keyframes(
        keys.cam_from_world @ motion, keys.intrinsics, keys.seconds, None, keys.period
    )
    expected = interpolate_keyframes(keys, seconds).cam_from_world @ motion
    scale = 1 + np.abs(keys.cam_from_world).max()
    np.testing.assert_allclose(
        interpolate_keyframes(moved, seconds).cam_from_world, expected, atol=1e-7 * scale
    )


def test_half_way_between_two_keys() -> None:
    rotations = _turns([0, 90], "y")
    poses = _poses(rotations, np.array([[0.0, 0, 0], [4, 0, 2]]))
    keys = Keyframes(
        poses, _matrices(np.array([10.0, 40.0])), np.array([1.0, 3.0]), np.array([0.2, 0.6])
    )
    made = interpolate_keyframes(keys, np.array([2.0]))
    half = _turns([45], "y").as_matrix()[0]
    np.testing.assert_allclose(made.cam_from_world[0, :3, :3], half, atol=1e-12)
    np.testing.assert_allclose(_centers(made), [[2, 0, 1]], atol=1e-12)
    # focal length: geometric mean; principal point: mean
    expected = [[20, 0, 12.5], [0, 40, 6.25], [0, 0, 1]]
    np.testing.assert_allclose(made.intrinsics[0], expected)
    np.testing.assert_allclose(made.times, [0.4])


@pytest.mark.parametrize(("start", "stop"), [(0, 170), (350, 10), (10, -160)])
def test_a_rotation_goes_evenly_the_shorter_way(start: float, stop: float) -> None:
    rotations = _turns([start, stop], "z")
    keys = Keyframes(
        _poses(rotations, np.zeros((2, 3))), _matrices(np.ones(2)), np.array([0.0, 1.0])
    )
    made = Rotation.from_matrix(
        interpolate_keyframes(keys, np.linspace(0, 1, 21)).cam_from_world[:, :3, :3]
    )
    turned = np.degrees((made * rotations[0].inv()).magnitude())
    shorter = abs((stop - start + 180) % 360 - 180)
    np.testing.assert_allclose(turned, np.linspace(0, shorter, 21), atol=1e-6)


@pytest.mark.parametrize("period", [None, 7.0])
@pytest.mark.parametrize("count", [1, 2, 5])
def test_equal_keys_give_a_still_camera(count: int, period: float | None) -> None:
    poses = np.tile(
        _poses(Rotation.from_rotvec([[0.3, 0.2, 0.1]]), np.array([[1.0, 2, 3]])), (count, 1, 1)
    )
    matrices = _matrices(np.full(count, 70.0))
    seconds = np.arange(count) * 1.5
    made = interpolate_keyframes(
        Keyframes(poses, matrices, seconds, None, period), np.linspace(-1, 9, 31)
    )
    np.testing.assert_allclose(made.cam_from_world, np.tile(poses[:1], (31, 1, 1)), atol=1e-12)
    np.testing.assert_allclose(made.intrinsics, np.tile(matrices[:1], (31, 1, 1)))


def test_a_camera_that_rests_between_moves_does_not_sway() -> None:
    centers = np.array([[0.0, 0, 0], [5, 0, 0], [5, 0, 0], [5, 3, 0]])
    made = _centers(interpolate_keyframes(_at(centers, np.arange(4.0)), np.linspace(1, 2, 11)))
    np.testing.assert_allclose(made, np.tile([5, 0, 0], (11, 1)), atol=1e-12)


def test_a_thrown_camera_follows_its_parabola() -> None:
    """Catmull-Rom tangents reproduce quadratic motion, also with uneven keys."""

    def parabola(t: np.ndarray) -> np.ndarray:
        return np.stack([2 * t, 1 - t, 5 * t - 0.5 * t * t], axis=1)

    knots = np.array([0.0, 0.7, 1.0, 2.2, 3.0])
    seconds = np.linspace(0, 3, 40)
    made = interpolate_keyframes(_at(parabola(knots), knots), seconds)
    np.testing.assert_allclose(_centers(made), parabola(seconds), atol=1e-9)


def test_outside_its_keys_the_camera_rests() -> None:
    keys = _at(np.array([[0.0, 0, 0], [1, 0, 0], [1, 2, 0]]), np.array([1.0, 2.0, 3.0]))
    made = _centers(interpolate_keyframes(keys, np.array([-5.0, 0.99, 3.01, 99.0])))
    np.testing.assert_allclose(made, [[0, 0, 0], [0, 0, 0], [1, 2, 0], [1, 2, 0]], atol=1e-12)


@pytest.mark.parametrize("period", [None, 4.7])
def test_no_jump_in_velocity(period: float | None) -> None:
    """At the keys, and where a loop closes, the velocity before is the velocity after."""
    rng = np.random.default_rng(3)
    keys = _at(rng.normal(size=(5, 3)), np.array([0.0, 0.5, 1.7, 2.0, 3.1]), period)
    seconds = keys.seconds[1:-1] if period is None else np.append(keys.seconds, 4.7)
    h = 1e-5
    before, here, after = (_centers(interpolate_keyframes(keys, seconds + d)) for d in (-h, 0, h))
    np.testing.assert_allclose((here - before) / h, (after - here) / h, atol=1e-2)
    assert np.linalg.norm(after - before, axis=1).min() / h > 0.1, "it moves there"


def test_a_loop_repeats() -> None:
    angles = np.arange(8) * np.pi / 4
    ring = np.stack([np.cos(angles), np.sin(angles), 0 * angles], axis=1)
    keys = Keyframes(
        _poses(Rotation.from_rotvec(np.outer(angles, [0, 0, 1])), ring),
        _matrices(np.ones(8)),
        angles,
        None,
        2 * np.pi,
    )
    seconds = np.linspace(0, 2 * np.pi, 50)
    once, twice = (interpolate_keyframes(keys, seconds + turn) for turn in (0, 2 * np.pi))
    np.testing.assert_allclose(once.cam_from_world, twice.cam_from_world, atol=1e-9)
    exact = np.stack([np.cos(seconds), np.sin(seconds), 0 * seconds], axis=1)
    # a cubic through 8 points of a circle
    np.testing.assert_allclose(_centers(once), exact, atol=0.02)
