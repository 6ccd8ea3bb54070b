"""Feet on the floor: where a played motion has them touch it, how far they slide there, and a root
that stops that.

A motion of one person that is played by another, with other legs, moves the root too far or not far
enough: feet that should stand slide. Local letter: P = 4 points of the soles, under ankle and ball
of the left and of the right foot.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor

from dyngs.human.body.joints import JOINT_NAMES, SMPLX_ROWS
from dyngs.human.body.skinning import axis_angle_to_matrix, joint_transforms
from dyngs.human.motion.motion import MotionClip

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
