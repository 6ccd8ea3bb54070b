"""Placement of motions at the size, position and floor of a person; foot sliding reduction."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import torch
from scipy.linalg import solveh_banded
from scipy.ndimage import binary_opening
from scipy.spatial.transform import Rotation
from torch import Tensor

from dyngs.human.body.body import BodyTemplate
from dyngs.human.body.joints import JOINT_NAMES, SMPLX_ROWS
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


def sole_points(clip: MotionClip, joints: Tensor, parents: tuple[int, ...], floor: float) -> Tensor:
    """Return four points (F, 4, 3) of the soles in world coordinates.

    In the rest pose they lie under the ankles and balls of the feet, at y = ``floor``; ``joints``
    (J, 3) are in the rest pose, m.
    """
    names = ("left_ankle", "left_foot", "right_ankle", "right_foot")
    rows = [SMPLX_ROWS[len(joints)].index(JOINT_NAMES.index(name)) for name in names]
    rest_points = joints[rows].clone()
    rest_points[:, 1] = floor
    transforms = joint_transforms(joints, parents, axis_angle_to_matrix(clip.poses))[:, rows]
    posed = apply_transforms(transforms, rest_points)
    return clip.scale[:, None, None] * posed + clip.trans[:, None]


def floor_contact(clip: MotionClip, soles: Tensor, up: Tensor, fps: float) -> Tensor:
    """Return which sole points (F, P, 3) touch the floor, (F, P) bool.

    A point touches the level floor if it is low and slow for at least 0.1 s: less than 5 cm above
    its lowest height within a second, less than 15 cm above its 5 % quantile, and slower than 0.5
    m/s, in the person's size.

    Args:
        clip: of the person, for the scale.
        soles: (F, P, 3) in world units.
        up: (3,) unit vector.
        fps: frames per second.
    """
    unit = float(clip.scale.mean())
    height = soles @ up / unit
    if len(soles) < 2:
        return torch.zeros_like(height, dtype=torch.bool)
    reach = round(fps)
    lowest = -torch.nn.functional.max_pool1d(-height.T[None], 2 * reach + 1, 1, reach)[0].T
    low = (height < lowest + 0.05) & (height < height.quantile(0.05, dim=0) + 0.15)
    steps = _along_floor(soles, up).norm(dim=-1) / unit * fps
    speed = (torch.cat([steps[:1], steps]) + torch.cat([steps, steps[-1:]])) / 2
    is_contact = (low & (speed < 0.5)).cpu().numpy()
    shortest = max(math.ceil(0.1 * fps), 2)
    return torch.from_numpy(binary_opening(is_contact, np.ones((shortest, 1)))).to(soles.device)


def reduce_foot_sliding(
    clip: MotionClip, soles: Tensor, up: Tensor, fps: float
) -> tuple[MotionClip, str]:
    """Move the root along the floor so that feet in contact do not slide; return the clip and a
    message.

    The root steps u minimise the squared motion of all touching points plus changes of u; their
    mean is kept, so that the person stays in place. Two feet that slide apart cannot both be
    fixed. Arguments as for ``floor_contact``; ``soles`` are those of ``clip``.
    """
    touching = floor_contact(clip, soles, up, fps)
    in_contact = touching[:-1] & touching[1:]
    if not bool(in_contact.any()):
        return (
            clip,
            f"feet: no floor contact in {len(soles)} frames; root unchanged",
        )
    motion = _along_floor(soles, up)
    targets = -(motion * in_contact[..., None]).sum(1).double().cpu().numpy()
    # sum_s |counts_s u_s - wanted_s|^2 / counts_s + stiffness sum |u_s+1 - u_s|^2; the velocity of
    # the root is made smooth over 0.03 s.
    stiffness = (0.03 * fps) ** 2
    bands = np.full((2, len(in_contact)), -stiffness)
    bands[1] = in_contact.sum(1).double().cpu().numpy()
    bands[1, 1:] += stiffness
    bands[1, :-1] += stiffness
    steps = torch.from_numpy(solveh_banded(bands, targets)).to(soles)
    shift = torch.cat([torch.zeros_like(steps[:1]), steps.cumsum(0)])
    before, after = (
        1000 / float(clip.scale.mean()) * float(x.norm(dim=-1)[in_contact].mean())
        for x in (motion, motion + steps[:, None])
    )
    return (
        replace(clip, trans=clip.trans + shift - shift.mean(0)),
        f"feet: floor contact in {int(touching.any(1).sum())} of {len(soles)} frames; sliding "
        f"reduced from {before:.1f} to {after:.1f} mm per frame",
    )


def _along_floor(points: Tensor, up: Tensor) -> Tensor:
    """Return the motion (F - 1, P, 3) of points (F, P, 3) between frames, along the floor."""
    steps = points.diff(dim=0)
    return steps - (steps @ up)[..., None] * up
