"""Clips in time, from captures and from motion files: between frames, by frame numbers, and where they are put."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest
import torch
from motion_files import random_motion, tiny_body
from torch import Tensor

from dyngs.data.body_frames import body_frames
from dyngs.data.capture import BodyFrames, View
from dyngs.errors import DyngsError
from dyngs.human.motion.clip import MotionClip, captured_motion, motion_clip, place_like, rest_clip, same_bodies
from dyngs.human.motion.motion import JOINTS, Motion
from dyngs.human.pose.skinning import apply_transforms, axis_angle_to_matrix, joint_transforms

WHERE = Path("capture")


def three_frames() -> MotionClip:
    poses = torch.zeros(3, 2, 3)
    poses[1, 1, 2], poses[2, 1, 2] = 0.5, 3.0
    trans = torch.tensor([[0.0, 0, 0], [1.0, 0, 0], [5.0, 0, 0]])
    return MotionClip(torch.tensor([0.0, 0.25, 1.0], dtype=torch.float64), poses, trans, torch.tensor([1.0, 1.0, 2.0]))


def bodies(frames: list[int], joints: int = 55) -> BodyFrames:
    rows = len(frames)
    poses = np.random.default_rng(0).uniform(-1, 1, (rows, joints * 3))
    return body_frames(WHERE, frames, poses, np.arange(3 * rows).reshape(rows, 3), np.zeros(10))


def view(frame: int, time: float | None) -> View:
    return View(f"v{frame}", Path("x.png"), np.eye(4), np.eye(3), 4, 4, time=time, frame=frame)


def test_a_clip_is_exact_at_its_frames_and_turns_evenly_between() -> None:
    clip = three_frames()
    for row, time in enumerate(clip.times.tolist()):
        torch.testing.assert_close(clip.at(time).poses[0], clip.poses[row], rtol=0, atol=0)
        torch.testing.assert_close(clip.at(time).trans[0], clip.trans[row], rtol=0, atol=0)
    between = clip.at(0.625)
    assert float(between.poses[0, 1, 2]) == pytest.approx(1.75)
    assert float(between.trans[0, 0]) == pytest.approx(3.0)
    assert float(between.scale[0]) == pytest.approx(1.5)


@pytest.mark.parametrize(("time", "row"), [(None, 0), (-3.0, 0), (7.0, 2)])
def test_moments_outside_are_those_of_the_ends(time: float | None, row: int) -> None:
    clip = three_frames()
    torch.testing.assert_close(clip.at(time).poses[0], clip.poses[row], rtol=0, atol=0)


def test_footage_has_the_frames_that_views_show_in_order_of_time() -> None:
    given = bodies([3, 4, 7, 9])
    filmed = captured_motion(WHERE, given, [view(9, 1.0), view(3, 0.0), view(7, 0.5), view(3, 0.0)], torch.zeros(55, 3))
    assert filmed.frames == (3, 7, 9)
    assert filmed.clip.times.tolist() == [0.0, 0.5, 1.0]
    np.testing.assert_allclose(filmed.clip.trans.numpy(), given.trans[[0, 2, 3]])
    np.testing.assert_allclose(filmed.clip.poses.numpy(), given.poses[[0, 2, 3]], rtol=1e-6)


def test_footage_without_times_is_spread_by_frame_number() -> None:
    filmed = captured_motion(WHERE, bodies([0, 1, 2]), [view(2, None), view(1, None)], torch.zeros(55, 3))
    assert filmed.frames == (1, 2)
    assert filmed.clip.times.tolist() == [0.5, 1.0]


def test_a_view_without_parameters_is_named() -> None:
    with pytest.raises(DyngsError, match="no body parameters for 1 frames that have pictures"):
        captured_motion(WHERE, bodies([0, 1]), [view(5, 0.0)], torch.zeros(55, 3))


def test_poses_of_smpl_move_a_body_of_55_joints() -> None:
    given = bodies([0], joints=24)
    poses = captured_motion(WHERE, given, [view(0, 0.0)], torch.zeros(55, 3)).clip.poses[0]
    np.testing.assert_allclose(poses[:22].numpy(), given.poses[0, :22], rtol=1e-6)
    assert not poses[22:].any()


def test_clips_are_told_apart() -> None:
    one, other = bodies([0, 1]), bodies([0, 2])
    assert same_bodies(one, bodies([0, 1]))
    assert not same_bodies(one, other)


def joint_places(clip: MotionClip, joints: Tensor, parents: tuple[int, ...]) -> Tensor:
    moved = apply_transforms(joint_transforms(joints, parents, axis_angle_to_matrix(clip.poses)), joints)
    return clip.scale[:, None, None] * moved + clip.trans[:, None]


@pytest.mark.parametrize("up", [1, 2])
def test_a_motion_is_put_where_the_person_was(up: int) -> None:
    """As large, on the same floor, over the same place, the same way up; the motion itself is the same."""
    body = tiny_body()
    clip = motion_clip(random_motion(5, angle=0.3, seed=4))
    turn = torch.eye(3) if up == 1 else axis_angle_to_matrix(torch.tensor([math.pi / 2, 0.0, 0.0]))
    like = motion_clip(random_motion(4, angle=0.1, seed=5))
    roots = turn.expand(4, 3, 3)
    from scipy.spatial.transform import Rotation

    turned = torch.from_numpy(Rotation.from_matrix(roots.numpy()).as_rotvec()).float()
    like = MotionClip(like.times, torch.cat([turned[:, None], like.poses[:, 1:]], 1), like.trans, torch.full((4,), 2.0))
    found = place_like(clip, like, body.joints, body.parents)
    ours, theirs = (joint_places(x, body.joints, body.parents) for x in (found, like))
    assert float(ours[..., up].min()) == pytest.approx(float(theirs[..., up].min()), abs=1e-4)
    for axis in {0, 1, 2} - {up}:
        assert float(ours[:, 0, axis].mean()) == pytest.approx(float(theirs[:, 0, axis].mean()), abs=1e-4)
    alone = joint_places(clip, body.joints, body.parents)
    wanted = 2 * (alone - alone[:1, :1]) @ turn.T
    torch.testing.assert_close(ours - ours[:1, :1], wanted, rtol=0, atol=1e-4)


@pytest.mark.parametrize("up", [0, 1, 2])
def test_what_is_placed_like_the_upright_pose_is_placed_like_the_clip_it_comes_from(up: int) -> None:
    body = tiny_body()
    generator = torch.Generator().manual_seed(up)
    axis = torch.nn.functional.one_hot(torch.tensor((up + 1) % 3), 3).float()
    roots = 2.0 * axis + 0.05 * torch.randn(4, 3, generator=generator)
    poses = torch.cat([roots[:, None], 0.3 * torch.randn(4, 54, 3, generator=generator)], dim=1)
    trans, times = torch.randn(4, 3, generator=generator), torch.linspace(0, 1, 4, dtype=torch.float64)
    like = MotionClip(times, poses, trans, torch.tensor([1.9, 2.0, 2.0, 2.1]))
    clip = MotionClip(times, 0.2 * torch.randn(4, 55, 3, generator=generator), trans.flip(0), torch.ones(4))
    rest = rest_clip(like, body.joints, body.parents)
    assert len(rest) == 1
    assert not rest.poses[:, 1:].any()
    one, other = (place_like(clip, x, body.joints, body.parents) for x in (like, rest))
    for name in ("poses", "trans", "scale"):
        torch.testing.assert_close(getattr(other, name), getattr(one, name), rtol=0, atol=1e-4)


def test_a_motion_of_one_frame_is_a_clip() -> None:
    poses = torch.zeros(1, len(JOINTS), 3)
    one = motion_clip(Motion(poses, torch.zeros(1, 3), torch.zeros(0), 30.0, torch.ones(1)))
    assert one.times.tolist() == [0.0]
