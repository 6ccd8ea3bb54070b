"""A person's motion in the world of the cameras: body parameters at the times of a clip, and at any moment between.

Local letters: F frames, J joints, V views.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from dyngs.human.motion.motion import Motion

_SAME_TIME = 1e-9


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


def motion_clip(motion: Motion) -> MotionClip:
    """The clip of a motion file, its frames spread evenly over [0, 1], where and as large as the file says."""
    count = len(motion)
    times = torch.from_numpy(np.linspace(0, 1, count)) if count > 1 else torch.zeros(1, dtype=torch.float64)
    return MotionClip(times, motion.poses.float(), motion.trans.float(), motion.scale.float())


def _turned_partly(before: Tensor, after: Tensor, share: float) -> Tensor:
    """(J, 3) rotations between two of those: R_a exp(s log(R_a^T R_b))."""
    from scipy.spatial.transform import Rotation

    start = Rotation.from_rotvec(before.double().numpy())
    turn = (start.inv() * Rotation.from_rotvec(after.double().numpy())).as_rotvec()
    return torch.from_numpy((start * Rotation.from_rotvec(share * turn)).as_rotvec()).to(before)
