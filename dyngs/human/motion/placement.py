"""Motions moved to the size, place and floor of a person, with feet that stay on the floor."""

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
    """Return the smallest rotation (3, 3) from one unit vector to another; half a turn about any
    axis for opposites."""
    axis = np.cross(start, end)
    # accurate near half a turn, unlike the cosine
    angle = np.arctan2(np.linalg.norm(axis), start @ end)
    if not axis.any():
        axis = np.cross(start, np.eye(3)[np.abs(start).argmin()])
    axis = axis / np.abs(axis).max()  # first, as squares of 1e-200 underflow
    axis = axis / np.linalg.norm(axis)
    # the product of nearly opposite vectors is not quite perpendicular
    axis = axis - start * (start @ axis)
    return Rotation.from_rotvec(angle * axis / np.linalg.norm(axis)).as_matrix()


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
    rotation = _turn_between(joints.new_tensor([0.0, 1.0, 0.0]), up)
    there = transform_clip(clip, rotation, unit, torch.zeros_like(joints[0]), joints[0])
    ours, theirs = (_joints_of(x, joints, parents) for x in (there, like))
    shift = theirs[:, 0].mean(0) - ours[:, 0].mean(0)
    rise = (theirs @ up).amin() - (ours @ up).amin()
    return replace(there, trans=there.trans + shift + (rise - shift @ up) * up)


def transform_clip(
    clip: MotionClip, rotation: Tensor, unit: float | Tensor, shift: Tensor, pelvis: Tensor
) -> MotionClip:
    """Return a clip as it is in the world x -> unit * rotation x + shift; ``pelvis``: (3,) of the
    person at rest, m."""
    roots = (rotation @ axis_angle_to_matrix(clip.poses[:, 0])).double().cpu().numpy()
    poses = clip.poses.clone()
    poses[:, 0] = torch.from_numpy(Rotation.from_matrix(roots).as_rotvec()).to(poses)
    root = clip.scale[:, None] * pelvis
    trans = unit * ((clip.trans + root) @ rotation.T - root) + shift
    return replace(clip, poses=poses, trans=trans, scale=unit * clip.scale)


def rotate_clip_to_y_up(clip: MotionClip, like: MotionClip, joints: Tensor) -> MotionClip:
    """Return a clip in the world of the person of ``like`` turned about the origin so that y is up
    there.

    ``like`` is the clip of training, whose ``up_direction`` becomes y; ``joints`` (J, 3) are at
    rest, m.
    """
    rotation = _turn_between(up_direction(like), joints.new_tensor([0.0, 1.0, 0.0]))
    return transform_clip(clip, rotation, 1.0, torch.zeros_like(joints[0]), joints[0])


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
    """Return the motion of 55 joints moved up or down as a whole, with its lowest vertex (mean
    shape) at y = 0.

    Pose blend shapes, which are millimetres, are ignored.
    """
    points = torch.nn.functional.pad(body.vertices, (0, 1), value=1.0)
    lowest = []
    for poses in motion.for_joints(len(body.joints)).poses.split(64):  # so that memory is bounded
        moves = joint_transforms(body.joints, body.parents, axis_angle_to_matrix(poses))
        heights = torch.einsum("mj,fjk->mfk", body.weights, moves[:, :, 1])
        lowest.append((heights * points[:, None]).sum(-1).amin(0))
    trans = motion.trans.clone()
    trans[:, 1] -= (torch.cat(lowest) * motion.scale + trans[:, 1]).min()
    return replace(motion, trans=trans)


def sole_points(clip: MotionClip, joints: Tensor, parents: tuple[int, ...], floor: float) -> Tensor:
    """Return (F, P, 3) points of the soles in the world, of a person with ``joints`` (J, 3) at
    rest, y up, m.

    At rest they lie under ankles and balls of the feet, at y = ``floor``.
    """
    names = ("left_ankle", "left_foot", "right_ankle", "right_foot")
    rows = [SMPLX_ROWS[len(joints)].index(JOINT_NAMES.index(name)) for name in names]
    at_rest = joints[rows].clone()
    at_rest[:, 1] = floor
    transforms = joint_transforms(joints, parents, axis_angle_to_matrix(clip.poses))[:, rows]
    moved = apply_transforms(transforms, at_rest)
    return clip.scale[:, None, None] * moved + clip.trans[:, None]


