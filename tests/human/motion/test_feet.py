"""Feet on the floor: contact found, sliding measured and taken away, at any size, rate and up
direction."""

from __future__ import annotations

import re

import pytest
import torch
from torch import Tensor

from dyngs.human.body.body_reader import default_template
from dyngs.human.body.joints import JOINT_NAMES
from dyngs.human.motion.motion import MotionClip
from dyngs.human.motion.placement import floor_contact, reduce_foot_sliding, sole_points

FPS = 30.0
BODY = default_template()
FLOOR = float(BODY.vertices[:, 1].min())
Y = torch.tensor([0.0, 1.0, 0.0])


def clip_of(trans: Tensor, poses: Tensor | None = None) -> MotionClip:
    count = len(trans)
    poses = torch.zeros(count, len(BODY.joints), 3) if poses is None else poses
    return MotionClip(
        torch.linspace(0, 1, count, dtype=torch.float64), poses, trans, torch.ones(count)
    )


def soles_of(clip: MotionClip) -> Tensor:
    return sole_points(clip, BODY.joints, BODY.parents, FLOOR)


def steps(count: int, step: tuple[float, float, float]) -> Tensor:
    return torch.arange(count)[:, None] * torch.tensor(step)


def test_soles_are_on_the_floor_under_the_feet_and_follow_them() -> None:
    poses = torch.zeros(2, len(BODY.joints), 3)
    poses[1, JOINT_NAMES.index("left_hip"), 0] = -1.0
    points = soles_of(clip_of(torch.zeros(2, 3), poses))
    assert torch.allclose(points[0, :, 1], torch.full((4,), FLOOR), atol=1e-6)
    assert (points[0, :2, 0] > 0).all(), "left"
    assert (points[0, 2:, 0] < 0).all(), "right"
    assert (points[1, :2, 1] > FLOOR + 0.1).all(), "the left leg is lifted"
    assert torch.allclose(points[1, 2:], points[0, 2:])


def test_a_person_who_stands_and_is_pushed_stays_where_it_is() -> None:
    clip = clip_of(steps(20, (0.004, 0.0, 0.003)))
    kept, note = reduce_foot_sliding(clip, soles_of(clip), Y, FPS)
    assert note == (
        "feet: floor contact in 20 of 20 frames; sliding reduced from 5.0 to 0.0 mm per frame"
    )
    torch.testing.assert_close(kept.trans, clip.trans.mean(0).expand(20, 3), rtol=0, atol=1e-5)


def walk(stride: float, root: float) -> MotionClip:
    """Legs that swing by turns as stilts, 20 frames each; the root moves by ``root`` over what
    would keep the feet."""
    count = 80
    poses = torch.zeros(80, len(BODY.joints), 3)
    swing = torch.linspace(-stride, stride, 20)
    trans = torch.zeros(count, 3)
    left, right, knees = (JOINT_NAMES.index(x) for x in ("left_hip", "right_hip", "left_knee"))
    for k in range(4):
        rows = slice(20 * k, 20 * (k + 1))
        stands, lifts = (left, right) if k % 2 == 0 else (right, left)
        poses[rows, stands, 0] = swing
        poses[rows, lifts, 0] = -swing - 0.6
        poses[rows, knees + (lifts == right), 0] = 1.2
    # the foot that stands is where it is: the root follows from it
    soles = soles_of(clip_of(trans, poses))
    standing = torch.stack([soles[i, 0 if (i // 20) % 2 == 0 else 2] for i in range(count)])
    path = -standing.diff(dim=0)
    path[19::20] = path[18:78:20]
    trans[1:] = root * path.cumsum(0) * torch.tensor([1.0, 0.0, 1.0])
    return clip_of(trans, poses)


def test_a_walk_with_a_root_that_is_too_fast_is_slowed_down_to_the_feet() -> None:
    true = walk(0.3, 1.0)
    fast = walk(0.3, 1.3)
    kept, note = reduce_foot_sliding(fast, soles_of(fast), Y, FPS)
    frames, _, before, after = (float(x) for x in re.findall(r"[\d.]+", note))
    assert frames > 60
    assert after < 0.4 * before
    length = [float((x.trans[-1] - x.trans[0]).norm()) for x in (true, fast, kept)]
    assert length[1] == pytest.approx(1.3 * length[0], rel=1e-3)
    assert length[2] == pytest.approx(length[0], rel=0.1)
    assert torch.equal(kept.trans[:, 1], fast.trans[:, 1]), "along the floor alone"
    assert torch.equal(kept.poses, fast.poses)


def test_feet_that_sink_into_the_floor_while_other_legs_bend_still_touch_it() -> None:
    trans = steps(150, (0.003, 0.0, 0.0))
    trans[70:110, 1] = -0.1
    touching = floor_contact(clip_of(trans), soles_of(clip_of(trans)), Y, FPS)
    assert touching[:38].all(), "a second away"
    assert touching[72:108].all()
    assert touching[142:].all()
    lifted = torch.zeros(150, 3)
    lifted[50:100, 1] = 0.3
    touching = floor_contact(clip_of(lifted), soles_of(clip_of(lifted)), Y, FPS)
    assert not touching[51:99].any()
