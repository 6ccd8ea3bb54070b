"""Synthetic captures and their true tracks."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import get_args

import numpy as np
import pytest

from dyngs.capture.inspection import inspect_capture
from dyngs.data.synthetic.captures import (
    CAMERA_ANGLE_X,
    POINTS_PER_THING,
    DynamicOptions,
    SceneName,
    SyntheticView,
    nearest_primitives,
    orbit_cameras,
    sampled_rays,
    scene_at,
    true_tracks,
    write_dynamic_capture,
)

NAMES: tuple[SceneName, ...] = get_args(SceneName)
TINY = DynamicOptions(size=16, num_times=5, num_test=3, num_cameras=3, samples=1)


def _files(root: Path) -> dict[str, bytes]:
    return {p.relative_to(root).as_posix(): p.read_bytes() for p in root.rglob("*") if p.is_file()}


@pytest.mark.parametrize("name", ["spin", "room"])  # a camera per time, and fixed ones
def test_one_seed_gives_the_same_bytes_and_another_one_other_cameras(
    name: SceneName, tmp_path: Path
) -> None:
    first, second = (write_dynamic_capture(name, tmp_path / part, TINY) for part in ("a", "b"))
    assert _files(first) == _files(second)
    other = write_dynamic_capture(name, tmp_path / "c", replace(TINY, seed=1))
    assert _files(other).keys() == _files(first).keys()
    assert _files(other)["transforms_train.json"] != _files(first)["transforms_train.json"]


@pytest.mark.parametrize("name", NAMES)
def test_inspection_finds_nothing_suspicious(name: SceneName, tmp_path: Path) -> None:
    """The only warning is that few images show motion from one side; the room, with several
    cameras, has none."""
    problems = inspect_capture(
        write_dynamic_capture(name, tmp_path / "out", TINY), deep=True
    ).problems
    assert len(problems) == (name != "room")
    assert all(line.endswith("expect a static result") for line in problems)


SIZE = 64
CAMERAS = ((16.0, -70.0), (34.0, -45.0), (22.0, -20.0), (45.0, -60.0), (28.0, -30.0))
"""Elevation and azimuth in degrees: the walls of the room stand behind what they show."""


def projected(points: np.ndarray, pose: np.ndarray, size: int = SIZE) -> np.ndarray:
    """(P, 2) pixels of an image of ``size``."""
    x, y, z = ((points - pose[:3, 3]) @ pose[:3, :3]).T
    focal = 0.5 * size / np.tan(0.5 * CAMERA_ANGLE_X)
    return np.stack([focal * x / -z, focal * y / z], axis=1) + 0.5 * size


@pytest.mark.parametrize("name", NAMES)
def test_visible_points_lie_where_something_moving_is_seen(name: SceneName) -> None:
    poses = [orbit_cameras(1, 4.0, elevation, azimuth)[0] for elevation, azimuth in CAMERAS]
    times = np.linspace(0, 1, 5)
    shots = [
        SyntheticView(f"v{i}", pose, float(time))
        for i, (time, pose) in enumerate(zip(times, poses, strict=True))
    ]
    tracks = true_tracks(lambda time: scene_at(name, time), shots)
    things = len(scene_at(name, 1.0).moving_indices)
    assert tracks.points.shape == (5, POINTS_PER_THING * things, 3)
    assert tracks.views.tolist() == ["v0", "v1", "v2", "v3", "v4"]
    np.testing.assert_array_equal(tracks.times, times)
    np.testing.assert_array_equal(tracks.moments, range(5))
    for k, (time, pose) in enumerate(zip(times, poses, strict=True)):
        seen = tracks.visible[k]
        assert seen.mean() > 0.1
        assert seen.mean() < 0.9, "others are on the far side or hidden"
        rays = sampled_rays(pose, SIZE, 1)[0]
        nearest, _ = nearest_primitives(scene_at(name, time), pose[:3, 3], rays)
        labels = np.pad(nearest.reshape(SIZE, SIZE), 1)
        x, y = projected(tracks.points[k][seen], pose).astype(int).T
        own = scene_at(name, time).moving_indices[0] + np.flatnonzero(seen) // POINTS_PER_THING
        near = np.any([labels[y + dy, x + dx] == own for dy in range(3) for dx in range(3)], axis=0)
        assert near.all(), "where its own thing is or, at an outline, next to it"
