"""Clips in time, from captures and from motion files: between frames, by frame numbers, and where they are put."""

from __future__ import annotations

import pytest
import torch

from dyngs.human.motion.clip import MotionClip, motion_clip
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
