"""Placement of motions at the size, position and floor of a person."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import torch
from scipy.spatial.transform import Rotation
from torch import Tensor

from dyngs.human.body.body import BodyTemplate
from dyngs.human.body.skinning import apply_transforms, axis_angle_to_matrix, joint_transforms
from dyngs.human.motion.motion import Motion, MotionClip


def shortest_arc_rotation(start: np.ndarray, end: np.ndarray) -> np.ndarray:
    """Return the smallest rotation (3, 3) between unit vectors; half a turn about any axis for
    opposites."""
    axis = np.cross(start, end)
    # Unlike the arc cosine, accurate near half a turn.
    angle = np.arctan2(np.linalg.norm(axis), start @ end)
    if not axis.any():
        axis = np.cross(start, np.eye(3)[np.abs(start).argmin()])
    axis = axis / np.abs(axis).max()  # squares of tiny values would underflow
    axis = axis / np.linalg.norm(axis)
    # The cross product of nearly opposite vectors is not quite perpendicular.
    axis = axis - start * (start @ axis)
    return Rotation.from_rotvec(angle * axis / np.linalg.norm(axis)).as_matrix()


def place_like(
    clip: MotionClip, like: MotionClip, joints: Tensor, parents: tuple[int, ...]
) -> MotionClip:
    """Place a clip, y up and in metres, at the size and position of the person of ``like``.

    Its up axis becomes ``up_direction(like)``. The lowest joints of both clips are at the same
    height, and their mean pelvis positions on one vertical line. ``joints`` (J, 3) are in the rest
    pose, m.
    """
    up = up_direction(like)
    unit = like.scale.mean()
    rotation = _turn_between(joints.new_tensor([0.0, 1.0, 0.0]), up)
    placed = transform_clip(clip, rotation, unit, torch.zeros_like(joints[0]), joints[0])
    placed_joints, like_joints = (_joints_of(x, joints, parents) for x in (placed, like))
    shift = like_joints[:, 0].mean(0) - placed_joints[:, 0].mean(0)
    rise = (like_joints @ up).amin() - (placed_joints @ up).amin()
    return replace(placed, trans=placed.trans + shift + (rise - shift @ up) * up)


def transform_clip(
    clip: MotionClip, rotation: Tensor, unit: float | Tensor, shift: Tensor, pelvis: Tensor
) -> MotionClip:
    """Apply the similarity x -> unit * rotation x + shift; ``pelvis`` (3,): in rest pose, m."""
    roots = (rotation @ axis_angle_to_matrix(clip.poses[:, 0])).double().cpu().numpy()
    poses = clip.poses.clone()
    poses[:, 0] = torch.from_numpy(Rotation.from_matrix(roots).as_rotvec()).to(poses)
    root = clip.scale[:, None] * pelvis
    trans = unit * ((clip.trans + root) @ rotation.T - root) + shift
    return replace(clip, poses=poses, trans=trans, scale=unit * clip.scale)


def rotate_clip_to_y_up(clip: MotionClip, like: MotionClip, joints: Tensor) -> MotionClip:
    """Rotate the world of a clip about the origin so that ``up_direction(like)`` becomes y.

    ``joints`` (J, 3) are in the rest pose, m.
    """
    rotation = _turn_between(up_direction(like), joints.new_tensor([0.0, 1.0, 0.0]))
    return transform_clip(clip, rotation, 1.0, torch.zeros_like(joints[0]), joints[0])


def rest_clip(like: MotionClip, joints: Tensor, parents: tuple[int, ...]) -> MotionClip:
    """Return a clip of one frame: the rest pose at the position and size of the person of
    ``like``.

    ``place_like`` with this clip gives the same result as with ``like``.
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
    """Return the mean up direction (3,) of the pelvis, or a world axis within 30 degrees of it."""
    mean = torch.nn.functional.normalize(
        axis_angle_to_matrix(clip.poses[:, 0])[:, :, 1].mean(0), dim=0
    )
    axis = torch.zeros_like(mean)
    largest = mean.abs().argmax()
    axis[largest] = mean[largest].sign()
    return axis if float(mean @ axis) >= 0.87 else mean  # the cosine of 30 degrees


def _turn_between(start: Tensor, end: Tensor) -> Tensor:
    one, other = (x.double().cpu().numpy() for x in (start, end))
    return torch.from_numpy(shortest_arc_rotation(one, other)).to(start)


def _joints_of(clip: MotionClip, joints: Tensor, parents: tuple[int, ...]) -> Tensor:
    moved = apply_transforms(
        joint_transforms(joints, parents, axis_angle_to_matrix(clip.poses)), joints
    )
    return clip.scale[:, None, None] * moved + clip.trans[:, None]


def place_on_floor(motion: Motion, body: BodyTemplate) -> Motion:
    """Move a motion of 55 joints vertically so that its lowest vertex (mean shape) is at y = 0.

    Pose blend shapes, which are millimetres, are ignored.
    """
    points = torch.nn.functional.pad(body.vertices, (0, 1), value=1.0)
    lowest = []
    for poses in motion.for_joints(len(body.joints)).poses.split(64):  # bounds the memory
        transforms = joint_transforms(body.joints, body.parents, axis_angle_to_matrix(poses))
        heights = torch.einsum("mj,fjk->mfk", body.weights, transforms[:, :, 1])
        lowest.append((heights * points[:, None]).sum(-1).amin(0))
    trans = motion.trans.clone()
    trans[:, 1] -= (torch.cat(lowest) * motion.scale + trans[:, 1]).min()
    return replace(motion, trans=trans)