def floor_contact(clip: MotionClip, soles: Tensor, up: Tensor, fps: float) -> Tensor:
    """Return which points ``soles`` (F, P, 3), world units, of a person in ``clip`` touch the
    floor, (F, P) bool.

    The floor is level. A point touches it where it is low and slow for at least 0.1 s: at most 5 cm
    above its lowest height within a second, as other legs sink or float while they bend, but 15 cm
    above what it is below in 5 % of the frames, and slower than 0.5 m/s, all of the person's size.
    ``up`` (3,) is the unit vector, ``fps`` are frames per second.
    """
    unit = float(clip.scale.mean())
    height = soles @ up / unit
    if len(soles) < 2:
        return torch.zeros_like(height, dtype=torch.bool)
    reach = round(fps)
    around = -torch.nn.functional.max_pool1d(-height.T[None], 2 * reach + 1, 1, reach)[0].T
    low = (height < around + 0.05) & (height < height.quantile(0.05, dim=0) + 0.15)
    steps = _along_floor(soles, up).norm(dim=-1) / unit * fps
    speed = (torch.cat([steps[:1], steps]) + torch.cat([steps, steps[-1:]])) / 2
    is_still = (low & (speed < 0.5)).cpu().numpy()
    shortest = max(math.ceil(0.1 * fps), 2)
    return torch.from_numpy(binary_opening(is_still, np.ones((shortest, 1)))).to(soles.device)


def reduce_foot_sliding(
    clip: MotionClip, soles: Tensor, up: Tensor, fps: float
) -> tuple[MotionClip, str]:
    """Return the clip with the root moved along the floor so that feet that touch it stay; and a
    line about how far they slide, before and after.

    The steps u of the root minimize the squared motion of all touching points, and the changes of
    u, which carries it through frames in which nothing touches; their sum keeps its mean, so that
    the person stays where it is. Two feet that slide apart cannot both be kept. Arguments as of
    ``floor_contact``; ``soles`` are those of the clip as given.
    """
    touching = floor_contact(clip, soles, up, fps)
    both = touching[:-1] & touching[1:]
    if not bool(both.any()):
        return (
            clip,
            f"feet: none touches the floor in {len(soles)} frames; the root stays as it is",
        )
    moves = _along_floor(soles, up)
    wanted = -(moves * both[..., None]).sum(1).double().cpu().numpy()
    # sum_s |counts_s u_s - wanted_s|^2 / counts_s + stiffness sum |u_s+1 - u_s|^2; the velocity of
    # the root is made smooth over 0.03 s.
    stiffness = (0.03 * fps) ** 2
    bands = np.full((2, len(both)), -stiffness)
    bands[1] = both.sum(1).double().cpu().numpy()
    bands[1, 1:] += stiffness
    bands[1, :-1] += stiffness
    steps = torch.from_numpy(solveh_banded(bands, wanted)).to(soles)
    shift = torch.cat([torch.zeros_like(steps[:1]), steps.cumsum(0)])
    before, after = (
        1000 / float(clip.scale.mean()) * float(x.norm(dim=-1)[both].mean())
        for x in (moves, moves + steps[:, None])
    )
    return (
        replace(clip, trans=clip.trans + shift - shift.mean(0)),
        f"feet: on the floor in {int(touching.any(1).sum())} of {len(soles)} frames, where they slide "
        f"{before:.1f} mm per frame; with the root moved {after:.1f} mm",
    )


def _along_floor(points: Tensor, up: Tensor) -> Tensor:
    """Return the motion (F - 1, P, 3) of points (F, P, 3) from each frame to the next, along the
    floor."""
    steps = points.diff(dim=0)
    return steps - (steps @ up)[..., None] * up
