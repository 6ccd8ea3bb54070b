"""Motions of anybody where the captured person was: size, floor, place and up direction."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from motion_files import (
    pelvis_path,
    random_motion,
    slow_vertices,
    tiny_body,
)
from torch import Tensor

from dyngs.human.body.skinning import apply_transforms, axis_angle_to_matrix, joint_transforms
from dyngs.human.motion.motion import MotionClip, motion_clip
from dyngs.human.motion.placement import (
    place_like,
    place_on_floor,
    rotate_clip_to_y_up,
    up_direction,
)


def joint_places(clip: MotionClip, joints: Tensor, parents: tuple[int, ...]) -> Tensor:
    moved = apply_transforms(
        joint_transforms(joints, parents, axis_angle_to_matrix(clip.poses)), joints
    )
    return clip.scale[:, None, None] * moved + clip.trans[:, None]


@pytest.mark.parametrize("up", [1, 2])
def test_a_motion_is_put_where_the_person_was(up: int) -> None:
    """A placed motion keeps its size, floor, position and up axis, and its poses do not change."""
    body = tiny_body()
    clip = motion_clip(random_motion(5, angle=0.3, seed=4))
    turn = torch.eye(3) if up == 1 else axis_angle_to_matrix(torch.tensor([math.pi / 2, 0.0, 0.0]))
    like = motion_clip(random_motion(4, angle=0.1, seed=5))
    roots = turn.expand(4, 3, 3)
    from scipy.spatial.transform import Rotation

    turned = torch.from_numpy(Rotation.from_matrix(roots.numpy()).as_rotvec()).float()
    like = MotionClip(
        like.times,
        torch.cat([turned[:, None], like.poses[:, 1:]], 1),
        like.trans,
        torch.full((4,), 2.0),
    )
    found = place_like(clip, like, body.joints, body.parents)
    ours, theirs = (joint_places(x, body.joints, body.parents) for x in (found, like))
    assert float(ours[..., up].min()) == pytest.approx(float(theirs[..., up].min()), abs=1e-4)
    for axis in {0, 1, 2} - {up}:
        assert float(ours[:, 0, axis].mean()) == pytest.approx(
            float(theirs[:, 0, axis].mean()), abs=1e-4
        )
    alone = joint_places(clip, body.joints, body.parents)
    wanted = 2 * (alone - alone[:1, :1]) @ turn.T
    torch.testing.assert_close(ours - ours[:1, :1], wanted, rtol=0, atol=1e-4)


def test_upright_turns_a_world_whose_z_is_up() -> None:
    """All joints as the rotation of the world moves them."""
    joints = torch.randn(3, 3, generator=torch.Generator().manual_seed(0))
    parents = (-1, 0, 1)
    y_from_z = torch.tensor([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]])
    poses = 0.1 * torch.randn(4, 3, 3, generator=torch.Generator().manual_seed(1))
    poses[:, 0] += torch.tensor([torch.pi / 2, 0, 0])
    clip = MotionClip(
        torch.linspace(0, 1, 4).double(), poses, torch.rand(4, 3), torch.full((4,), 0.5)
    )

    def positions(x: MotionClip) -> torch.Tensor:
        moved = apply_transforms(
            joint_transforms(joints, parents, axis_angle_to_matrix(x.poses)), joints
        )
        return x.scale[:, None, None] * moved + x.trans[:, None]

    turned = rotate_clip_to_y_up(clip, clip, joints)
    torch.testing.assert_close(positions(turned), positions(clip) @ y_from_z.T, atol=1e-5, rtol=0)
    assert torch.equal(up_direction(turned), torch.tensor([0.0, 1.0, 0.0]))


@pytest.mark.parametrize("count", [24, 52, 55])
def test_the_lowest_vertex_comes_to_the_floor(count: int) -> None:
    body = tiny_body(count)
    motion = replace(random_motion(), scale=torch.tensor([0.5, 1.0, 1.5, 2.0]))
    landed = place_on_floor(motion, body)
    assert slow_vertices(body, landed)[..., 1].min() == pytest.approx(0, abs=1e-6)
    assert torch.equal(landed.trans[:, ::2], motion.trans[:, ::2])
    rise = pelvis_path(body, landed) - pelvis_path(body, motion)
    assert np.ptp(rise[:, 1]) < 1e-6
