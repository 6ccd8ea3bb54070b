"""Motion clips brought to the size, place, floor and up direction of a captured person."""

from __future__ import annotations

from dataclasses import replace

import torch
from torch import Tensor

from dyngs.human.motion.clip import MotionClip
from dyngs.human.pose.skinning import apply_transforms, axis_angle_to_matrix, joint_transforms

_ALONG_AXIS = 0.87
"""Cosine of 30 degrees."""


def place_like(clip: MotionClip, like: MotionClip, joints: Tensor, parents: tuple[int, ...]) -> MotionClip:
    """The clip of anybody, y up and in metres, brought to the size and the place of the person of ``like``.

    Up becomes the way in which the pelvis of ``like`` points on average, or the world axis that is within 30 degrees of
    it; the lowest joint of both is equally high, and the mean pelvis of both on one plumb line.

    Args:
        clip: to be moved.
        like: the clip that was trained on.
        joints: (J, 3) at rest, which both are given for.
        parents: of the joints.
    """
    up = up_direction(like)
    unit = like.scale.mean()
    turn = _least_rotation(joints.new_tensor([0.0, 1.0, 0.0]), up)
    roots = turn @ axis_angle_to_matrix(clip.poses[:, 0])
    poses = torch.cat([_axis_angle(roots)[:, None], clip.poses[:, 1:]], dim=1)
    pelvis = clip.scale[:, None] * joints[0]
    moved = MotionClip(clip.times, poses, unit * ((clip.trans + pelvis) @ turn.T - pelvis), unit * clip.scale)
    ours, theirs = (_joint_places(x, joints, parents) for x in (moved, like))
    shift = theirs[:, 0].mean(0) - ours[:, 0].mean(0)
    rise = (theirs @ up).amin() - (ours @ up).amin()
    return replace(moved, trans=moved.trans + shift + (rise - shift @ up) * up)


def rest_clip(like: MotionClip, joints: Tensor, parents: tuple[int, ...]) -> MotionClip:
    """The rest pose on the floor of ``like``, as large and as high as the person there; one frame.

    What is ``placed`` like it, is placed as it would be like ``like``.
    """
    nothing = torch.zeros_like(like.poses[:1])
    rest = MotionClip(torch.zeros(1, dtype=torch.float64), nothing, nothing[:, 0], torch.ones_like(like.scale[:1]))
    return place_like(rest, like, joints, parents)


def up_direction(clip: MotionClip) -> Tensor:
    """(3,) unit vector in which the pelvis points on average, or the world axis within 30 degrees of it."""
    mean = torch.nn.functional.normalize(axis_angle_to_matrix(clip.poses[:, 0])[:, :, 1].mean(0), dim=0)
    largest = int(mean.abs().argmax())
    if float(mean[largest].abs()) < _ALONG_AXIS:
        return mean
    return torch.nn.functional.one_hot(torch.tensor(largest), 3).to(mean) * mean[largest].sign()


def _least_rotation(start: Tensor, end: Tensor) -> Tensor:
    """(3, 3) the least turn of unit vector ``start`` to ``end``."""
    axis, cosine = torch.linalg.cross(start, end), (start @ end).clamp(-1, 1)
    if float(axis.norm()) < 1e-6:
        across = torch.eye(3)[int(start.abs().argmin())]
        axis = torch.linalg.cross(start, across)
    return axis_angle_to_matrix(torch.nn.functional.normalize(axis, dim=0) * cosine.acos())


def _axis_angle(turns: Tensor) -> Tensor:
    """(F, 3) of rotations (F, 3, 3)."""
    from scipy.spatial.transform import Rotation

    return torch.from_numpy(Rotation.from_matrix(turns.double().numpy()).as_rotvec()).to(turns)


def _joint_places(clip: MotionClip, joints: Tensor, parents: tuple[int, ...]) -> Tensor:
    """(F, J, 3) joints in the world."""
    moved = apply_transforms(joint_transforms(joints, parents, axis_angle_to_matrix(clip.poses)), joints)
    return clip.scale[:, None, None] * moved + clip.trans[:, None]
