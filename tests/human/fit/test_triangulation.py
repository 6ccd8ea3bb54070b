"""Joints from key points of several cameras."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from dyngs.data.capture import View
from dyngs.human.body.joints import JOINT_NAMES
from dyngs.human.fit.keypoints import JOINTS, Keypoints
from dyngs.human.fit.triangulation import triangulate_joints

ROWS = sorted(JOINTS.values())


def ring(count: int) -> list[View]:
    """Cameras on a circle of 3 m around the origin that look at it."""
    views = []
    for number in range(count):
        angle = 2 * np.pi * number / count
        forward = -np.array([np.sin(angle), 0.0, np.cos(angle)])
        right = np.cross(np.array([0.0, -1.0, 0.0]), forward)
        pose = np.eye(4)
        pose[:3, :3] = np.stack([right, np.cross(forward, right), forward])
        pose[:3, 3] = [0.0, 0.0, 3.0]
        intrinsics = np.array([[500.0, 0, 320], [0, 500, 240], [0, 0, 1]])
        views.append(
            View(
                name=f"c{number}",
                image_path=Path(f"c{number}.png"),
                cam_from_world=pose,
                intrinsics=intrinsics,
                width=640,
                height=480,
                frame=0,
                camera_id=number,
            )
        )
    return views


def truth() -> np.ndarray:
    rng = np.random.default_rng(1)
    joints = rng.uniform(-0.3, 0.3, (len(JOINT_NAMES), 3))
    joints[:, 1] *= 3
    return joints


def seen_by(views: list[View], joints: np.ndarray, noise: float = 0.0, seed: int = 2) -> Keypoints:
    rng = np.random.default_rng(seed)
    keypoints = {}
    for view in views:
        local = joints @ view.cam_from_world[:3, :3].T + view.cam_from_world[:3, 3]
        pixels = local @ view.intrinsics.T
        points = np.zeros((len(joints), 3))
        points[ROWS, :2] = (pixels[:, :2] / pixels[:, 2:])[ROWS]
        points[ROWS, :2] += noise * rng.standard_normal((len(ROWS), 2))
        points[ROWS, 2] = 0.9
        keypoints[view.name] = torch.from_numpy(points).float()
    return keypoints


@pytest.mark.parametrize("count", [2, 3, 4])
def test_exact_key_points_give_exact_joints(count: int) -> None:
    views = ring(5)[:count]
    joints = truth()
    found = triangulate_joints(views, seen_by(views, joints))[0].numpy()
    np.testing.assert_allclose(found[ROWS, :3], joints[ROWS], atol=1e-4)
    assert (found[ROWS, 3] > 0.4).all()
    others = np.setdiff1d(np.arange(len(joints)), ROWS)
    assert not found[others].any()


def test_a_wrong_limb_in_one_camera_is_outvoted() -> None:
    views = ring(4)
    joints = truth()
    keypoints = seen_by(views, joints, noise=1.0)
    left, right = JOINTS["left_wrist"], JOINTS["right_wrist"]
    keypoints["c1"][[left, right]] = keypoints["c1"][[right, left]]
    found = triangulate_joints(views, keypoints)[0].numpy()
    assert np.linalg.norm(found[ROWS, :3] - joints[ROWS], axis=1).max() < 0.03


def test_two_cameras_that_disagree_give_no_joint() -> None:
    views = ring(5)[:2]
    keypoints = seen_by(views, truth())
    wrist = JOINTS["left_wrist"]
    keypoints["c1"][wrist, 1] += 100
    assert triangulate_joints(views, keypoints)[0][wrist, 3] == 0


def test_frames_with_one_camera_are_left_out() -> None:
    view = ring(3)[0]
    other = replace(ring(3)[1], frame=1)
    assert triangulate_joints([view, other], seen_by([view, other], truth())) == {}
