"""Camera paths: known circles, invariance under rigid motion, the JSON format."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from dyngs.camera import Cameras
from dyngs.errors import DyngsError
from dyngs.view.paths import (
    CameraPath,
    frame_orbit_for_points,
    look_at,
    look_at_point,
    mean_up,
    orbit_path,
    read_path,
    spiral_path,
    write_path,
)

UP = np.array([0.0, 0.0, 1.0])


def _cameras(world_from_cam: np.ndarray) -> Cameras:
    intrinsics = torch.tensor([[50.0, 0, 32], [0, 50.0, 24], [0, 0, 1]], dtype=torch.float64)
    poses = torch.from_numpy(np.linalg.inv(world_from_cam))
    return Cameras(poses, intrinsics.expand(len(poses), 3, 3), 64, 48)


def _ring(count: int, target: np.ndarray, radius: float = 4.0, height: float = 1.5) -> Cameras:
    angles = 2 * np.pi * np.arange(count) / count
    eyes = target + np.stack([radius * np.cos(angles), radius * np.sin(angles), np.full(count, height)], axis=-1)
    return _cameras(np.stack([look_at(eye, target, UP) for eye in eyes]))


def _forward_facing(count: int) -> Cameras:
    rng = np.random.default_rng(0)
    poses = np.stack(
        [look_at(np.array([x, 0.0, z]), np.array([x, 5.0, z]), UP) for x, z in rng.normal(size=(count, 2))]
    )
    return _cameras(poses)


def _assert_rigid(cameras: Cameras) -> None:
    rotation = cameras.cam_from_world[:, :3, :3].double()
    identity = torch.eye(3, dtype=torch.float64).expand_as(rotation)
    torch.testing.assert_close(rotation @ rotation.transpose(1, 2), identity, atol=1e-5, rtol=0)
    assert (torch.linalg.det(rotation) > 0).all()


@settings(max_examples=15, deadline=None)
@given(st.tuples(*[st.floats(-10, 10)] * 3), st.integers(3, 12))
def test_orbit_of_a_ring_is_the_ring(target: tuple[float, float, float], count: int) -> None:
    ring = _ring(count, np.array(target))
    orbit = orbit_path(ring, count)
    torch.testing.assert_close(orbit.cam_from_world, ring.cam_from_world, atol=1e-6, rtol=0)
    assert (orbit.width, orbit.height) == (64, 48)


def test_orbit_moves_with_the_scene() -> None:
    """A rigid motion of all cameras moves the orbit alike: no axis of the world is special."""
    motion = look_at(np.array([3.0, -2.0, 7.0]), np.array([1.0, 1.0, 1.0]), np.array([0.3, 1.0, 0.2]))
    for path, cameras in ((orbit_path, _ring(5, np.zeros(3))), (spiral_path, _forward_facing(5))):
        moved = _cameras(motion @ np.linalg.inv(cameras.cam_from_world.numpy()))
        expected = path(cameras, 7).cam_from_world @ torch.from_numpy(np.linalg.inv(motion))
        torch.testing.assert_close(path(moved, 7).cam_from_world, expected, atol=1e-6, rtol=0)


@pytest.mark.parametrize("cameras", [_ring(1, np.zeros(3)), _forward_facing(6), _ring(2, np.ones(3))])
@pytest.mark.parametrize("path", [orbit_path, spiral_path])
def test_odd_camera_sets_give_finite_rigid_paths(cameras: Cameras, path: Any) -> None:
    made = path(cameras, 9)
    assert len(made) == 9
    assert torch.isfinite(made.cam_from_world).all()
    _assert_rigid(made)


def test_parallel_cameras_look_forward() -> None:
    cameras = _forward_facing(8)
    assert look_at_point(cameras)[1] > 1.0
    np.testing.assert_allclose(mean_up(cameras), UP, atol=1e-9)


def test_a_camera_straight_above_still_orbits() -> None:
    made = orbit_path(_cameras(look_at(np.array([0, 0, 5.0]), np.zeros(3), np.array([0, 1.0, 0]))[None]), 6)
    _assert_rigid(made)
    assert torch.isfinite(made.cam_from_world).all()


def test_spiral_stays_near_the_cameras_and_closes() -> None:
    cameras = _forward_facing(20)
    centers = spiral_path(cameras, 40).centers
    assert (centers.abs() < 3 * cameras.centers.abs().max()).all()
    steps = (centers.roll(-1, 0) - centers).norm(dim=1)
    assert steps.max() < 2.5 * steps.median(), "the last frame leads to the first without a jump"


@settings(max_examples=15, deadline=None)
@given(st.sampled_from([(0, 0, 1), (0, -1, 0), (1, 2, 3)]), st.floats(0.01, 1000), st.integers(1, 5))
def test_points_fill_the_picture(up: tuple[float, float, float], scale: float, frames: int) -> None:
    rng = np.random.default_rng(0)
    center = np.array([5.0, -3.0, 2.0]) * scale
    points = center + scale * rng.normal(size=(3000, 3)).clip(-2, 2)
    stray = np.full((5, 3), 1e6 * scale)
    orbit = frame_orbit_for_points(np.concatenate([points, stray, [[np.nan] * 3]]), frames, (80, 60), up)
    _assert_rigid(orbit)
    for pose, k in zip(orbit.cam_from_world.double().numpy(), orbit.intrinsics.double().numpy(), strict=True):
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


def test_json_round_trip_with_offset(tmp_path: Path) -> None:
    ring = _ring(4, np.array([1.0, 2.0, 3.0]))
    offset = np.array([1e6, -2e6, 50.0])
    file = tmp_path / "path.json"
    write_path(file, CameraPath(ring, 24.0, (0.0, 0.25, 0.5, 1.0)), offset)
    back = read_path(file, offset)
    assert (back.fps, back.times, len(back)) == (24.0, (0.0, 0.25, 0.5, 1.0), 4)
    torch.testing.assert_close(back.cameras.cam_from_world, ring.cam_from_world.float(), atol=1e-6, rtol=0)
    torch.testing.assert_close(back.cameras.intrinsics, ring.intrinsics.float())
    far = read_path(file).cameras.centers.double().numpy()
    np.testing.assert_allclose(far, ring.centers.numpy() + offset, atol=1.0)  # float32 at 1e6


def test_opengl_poses_and_field_of_view(tmp_path: Path) -> None:
    eye = look_at(np.array([0.0, -4.0, 0.0]), np.zeros(3), UP)
    frame = {"transform_matrix": (eye @ np.diag([1, -1, -1, 1.0])).tolist()}
    frames = [frame, {**frame, "fl_x": 90, "cx": 30}]
    file = tmp_path / "p.json"
    file.write_text(json.dumps({"width": 64, "height": 48, "camera_angle_x": np.pi / 2, "frames": frames}))
    path = read_path(file)
    assert path.times is None
    assert path.fps == 30.0
    np.testing.assert_allclose(path.cameras.cam_from_world[0].numpy(), np.linalg.inv(eye), atol=1e-6)
    expected = [[[32, 0, 32], [0, 32, 24], [0, 0, 1]], [[90, 0, 30], [0, 90, 24], [0, 0, 1]]]
    np.testing.assert_allclose(path.cameras.intrinsics.numpy(), expected, atol=1e-4)


GOOD = {"width": 8, "height": 8, "fl_x": 8, "frames": [{"cam_from_world": np.eye(4).tolist()}]}


@pytest.mark.parametrize(
    ("change", "names"),
    [
        ({"width": None}, "'width' is missing"),
        ({"width": 0}, "'width' is 0"),
        ({"fps": "fast"}, "'fps'"),
        ({"frames": []}, "'frames'"),
        ({"frames": [3]}, r"frames\[0\]"),
        ({"frames": [{}]}, r"frames\[0\].*cam_from_world"),
        ({"fl_x": True}, "'fl_x'"),
        ({"frames": [{"cam_from_world": [[1, 2], [3]]}]}, r"frames\[0\].*4x4"),
        ({"frames": [{"cam_from_world": (2 * np.eye(4)).tolist()}]}, r"frames\[0\]"),
        ({"frames": [{"cam_from_world": np.diag([-1, 1, 1, 1]).tolist()}]}, "mirrored"),
        ({"frames": [{"cam_from_world": np.full((4, 4), np.nan).tolist()}]}, "NaN"),
        ({"frames": [GOOD["frames"][0] | {"time": 2}]}, "'time'"),
        ({"frames": [GOOD["frames"][0], GOOD["frames"][0] | {"time": 0.5}]}, "no 'time'"),
    ],
)
def test_wrong_files_are_one_line(tmp_path: Path, change: dict[str, Any], names: str) -> None:
    file = tmp_path / "bad.json"
    file.write_text(json.dumps(GOOD | change))
    with pytest.raises(DyngsError, match=names) as caught:
        read_path(file)
    assert "bad.json" in str(caught.value)
    assert "\n" not in str(caught.value)


def test_no_file_and_no_json(tmp_path: Path) -> None:
    with pytest.raises(DyngsError, match=r"nothing\.json"):
        read_path(tmp_path / "nothing.json")
    (tmp_path / "broken.json").write_text("{")
    with pytest.raises(DyngsError, match=r"broken\.json"):
        read_path(tmp_path / "broken.json")
