"""Motions moved to the size, place and floor of a person, with feet that stay on the floor."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import torch
from scipy.sparse import csr_array
from torch import Tensor

from dyngs.human.body.body import BodyTemplate
from dyngs.human.body.joints import JOINT_NAMES, SMPLX_ROWS
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


_SOLES = ("left_ankle", "left_foot", "right_ankle", "right_foot")
_HEIGHT, _SPEED, _SHORTEST = 0.05, 0.5, 0.1
"""A point touches the floor lower than this, m, and slower, m/s of the person's size, for at least
so long, s."""
_AROUND, _SINKS = 1.0, 0.15
"""Heights are above the lowest within this time, s, as other legs sink or float while they bend;
and by no more than this, m, above the lowest of all."""
# fraction of the frames in which a point may be lower than what counts as the lowest of all
_FLOOR = 0.05
_LASTS = 0.03  # time over which the velocity of the root is made smooth, s


@dataclass(frozen=True)
class FootContact:
    """How the feet of a person stand in a motion of F frames."""

    touching: Tensor  # (F, P) bool, which points of the soles touch the floor
    # mean distance that these move along the floor from one frame to the next, m of the person's
    # size
    slide: float

    @property
    def frames(self) -> int:
        """Number of frames in which a foot touches the floor."""
        return int(self.touching.any(1).sum())

    def compared(self, after: FootContact) -> str:
        """Return a line about this contact, and that with the root moved."""
        if not self.frames:
            return f"feet: none touches the floor in {len(self.touching)} frames; the root stays as it is"
        return (
            f"feet: on the floor in {self.frames} of {len(self.touching)} frames, where they slide "
            f"{1000 * self.slide:.1f} mm per frame; with the root moved {1000 * after.slide:.1f} mm"
        )


def foot_contact(clip: MotionClip, soles: Tensor, up: Tensor, fps: float) -> FootContact:
    """Return where points ``soles`` (F, P, 3), world units, of a person in ``clip`` touch the
    floor, and slide there.

    The floor is level: each point's height in the lowest frames around. ``up`` (3,) is the unit
    vector, ``fps`` are frames per second.
    """
    unit = float(clip.scale.mean())
    height = soles @ up / unit
    moves = _along_floor(soles, up) / unit
    if len(soles) < 2:
        return FootContact(torch.zeros_like(height, dtype=torch.bool), 0.0)
    reach = round(_AROUND * fps)
    around = -torch.nn.functional.max_pool1d(-height.T[None], 2 * reach + 1, 1, reach)[0].T
    low = (height < around + _HEIGHT) & (height < height.quantile(_FLOOR, dim=0) + _SINKS)
    steps = moves.norm(dim=-1) * fps
    speed = (torch.cat([steps[:1], steps]) + torch.cat([steps, steps[-1:]])) / 2
    touching = _long_runs(low & (speed < _SPEED), _SHORTEST * fps)
    return FootContact(touching, _slide(moves, touching))


def feet_kept(
    clip: MotionClip, soles: Tensor, up: Tensor, fps: float
) -> tuple[MotionClip, FootContact, FootContact]:
    """Return the clip with the root moved along the floor so that feet that touch it stay; the
    contact before, after.

    The steps u of the root minimize the squared motion of all touching points, and the changes of
    u, which carries it through frames in which nothing touches; their sum keeps its mean, so that
    the person stays where it is. Two feet that slide apart cannot both be kept. Arguments as of
    ``foot_contact``; ``soles`` are those of the clip as given.
    """
    before = foot_contact(clip, soles, up, fps)
    if not before.frames:
        return clip, before, before
    moves = _along_floor(soles, up)
    both = _in_both(before.touching)
    counts = both.sum(1).double().cpu().numpy()
    wanted = -(moves * both[..., None]).sum(1).double().cpu().numpy()
    steps = torch.from_numpy(_smooth_steps(counts, wanted, (_LASTS * fps) ** 2)).to(soles)
    shift = torch.cat([torch.zeros_like(steps[:1]), steps.cumsum(0)])
    shift = shift - shift.mean(0)
    slide = _slide(
        _along_floor(soles + shift[:, None], up) / float(clip.scale.mean()), before.touching
    )
    return replace(clip, trans=clip.trans + shift), before, replace(before, slide=slide)


def sole_points(clip: MotionClip, joints: Tensor, parents: tuple[int, ...], floor: float) -> Tensor:
    """Return (F, P, 3) points of the soles in the world, of a person with ``joints`` (J, 3) at
    rest, y up, m.

    At rest they lie under ankles and balls of the feet, at y = ``floor``.
    """
    rows = [SMPLX_ROWS[len(joints)].index(JOINT_NAMES.index(name)) for name in _SOLES]
    at_rest = joints[rows].clone()
    at_rest[:, 1] = floor
    transforms = joint_transforms(joints, parents, axis_angle_to_matrix(clip.poses))[:, rows]
    moved = (transforms[..., :3] @ at_rest[..., None])[..., 0] + transforms[..., 3]
    return clip.scale[:, None, None] * moved + clip.trans[:, None]


def _along_floor(points: Tensor, up: Tensor) -> Tensor:
    """Return the motion (F - 1, P, 3) of points (F, P, 3) from each frame to the next, along the
    floor."""
    steps = points.diff(dim=0)
    return steps - (steps @ up)[..., None] * up


def _in_both(touching: Tensor) -> Tensor:
    """Return (F - 1, P) bool: what touches the floor in a frame and in the next."""
    return touching[:-1] & touching[1:]


def _slide(moves: Tensor, touching: Tensor) -> float:
    both = _in_both(touching)
    return float(moves.norm(dim=-1)[both].mean()) if bool(both.any()) else 0.0


def _long_runs(flags: Tensor, least: float) -> Tensor:
    """Return flags (F, P) without runs of fewer than ``least`` frames, and those of one frame."""
    kept = flags.cpu().numpy().copy()
    for column in kept.T:
        edges = np.flatnonzero(np.diff(np.concatenate([[0], column.astype(np.int8), [0]])))
        for start, end in edges.reshape(-1, 2):
            column[start:end] = end - start >= max(least, 2)
    return torch.from_numpy(kept).to(flags.device)


def _smooth_steps(counts: np.ndarray, wanted: np.ndarray, stiffness: float) -> np.ndarray:
    """Return u (S, 3) that minimizes sum_s |counts_s u_s - wanted_s|^2 / counts_s + stiffness sum
    |u_s+1 - u_s|^2.

    ``counts`` (S,) are >= 0, not all of them 0; ``wanted`` (S, 3) is 0 where they are.
    """
    from scipy.linalg import solveh_banded

    bands = np.zeros((2, len(counts)))
    bands[1] = counts
    bands[1, 1:] += stiffness
    bands[1, :-1] += stiffness
    bands[0, 1:] = -stiffness
    return solveh_banded(bands, wanted)
