"""True tracks of the synthetic scenes: they lie on what moves, and are visible where the ray tracer shows them."""

from __future__ import annotations

from typing import get_args

import numpy as np
import pytest

from dyngs.data.synthetic.captures import orbit_cameras
from dyngs.data.synthetic.raytrace import CAMERA_ANGLE_X, render_movers
from dyngs.data.synthetic.scenes import SceneName, scene_at
from dyngs.data.synthetic.tracks import POINTS_PER_THING, is_in_image, true_tracks

SIZE = 64
CAMERAS = ((16.0, -70.0), (34.0, -45.0), (22.0, -20.0), (45.0, -60.0), (28.0, -30.0))
"""Elevation and azimuth in degrees: the walls of the room stand behind what they show."""
NAMES: tuple[SceneName, ...] = get_args(SceneName)


def projected(points: np.ndarray, pose: np.ndarray) -> np.ndarray:
    """(P, 2) pixels of an image of ``SIZE``."""
    x, y, z = ((points - pose[:3, 3]) @ pose[:3, :3]).T
    focal = 0.5 * SIZE / np.tan(0.5 * CAMERA_ANGLE_X)
    return np.stack([focal * x / -z, focal * y / z], axis=1) + 0.5 * SIZE


@pytest.mark.parametrize("name", NAMES)
def test_visible_points_lie_where_something_moving_is_seen(name: SceneName) -> None:
    poses = [orbit_cameras(1, 4.0, elevation, azimuth)[0] for elevation, azimuth in CAMERAS]
    times = np.linspace(0, 1, 5)
    shots = [(f"v{i}", float(time), pose) for i, (time, pose) in enumerate(zip(times, poses, strict=True))]
    tracks = true_tracks(lambda time: scene_at(name, time), shots)
    things = len(scene_at(name, 1.0).movers)
    assert tracks.points.shape == (5, POINTS_PER_THING * things, 3)
    assert tracks.views.tolist() == ["v0", "v1", "v2", "v3", "v4"]
    np.testing.assert_array_equal(tracks.times, times)
    np.testing.assert_array_equal(tracks.moments, range(5))
    for k, (_, time, pose) in enumerate(shots):
        seen = tracks.visible[k]
        assert seen.mean() > 0.1
        assert seen.mean() < 0.9 or name == "wave", "others are on the far side or hidden, but not of a cloth"
        mask = np.pad(render_movers(scene_at(name, time), pose, SIZE), 1)
        x, y = projected(tracks.points[k][seen], pose).astype(int).T
        near = np.any([mask[y + dy, x + dx] for dy in range(3) for dx in range(3)], axis=0)
        assert near.all(), "in the mask or, at an outline, next to it"


def test_points_are_missing_before_their_thing_appears() -> None:
    shots = [("a", 0.1, np.eye(4)), ("b", 0.5, np.eye(4)), ("c", 1.0, np.eye(4))]
    tracks = true_tracks(lambda time: scene_at("merge", time), shots)
    grown = tracks.points[:, -POINTS_PER_THING:]
    assert np.isnan(grown[0]).all()
    assert np.isfinite(grown[1:]).all()
    assert np.isfinite(tracks.points[:, :-POINTS_PER_THING]).all()
    assert not tracks.visible[0, -POINTS_PER_THING:].any()


def test_points_outside_the_image_or_behind_the_camera_are_not_in_it() -> None:
    points = np.array([[0, 0, -1], [0.35, 0, -1], [0.37, 0, -1], [0, 0, 1], [np.nan, 0, -1]])
    assert is_in_image(points, np.eye(4)).tolist() == [True, True, False, False, False]
