"""Initial poses: position and size from silhouettes, headings from key points."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from dyngs.core.camera import Cameras
from dyngs.core.conventions import ignore_progress
from dyngs.human.avatar.posing import frame_pose, posed_joints
from dyngs.human.body.body_reader import default_template
from dyngs.human.fit.capture_fit import (
    STATURE,
    BodyDiscs,
    BodyFit,
    ObservedFrame,
    body_discs,
    locate_person,
    mean_up_direction,
    pose_prior,
    poses_from_key_points,
    standing_clip,
    usual_pose_statistics,
)
from dyngs.human.motion.motion import MotionClip

SIZE = 48


@pytest.fixture(scope="module")
def body() -> BodyDiscs:
    return body_discs(default_template(), 48)


def ring(count: int, centre: torch.Tensor, distance: float = 4.0) -> Cameras:
    """Cameras around a place, looking at it, y up."""
    poses = torch.eye(4).repeat(count, 1, 1)
    for i in range(count):
        angle = 2 * math.pi * (i + 0.2) / count
        back = torch.tensor([math.sin(angle), 0.0, math.cos(angle)])
        rotation = torch.stack(
            [
                torch.linalg.cross(torch.tensor([0.0, 1.0, 0.0]), back),
                torch.tensor([0.0, -1.0, 0.0]),
                -back,
            ]
        )
        poses[i, :3, :3] = rotation
        poses[i, :3, 3] = -rotation @ (centre + distance * back)
    focal = torch.tensor([[1.6 * SIZE, 0, SIZE / 2], [0, 1.6 * SIZE, SIZE / 2], [0, 0, 1]])
    return Cameras(poses, focal.repeat(count, 1, 1), SIZE, SIZE)


def standing(place: torch.Tensor, heading: float, scale: float = 1.0) -> MotionClip:
    """One frame of the usual pose with the pelvis at ``place``."""
    poses = usual_pose_statistics(55)[0][None].clone()
    poses[0, 0] = torch.tensor([0.0, heading, 0.0])
    joints = default_template().joints
    time = torch.zeros(1, dtype=torch.float64)
    return MotionClip(time, poses, (place - scale * joints[0])[None], torch.tensor([scale]))


def seen_by(body: BodyDiscs, clip: MotionClip, cameras: Cameras) -> ObservedFrame:
    fitting = BodyFit(clip, body, pose_prior(clip, is_given=True))
    with torch.no_grad():
        alpha = fitting.silhouettes(fitting.initial_parameters(), 0, cameras)
    return ObservedFrame(cameras, alpha, torch.ones_like(alpha))


def test_place_and_size_of_who_stands_somewhere(body: BodyDiscs) -> None:
    place = torch.tensor([1.0, 2.0, -3.0])
    seen = seen_by(body, standing(place, 0.3, scale=1.2), ring(4, place))
    assert mean_up_direction(seen) == pytest.approx([0, 1, 0], abs=1e-6)
    found, height = locate_person(seen, mean_up_direction(seen))
    assert found == pytest.approx(place, abs=0.2)  # the middle of the box is not the pelvis
    assert height == pytest.approx(1.2 * STATURE, rel=0.1)
    clip = standing_clip(
        torch.zeros(1, dtype=torch.float64), body, mean_up_direction(seen), lambda _: seen
    )
    assert float(clip.scale[0]) == pytest.approx(1.2, rel=0.1)


def test_key_points_tell_which_way_a_turning_person_faces(body: BodyDiscs) -> None:
    """Front and back have the same outline before one camera."""
    place = torch.tensor([0.0, 1.0, 0.0])
    camera = ring(1, torch.tensor([0.0, 1.0, 0.0]))
    # towards the camera, then sideways, then away from it
    turns = [0.4 * math.pi + x for x in (0.1, 1.6, 3.1)]
    seen = [with_joints(body, standing(place, turn), camera) for turn in turns]
    times = torch.linspace(0, 1, 3, dtype=torch.float64)
    clip, _ = poses_from_key_points(times, body, dict(enumerate(seen)), ignore_progress)
    for root, turn in zip(clip.poses[:, 0], turns, strict=True):
        facing = Rotation.from_rotvec(root.double().numpy()).apply([0.0, 0.0, 1.0])
        assert facing @ np.array([math.sin(turn), 0.0, math.cos(turn)]) > 0.8


def with_joints(body: BodyDiscs, clip: MotionClip, cameras: Cameras) -> ObservedFrame:
    """Return the observed frame with its joints as key points."""
    seen = seen_by(body, clip, cameras)
    joints = posed_joints(body.skeleton, frame_pose(clip, 0))
    local = joints @ cameras.cam_from_world[0, :3, :3].T + cameras.cam_from_world[0, :3, 3]
    pixels = local @ cameras.intrinsics[0].T
    marked = torch.cat([pixels[:, :2] / pixels[:, 2:] / SIZE, torch.ones(len(joints), 1)], 1)
    return replace(seen, joints=marked[None].detach())
