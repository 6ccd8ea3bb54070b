"""Usual poses: mean and spread of the joints' rotations over walking, running, jumping and dancing people.

Statistics of a few clips of CMU mocap (mocap.cs.cmu.edu, NSF EIA-0196217) and DeepMimic (MIT, Xue Bin Peng), of each
clip and its mirror image.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from dyngs.human.motion.clip import MotionClip
from dyngs.human.template.joints import JOINT_NAMES

NUM_TURNED = 22
"""Joints that are turned: those of the body. Fingers, jaw and eyes do not show in silhouettes."""
_GIVEN = 0.05
"""Expected error of given poses, rad."""
_LIMIT = 3.0
"""Standard deviations of usual poses beyond which joints would be dislocated."""
_LEAST = 8.0
"""Least spread, degrees: a few clips do not show how far a joint can go."""
_DEGREES: dict[str, tuple[tuple[float, float, float], tuple[float, float, float]]] = {
    "hip": ((-11, 1, -6), (23, 14, 7)),
    "knee": ((26, 0, 1), (22, 1, 0)),
    "ankle": ((-1, 27, -12), (13, 8, 6)),
    "spine1": ((7, 0, 0), (7, 2, 3)),
    "spine2": ((5, 0, 0), (7, 6, 10)),
    "spine3": ((-2, 0, 0), (3, 1, 2)),
    "neck": ((-12, 0, 0), (4, 17, 10)),
    "head": ((-1, 0, 0), (11, 5, 4)),
    "collar": ((0, 1, -16), (0, 7, 10)),
    "shoulder": ((16, -13, -49), (37, 20, 28)),
    "elbow": ((-7, -40, 16), (5, 29, 13)),
    "wrist": ((-4, -2, 10), (3, 11, 6)),
}
"""Axis-angle vectors of the left side, and their standard deviations; the right side is the mirror image."""


@dataclass(frozen=True)
class PosePrior:
    """Expected corrections of the poses of F frames, axis-angle, rad.

    Attributes:
        centre: (F, 22, 3) mean.
        spread: (22, 3) standard deviation.
        limit: of these from the centre, beyond which nobody is expected to turn a joint.
    """

    centre: Tensor
    spread: Tensor
    limit: float = math.inf


def near_given(clip: MotionClip) -> PosePrior:
    """Return the prior that poses are about those given."""
    return PosePrior(torch.zeros_like(clip.poses[:, :NUM_TURNED]), torch.full_like(clip.poses[0, :NUM_TURNED], _GIVEN))


def usual(clip: MotionClip) -> PosePrior:
    """Return the prior that corrected poses are usual ones; rotations add as vectors, which holds for small ones."""
    spread = usual_spread(NUM_TURNED).to(clip.poses)
    return PosePrior(usual_pose(NUM_TURNED).to(clip.poses) - clip.poses[:, :NUM_TURNED], spread, _LIMIT)


def usual_pose(joints: int) -> Tensor:
    """Return the mean pose (joints, 3), axis-angle, rad; zero for joints that are not known."""
    return _table(0, joints)


def usual_spread(joints: int) -> Tensor:
    """Return the standard deviations (joints, 3) about it, rad, at least 8 degrees."""
    return _table(1, joints).abs().clamp_min(torch.deg2rad(torch.tensor(_LEAST, device="cpu")))


def _table(which: int, joints: int) -> Tensor:
    found = torch.zeros(joints, 3, device="cpu")
    for row, name in enumerate(JOINT_NAMES[:joints]):
        side, _, rest = name.partition("_")
        degrees = _DEGREES.get(rest if side in ("left", "right") else name)
        if degrees is not None:
            mirrored = (1.0, -1.0, -1.0) if side == "right" else (1.0, 1.0, 1.0)
            found[row] = torch.tensor([x * m for x, m in zip(degrees[which], mirrored, strict=True)], device="cpu")
    return torch.deg2rad(found)
