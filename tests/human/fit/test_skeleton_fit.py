"""Poses of a clip from key points, compared with the poses that they were made from."""

from __future__ import annotations

import math

import pytest
import torch

from dyngs.core.conventions import ignore_progress
from dyngs.human.body.body_reader import load_template
from dyngs.human.body.joints import SMPLX_ROWS
from dyngs.human.fit.capture_fit import NUM_FITTED_JOINTS, usual_pose_statistics
from dyngs.human.fit.keypoints import JOINTS
from dyngs.human.fit.skeleton_fit import (
    LIMBS,
    SkeletonModel,
    SkeletonTargets,
    fit_skeleton,
    limb_direction_error,
)
from dyngs.human.keys import HumanModel
from dyngs.human.motion.motion import MotionClip, compose_rotations

FRAMES = 10
UP = torch.tensor([0.0, 1.0, 0.0])


@pytest.fixture(scope="module")
def model() -> SkeletonModel:
    body = load_template(HumanModel())
    assert body.joint_shape_dirs is not None
    mean, std = usual_pose_statistics(NUM_FITTED_JOINTS)
    return SkeletonModel(body.joints, body.joint_shape_dirs, body.parents, mean, std)


def walking(model: SkeletonModel, turns: float) -> MotionClip:
    """Somebody who swings arms and legs and turns by ``turns`` over the clip."""
    poses = torch.zeros(FRAMES, len(model.joints), 3)
    poses[:, :NUM_FITTED_JOINTS] = model.mean
    swing = torch.sin(torch.linspace(0, 2 * math.pi, FRAMES))
    for joint, sign in ((1, 1), (2, -1), (16, -1), (17, 1)):
        poses[:, joint, 0] += 0.5 * sign * swing
    angles = 2 * math.pi * turns * torch.linspace(0, 1, FRAMES)
    poses[:, 0] = compose_rotations((angles[:, None] * UP).double(), poses[:, 0].double()).float()
    trans = torch.zeros(FRAMES, 3)
    trans[:, 0] = torch.linspace(-0.3, 0.3, FRAMES)
    times = torch.linspace(0, 1, FRAMES, dtype=torch.float64)
    return MotionClip(times, poses, trans, torch.ones(FRAMES))


def joints_of(model: SkeletonModel, clip: MotionClip) -> torch.Tensor:
    betas = torch.zeros(model.joint_dirs.shape[-1])
    poses = clip.poses[:, :NUM_FITTED_JOINTS]
    return model.posed(poses, clip.trans, clip.scale, betas)


def targets_of(joints: torch.Tensor, cameras: int, *, with_depth: bool) -> SkeletonTargets:
    """Key points in cameras at 4 m around the person; with depth also directions of limbs."""
    rows = list(SMPLX_ROWS[joints.shape[1]])
    seen = torch.zeros(len(rows))
    seen[sorted(JOINTS.values())] = 1.0
    frames = []
    projections = []
    keypoints = []
    for camera in range(cameras):
        angle = math.radians(15 + 80 * camera)
        rotation = torch.tensor(
            [
                [math.cos(angle), 0.0, -math.sin(angle)],
                [0.0, -1.0, 0.0],
                [-math.sin(angle), 0.0, -math.cos(angle)],
            ]
        )
        projection = torch.cat([rotation, torch.tensor([[0.0], [0.0], [4.0]])], dim=1)
        focal = torch.tensor([[2.0, 0, 0.5], [0, 2.0, 0.5], [0, 0, 1]])
        for frame in range(FRAMES):
            local = (joints[frame, rows] @ rotation.T + projection[:, 3]) @ focal.T
            places = local[:, :2] / local[:, 2:]
            frames.append(frame)
            projections.append(focal @ projection)
            keypoints.append(torch.cat([places, seen[:, None]], dim=1))
    none = torch.zeros(FRAMES, len(rows), 4)
    relative = torch.cat([joints[:, rows], seen.expand(FRAMES, -1)[..., None]], dim=-1)
    return SkeletonTargets(
        torch.tensor(frames),
        torch.stack(projections),
        torch.stack(keypoints),
        none,
        relative if with_depth else none,
    )


@pytest.mark.parametrize(
    ("cameras", "with_depth", "tolerance"),
    [(3, False, 0.03), (1, True, 0.05)],
    ids=["three cameras", "one camera and directions"],
)
@pytest.mark.parametrize("turns", [0.0, 0.5])
def test_poses_are_found_from_any_heading(
    model: SkeletonModel, cameras: int, with_depth: bool, tolerance: float, turns: float
) -> None:
    true = walking(model, turns)
    joints = joints_of(model, true)
    standing = MotionClip(
        true.times, walking(model, 0.0).poses * 0, true.trans * 0, torch.ones(FRAMES)
    )
    found, _ = fit_skeleton(
        standing, UP, model, targets_of(joints, cameras, with_depth=with_depth), ignore_progress
    )
    rows = [row for row in sorted(JOINTS.values()) if row < NUM_FITTED_JOINTS]
    error = joints_of(model, found)[:, rows] - joints[:, rows]
    if cameras == 1:
        error = error - error.mean(dim=1, keepdim=True)  # depth is ambiguous
    assert float(error.norm(dim=-1).mean()) < tolerance


def test_the_direction_of_a_limb_counts_not_its_length() -> None:
    joints = torch.randn(55, 3, generator=torch.Generator().manual_seed(0))
    relative = torch.cat([1.3 * joints + 2.0, torch.ones(55, 1)], dim=1)
    assert float(limb_direction_error(joints, relative)) < 1e-3
    start, end = LIMBS[0]
    turned = relative.clone()
    turned[end, :3] = 2 * turned[start, :3] - turned[end, :3]
    assert float(limb_direction_error(joints, turned)) > 0.1
    turned[end, 3] = 0.0
    assert float(limb_direction_error(joints, turned)) < 1e-3
