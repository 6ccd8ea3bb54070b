"""A motion clip in the world of the cameras: body parameters at given times, interpolated at any time between.

Local letters: F frames, J joints, V views.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor

from dyngs.human.motion.motion import Motion, interpolate_rotations
from dyngs.state import fields_moved_to

_SAME_TIME = 1e-9


@dataclass(frozen=True)
class MotionClip:
    """Body parameters at F >= 1 times.

    Attributes:
        times: (F,) float64 in [0, 1], strictly ascending; always on the CPU, as they are read one by one.
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

    def to(self, *, device: torch.device | str) -> MotionClip:
        """Return the clip with its poses, translations and scales on ``device``."""
        return replace(fields_moved_to(self, device), times=self.times)

    def select(self, rows: Tensor) -> MotionClip:
        """Return the frames at ``rows`` (long, on the CPU, ascending)."""
        return MotionClip(self.times[rows], self.poses[rows], self.trans[rows], self.scale[rows])

    def at(self, time: float | None) -> MotionClip:
        """Return a clip of one frame at ``time``, clamped to the clip; None: the first frame.

        Between frames rotations are interpolated spherically the shorter way, all else linearly.
        """
        times = self.times
        moment = float(times[0]) if time is None else min(max(time, float(times[0])), float(times[-1]))
        after = int(torch.searchsorted(times, moment - _SAME_TIME).clamp_max(len(self) - 1))
        if abs(float(times[after]) - moment) <= _SAME_TIME:
            return self.select(torch.tensor([after], device="cpu"))
        before = after - 1
        fraction = (moment - float(times[before])) / float(times[after] - times[before])
        return MotionClip(
            times=torch.tensor([moment], dtype=times.dtype, device=times.device),
            poses=interpolate_rotations(self.poses[before:after], self.poses[after : after + 1], np.array([fraction])),
            trans=torch.lerp(self.trans[before], self.trans[after], fraction)[None],
            scale=torch.lerp(self.scale[before], self.scale[after], fraction)[None],
        )


def motion_clip(motion: Motion) -> MotionClip:
    """Return the motion as a clip, its frames spread evenly over [0, 1]; place and size stay as given."""
    count = len(motion)
    times = (
        torch.from_numpy(np.linspace(0, 1, count)) if count > 1 else torch.zeros(1, dtype=torch.float64, device="cpu")
    )
    return MotionClip(times, motion.poses.float(), motion.trans.float(), motion.scale.float())
