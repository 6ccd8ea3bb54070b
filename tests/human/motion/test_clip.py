"""Clips in time, from captures and from motion files: between frames, by frame numbers, and where they are put."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch

from dyngs.data.body_frames import body_frames
from dyngs.data.capture import BodyFrames, View
from dyngs.errors import DyngsError
from dyngs.human.motion.clip import MotionClip, captured_motion, motion_clip, same_bodies
from dyngs.human.motion.motion import Motion
from dyngs.human.template.joints import JOINT_NAMES


def three_frames() -> MotionClip:
    poses = torch.zeros(3, 2, 3)
    poses[1, 1, 2], poses[2, 1, 2] = 0.5, 3.0
    trans = torch.tensor([[0.0, 0, 0], [1.0, 0, 0], [5.0, 0, 0]])
    return MotionClip(torch.tensor([0.0, 0.25, 1.0], dtype=torch.float64), poses, trans, torch.tensor([1.0, 1.0, 2.0]))


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


def test_a_motion_of_one_frame_is_a_clip() -> None:
    poses = torch.zeros(1, len(JOINT_NAMES), 3)
    one = motion_clip(Motion(poses, torch.zeros(1, 3), torch.zeros(0), 30.0, torch.ones(1)))
    assert one.times.tolist() == [0.0]


WHERE = Path("capture")


def bodies(frames: list[int], joints: int = 55) -> BodyFrames:
    rows = len(frames)
    poses = np.random.default_rng(0).uniform(-1, 1, (rows, joints * 3))
    return body_frames(WHERE, frames, poses, np.arange(3 * rows).reshape(rows, 3), np.zeros(10))


def view(frame: int, time: float | None) -> View:
    return View(f"v{frame}", Path("x.png"), np.eye(4), np.eye(3), 4, 4, time=time, frame=frame)


def test_a_captured_motion_has_the_frames_that_views_show_in_order_of_time() -> None:
    given = bodies([3, 4, 7, 9])
    filmed = captured_motion(WHERE, given, [view(9, 1.0), view(3, 0.0), view(7, 0.5), view(3, 0.0)], torch.zeros(55, 3))
    assert filmed.frames == (3, 7, 9)
    assert filmed.clip.times.tolist() == [0.0, 0.5, 1.0]
    np.testing.assert_allclose(filmed.clip.trans.numpy(), given.trans[[0, 2, 3]])
    np.testing.assert_allclose(filmed.clip.poses.numpy(), given.poses[[0, 2, 3]], rtol=1e-6)


def test_who_never_moves_has_one_pose_for_all_frames() -> None:
    """And who goes on, or moves one joint, has one for each."""
    given = bodies([3, 4, 7])
    given.poses[:], given.trans[:] = given.poses[0], given.trans[0]
    views = [view(3, 0.0), view(4, 0.5), view(7, 1.0)]
    still = captured_motion(WHERE, given, views, torch.zeros(55, 3))
    assert len(still.clip) == 1
    assert still.rows == {3: 0, 4: 0, 7: 0}
    np.testing.assert_allclose(still.clip.at(0.7).trans[0].numpy(), given.trans[0])
    given.poses[1, 4, 0] += 1e-3
    moving = captured_motion(WHERE, given, views, torch.zeros(55, 3))
    assert len(moving.clip) == 3
    assert moving.rows == {3: 0, 4: 1, 7: 2}


def test_a_captured_motion_without_times_is_spread_by_frame_number() -> None:
    filmed = captured_motion(WHERE, bodies([0, 1, 2]), [view(2, None), view(1, None)], torch.zeros(55, 3))
    assert filmed.frames == (1, 2)
    assert filmed.clip.times.tolist() == [0.5, 1.0]


def test_a_view_without_parameters_is_named() -> None:
    with pytest.raises(DyngsError, match="no body parameters for 1 frames that have images"):
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
