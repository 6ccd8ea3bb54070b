"""Where cameras look and which way is up for them."""

from __future__ import annotations

import numpy as np
import pytest
from camera_rings import UP, cameras_at, forward_facing
from hypothesis import given, settings
from hypothesis import strategies as st

from dyngs.data.aim import look_at, look_at_point, up_direction


def test_parallel_cameras_look_forward() -> None:
    cameras = forward_facing(8)
    assert look_at_point(cameras)[1] > 1.0
    np.testing.assert_allclose(up_direction(cameras), UP, atol=1e-9)


@settings(max_examples=15, deadline=None)
@given(st.floats(0.5, 8), st.floats(0.6, 3))
def test_cameras_on_one_side_that_look_down_know_what_is_up(height: float, arc: float) -> None:
    """The mean of their own up directions leans away from the scene."""
    angles = np.linspace(0, arc, 9)
    poses = np.stack(
        [look_at(np.array([4 * np.cos(a), 4 * np.sin(a), height]), np.zeros(3), UP) for a in angles]
    )
    np.testing.assert_allclose(up_direction(cameras_at(poses)), UP, atol=1e-9)
    assert -poses[:, :3, 1].mean(axis=0) @ UP < 0.999


def test_cameras_held_askew_vote() -> None:
    rng = np.random.default_rng(0)
    poses = np.stack([look_at(np.array([4 * np.cos(a), 4 * np.sin(a), 1.0]), np.zeros(3), UP)
                      for a in np.linspace(0, 6, 40)])  # fmt: skip
    for i, angle in enumerate(rng.choice([-1.5, 0.0, 0.0, 1.5], 40)):
        c = np.cos(angle)
        s = np.sin(angle)
        poses[i, :3, :3] = poses[i, :3, :3] @ np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]])
    assert up_direction(cameras_at(poses)) @ UP > 0.95


@pytest.mark.parametrize(("roll", "is_level"), [(5.0, True), (15.0, False)])
def test_cameras_that_are_not_held_level_have_the_mean_of_their_ups(
    roll: float, is_level: bool
) -> None:
    """Half a circle of cameras that look down by 30 degrees, rolled to either side by turns."""
    poses = []
    for k, azimuth in enumerate(np.linspace(0, np.pi, 40)):
        forward = np.array([np.cos(azimuth) * 0.866, np.sin(azimuth) * 0.866, -0.5])
        pose = look_at(np.zeros(3), forward, np.array([0.0, 0.0, 1.0]))
        angle = np.radians(roll) * (-1) ** k
        rolled = np.array(
            [[np.cos(angle), -np.sin(angle), 0], [np.sin(angle), np.cos(angle), 0], [0, 0, 1]]
        )
        pose[:3, :3] = pose[:3, :3] @ rolled
        poses.append(pose)
    found = up_direction(cameras_at(np.stack(poses)))
    assert (found @ [0, 0, 1] > 0.99) == is_level
