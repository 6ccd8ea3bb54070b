"""Motion clips moved to the size, place, floor and up direction of a captured person."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import torch
from scipy.sparse import csr_array
from torch import Tensor

from dyngs.human.body.body import BodyTemplate
from dyngs.human.body.skinning import apply_transforms, axis_angle_to_matrix, joint_transforms
from dyngs.human.motion.motion import Motion, MotionClip, frame_chunks

# cosine of 30 degrees: how near to the up direction a world axis must be to replace it
_ALONG_AXIS = 0.87


def place_like(
    clip: MotionClip, like: MotionClip, joints: Tensor, parents: tuple[int, ...]
) -> MotionClip:
    """Return a clip of any person, y up and in metres, at the size and place of the person of
    ``like``.

    Its up axis becomes ``up_direction(like)``; the lowest joints of both clips are equally high,
    and their mean pelvis positions lie on one vertical line. ``like`` is the clip of training; both
    apply to ``joints`` (J, 3) at rest, m.
    """
    up = up_direction(like)
    unit = like.scale.mean()
    rotation = _least_rotation(joints.new_tensor([0.0, 1.0, 0.0]), up)
    there = moved(clip, rotation, unit, torch.zeros_like(joints[0]), joints[0])
    ours, theirs = (_joints_of(x, joints, parents) for x in (there, like))
    shift = theirs[:, 0].mean(0) - ours[:, 0].mean(0)
    rise = (theirs @ up).amin() - (ours @ up).amin()
    return replace(there, trans=there.trans + shift + (rise - shift @ up) * up)


def moved(
    clip: MotionClip, rotation: Tensor, unit: float | Tensor, shift: Tensor, pelvis: Tensor
) -> MotionClip:
    """Return a clip as it is in the world x -> unit * rotation x + shift; ``pelvis``: (3,) of the
    person at rest, m."""
    roots = rotation @ axis_angle_to_matrix(clip.poses[:, 0])
    poses = torch.cat([_axis_angle(roots)[:, None], clip.poses[:, 1:]], dim=1)
    root = clip.scale[:, None] * pelvis
    trans = unit * ((clip.trans + root) @ rotation.T - root) + shift
    return replace(clip, poses=poses, trans=trans, scale=unit * clip.scale)


def upright(clip: MotionClip, like: MotionClip, joints: Tensor) -> MotionClip:
    """Return a clip in the world of the person of ``like`` turned about the origin so that y is up
    there.

    ``like`` is the clip of training, whose ``up_direction`` becomes y; ``joints`` (J, 3) are at
    rest, m.
    """
    rotation = _least_rotation(up_direction(like), joints.new_tensor([0.0, 1.0, 0.0]))
    return moved(clip, rotation, 1.0, torch.zeros_like(joints[0]), joints[0])


def rest_clip(like: MotionClip, joints: Tensor, parents: tuple[int, ...]) -> MotionClip:
    """Return a clip of one frame: the rest pose at the place and size of the person of ``like``.

    ``place_like`` it gives the same result as ``place_like`` the clip ``like``.
    """
    zeros = torch.zeros_like(like.poses[:1])
    rest = MotionClip(
        torch.zeros(1, dtype=torch.float64, device="cpu"),
        zeros,
        zeros[:, 0],
        torch.ones_like(like.scale[:1]),
    )
    return place_like(rest, like, joints, parents)


def up_direction(clip: MotionClip) -> Tensor:
    """Return the mean up direction of the pelvis, a unit vector (3,), or the world axis within 30
    degrees of it."""
    mean = torch.nn.functional.normalize(
        axis_angle_to_matrix(clip.poses[:, 0])[:, :, 1].mean(0), dim=0
    )
    largest = int(mean.abs().argmax())
    if float(mean[largest].abs()) < _ALONG_AXIS:
        return mean
    return torch.eye(3, dtype=mean.dtype, device=mean.device)[largest] * mean[largest].sign()


def _least_rotation(start: Tensor, end: Tensor) -> Tensor:
    """Return the smallest rotation (3, 3) from one unit vector to another."""
    axis = torch.linalg.cross(start, end)
    cosine = (start @ end).clamp(-1, 1)
    if float(axis.norm()) < 1e-6:
        across = torch.eye(3, dtype=start.dtype, device=start.device)[int(start.abs().argmin())]
        axis = torch.linalg.cross(start, across)
    return axis_angle_to_matrix(torch.nn.functional.normalize(axis, dim=0) * cosine.acos())


def _axis_angle(rotations: Tensor) -> Tensor:
    from scipy.spatial.transform import Rotation

    return torch.from_numpy(Rotation.from_matrix(rotations.double().cpu().numpy()).as_rotvec()).to(
        rotations
    )


def _joints_of(clip: MotionClip, joints: Tensor, parents: tuple[int, ...]) -> Tensor:
    moved = apply_transforms(
        joint_transforms(joints, parents, axis_angle_to_matrix(clip.poses)), joints
    )
    return clip.scale[:, None, None] * moved + clip.trans[:, None]


def place_on_floor(motion: Motion, body: BodyTemplate) -> Motion:
    """Return the motion of 55 joints moved up or down as a whole, with its lowest vertex (mean
    shape) at y = 0.

    Pose blend shapes, which are millimetres, are ignored.
    """
    lowest = (
        _lowest_heights(motion.for_joints(len(body.joints)).poses, body) * motion.scale
        + motion.trans[:, 1]
    )
    trans = motion.trans.clone()
    trans[:, 1] -= lowest.min()
    return replace(motion, trans=trans)


def _lowest_heights(poses: Tensor, body: BodyTemplate) -> Tensor:
    """Return the smallest y (F,) of the vertices in poses (F, J, 3); only row y of the transforms
    is blended."""
    vertex, joint = body.weights.nonzero(as_tuple=True)
    points = torch.cat([body.vertices, torch.ones_like(body.vertices[:, :1])], dim=1)
    values = (body.weights[vertex, joint][:, None] * points[vertex]).double().cpu().numpy()
    columns = (4 * joint[:, None] + torch.arange(4, device=joint.device)).cpu().numpy()
    rows = vertex.repeat_interleave(4).cpu().numpy()
    height = csr_array(
        (values.ravel(), (rows, columns.ravel())), shape=(len(points), 4 * len(body.joints))
    )
    lowest = []
    for part in frame_chunks(len(poses)):
        transforms = joint_transforms(body.joints, body.parents, axis_angle_to_matrix(poses[part]))
        y_rows = transforms[:, :, 1].flatten(1).double().cpu().numpy()
        lowest += [
            (height @ few.T).min(axis=0)
            for few in np.array_split(y_rows, range(64, len(y_rows), 64))
        ]
    return torch.from_numpy(np.concatenate(lowest)).to(poses)
