"""A person's motion in the world of the cameras: body parameters at the times of a clip, and at any moment between.

Local letters: F frames, J joints, V views.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from dyngs.data.body_frames import about_pelvis, rows_of
from dyngs.data.capture import BodyFrames, View
from dyngs.human.motion.motion import ROWS, Motion
from dyngs.human.pose.skinning import apply_transforms, axis_angle_to_matrix, joint_transforms

_SAME_TIME = 1e-9

_ALONG_AXIS = 0.87
"""Cosine of 30 degrees."""


@dataclass(frozen=True)
class MotionClip:
    """Poses of a body at F >= 1 moments.

    Attributes:
        times: (F,) float64 in [0, 1], ascending, no two alike.
        poses: (F, J, 3) axis-angle relative to the parent joint, rad.
        trans: (F, 3) world units, added last.
        scale: (F,) world units per metre of the template.
    """

    times: Tensor
    poses: Tensor
    trans: Tensor
    scale: Tensor

    def __len__(self) -> int:
        return len(self.times)

    def select(self, rows: Tensor) -> MotionClip:
        """The frames at ``rows``, ascending."""
        return MotionClip(self.times[rows], self.poses[rows], self.trans[rows], self.scale[rows])

    def at(self, time: float | None) -> MotionClip:
        """The one frame at ``time``, clamped to those there are; None is the first.

        Between two frames rotations turn evenly the shorter way, all else is linear.
        """
        times = self.times
        moment = float(times[0]) if time is None else min(max(time, float(times[0])), float(times[-1]))
        after = int(torch.searchsorted(times, moment - _SAME_TIME).clamp_max(len(self) - 1))
        if abs(float(times[after]) - moment) <= _SAME_TIME:
            return self.select(torch.tensor([after]))
        before = after - 1
        share = (moment - float(times[before])) / float(times[after] - times[before])
        return MotionClip(
            times=torch.tensor([moment], dtype=times.dtype),
            poses=_turned_partly(self.poses[before], self.poses[after], share)[None],
            trans=torch.lerp(self.trans[before], self.trans[after], share)[None],
            scale=torch.lerp(self.scale[before], self.scale[after], share)[None],
        )


@dataclass(frozen=True)
class CapturedMotion:
    """The frames of a clip that have pictures.

    Attributes:
        clip: F moments.
        frames: (F,) frame number of each, as views name them.
    """

    clip: MotionClip
    frames: tuple[int, ...]


def captured_motion(where: Path, given: BodyFrames, views: Sequence[View], joints: Tensor) -> CapturedMotion:
    """The frames of ``given`` that ``views`` show, for a body with ``joints`` (J, 3) at rest.

    Joints that the body of ``given`` lacks do not turn. Views without times are spread over [0, 1] by frame number.

    Args:
        where: the capture, for messages.
        given: body parameters.
        views: V >= 1 views.
        joints: of the shaped template.

    Raises:
        DyngsError: a view without parameters.
    """
    found = about_pelvis(given, joints[0].double().numpy())
    rows = rows_of(where, found, views)
    last = max(len(found.frames) - 1, 1)
    moments = {
        row: row / last if view.time is None else view.time for view, row in zip(views, rows.tolist(), strict=True)
    }
    order = sorted(moments, key=lambda row: (moments[row], row))
    kept = [row for i, row in enumerate(order) if i == 0 or moments[row] > moments[order[i - 1]]]
    return CapturedMotion(
        MotionClip(
            times=torch.tensor([moments[row] for row in kept], dtype=torch.float64),
            poses=_for_joints(torch.from_numpy(found.poses[kept]).float(), len(joints)),
            trans=torch.from_numpy(found.trans[kept]).float(),
            scale=torch.from_numpy(found.scale[kept]).float(),
        ),
        tuple(found.frames[row] for row in kept),
    )


def same_bodies(a: BodyFrames, b: BodyFrames) -> bool:
    """Whether both hold the same bodies in the same frames."""
    pairs = ((getattr(a, name), getattr(b, name)) for name in ("poses", "trans", "scale"))
    return a.frames == b.frames and all(np.array_equal(x, y) for x, y in pairs)


def motion_clip(motion: Motion) -> MotionClip:
    """The clip of a motion file, its frames spread evenly over [0, 1], where and as large as the file says."""
    count = len(motion)
    times = torch.from_numpy(np.linspace(0, 1, count)) if count > 1 else torch.zeros(1, dtype=torch.float64)
    return MotionClip(times, motion.poses.float(), motion.trans.float(), motion.scale.float())


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


def _for_joints(poses: Tensor, count: int) -> Tensor:
    """(F, count, 3) of poses of another body's joints (F, J, 3); joints that one of them lacks do not turn."""
    if poses.shape[1] == count:
        return poses
    known = poses.new_zeros(len(poses), 55, 3)
    theirs, ours = ROWS[poses.shape[1]], ROWS[count]
    known[:, list(theirs)] = poses[:, : len(theirs)]
    wanted = poses.new_zeros(len(poses), count, 3)
    wanted[:, : len(ours)] = known[:, list(ours)]
    return wanted


def _turned_partly(before: Tensor, after: Tensor, share: float) -> Tensor:
    """(J, 3) rotations between two of those: R_a exp(s log(R_a^T R_b))."""
    from scipy.spatial.transform import Rotation

    start = Rotation.from_rotvec(before.double().numpy())
    turn = (start.inv() * Rotation.from_rotvec(after.double().numpy())).as_rotvec()
    return torch.from_numpy((start * Rotation.from_rotvec(share * turn)).as_rotvec()).to(before)
