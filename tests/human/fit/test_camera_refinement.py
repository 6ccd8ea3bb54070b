"""Poses of fixed cameras are refined by the key points of a person."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from dyngs.data.capture import View
from dyngs.human.fit.camera_refinement import refine_cameras
from dyngs.human.fit.keypoints import Keypoints
from tests.human.fit.test_triangulation import ring, seen_by, truth

FRAMES = 16


def clip(cameras: int) -> tuple[list[View], Keypoints]:
    """Views and exact key points, with 0.3 px of noise, of a person who wanders."""
    views = []
    keypoints: Keypoints = {}
    for frame in range(FRAMES):
        group = [replace(view, frame=frame, name=f"{view.name}_{frame}") for view in ring(cameras)]
        joints = truth() + 0.03 * frame * np.array([1.0, 0.0, 0.5])
        keypoints |= seen_by(group, joints, noise=0.3, seed=frame)
        views += group
    return views, keypoints


def disturb(views: list[View], camera: int, degrees: float) -> list[View]:
    """Turn one camera about its own vertical axis."""
    turn = np.eye(4)
    turn[:3, :3] = Rotation.from_euler("y", degrees, degrees=True).as_matrix()
    return [
        replace(view, cam_from_world=turn @ view.cam_from_world)
        if view.camera_id == camera
        else view
        for view in views
    ]


def test_a_turned_camera_is_turned_back() -> None:
    views, keypoints = clip(4)
    found = refine_cameras(disturb(views, 2, 0.6), keypoints)
    assert found is not None
    assert found.before > 1.5
    assert found.after < 0.5
    moved = {view.camera_id: view.cam_from_world for view in found.apply(views)}
    for view in views[:4]:
        centres = [
            np.linalg.inv(pose)[:3, 3] for pose in (view.cam_from_world, moved[view.camera_id])
        ]
        assert np.linalg.norm(centres[1] - centres[0]) < 0.06, "cameras stay near their places"


def test_exact_cameras_are_kept() -> None:
    views, keypoints = clip(4)
    assert refine_cameras(views, keypoints) is None


@pytest.mark.parametrize("cameras", [1, 2])
def test_two_cameras_are_too_few(cameras: int) -> None:
    views, keypoints = clip(cameras)
    assert refine_cameras(disturb(views, 0, 0.6), keypoints) is None


def test_moving_cameras_are_kept() -> None:
    views, keypoints = clip(4)
    moved = views[0].cam_from_world.copy()
    moved[0, 3] += 0.1
    views[0] = replace(views[0], cam_from_world=moved)
    assert refine_cameras(disturb(views, 2, 0.6), keypoints) is None
