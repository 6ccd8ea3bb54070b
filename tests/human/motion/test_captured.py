"""The motion of captures: by the frame numbers and times of their views."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch

from dyngs.data.body_frames import body_frames
from dyngs.data.capture import BodyFrames, View
from dyngs.errors import DyngsError
from dyngs.human.motion.captured import captured_motion, same_bodies

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
