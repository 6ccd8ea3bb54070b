"""The motion of a captured person: body parameters of the frames that have images.

Local letters: F frames, J joints, V views.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from dyngs.data.body_frames import about_pelvis, rows_of
from dyngs.data.capture import BodyFrames, View
from dyngs.human.motion.clip import MotionClip
from dyngs.human.motion.motion import poses_for_joints


@dataclass(frozen=True)
class CapturedMotion:
    """A clip of the frames that have images.

    Attributes:
        clip: of F frames, or of one where the person keeps one pose in one place: nothing moves.
        frames: (F,) frame numbers, as views name them.
    """

    clip: MotionClip
    frames: tuple[int, ...]

    @property
    def rows(self) -> dict[int, int]:
        """The row of the clip that shows each frame."""
        return {frame: min(row, len(self.clip) - 1) for row, frame in enumerate(self.frames)}

    def to(self, *, device: torch.device | str) -> CapturedMotion:
        """Return the motion with its clip on ``device``."""
        return CapturedMotion(self.clip.to(device=device), self.frames)


def captured_motion(where: Path, given: BodyFrames, views: Sequence[View], joints: Tensor) -> CapturedMotion:
    """Return the frames of ``given`` that ``views`` show, for a body with ``joints`` (J, 3) at rest.

    Joints that the body of ``given`` lacks do not rotate. Views without times are spread over [0, 1] by frame number.

    Args:
        where: path of the capture, for messages.
        given: body parameters of the capture.
        views: at least one.
        joints: of the template in the person's shape, m.

    Raises:
        DyngsError: a view without parameters.
    """
    found = about_pelvis(given, joints[0].double().cpu().numpy())
    rows = rows_of(where, found, views)
    last = max(len(found.frames) - 1, 1)
    times = {
        row: row / last if view.time is None else view.time for view, row in zip(views, rows.tolist(), strict=True)
    }
    order = sorted(times, key=lambda row: (times[row], row))
    kept = [row for i, row in enumerate(order) if i == 0 or times[row] > times[order[i - 1]]]
    clip = MotionClip(
        times=torch.tensor([times[row] for row in kept], dtype=torch.float64, device="cpu"),
        poses=poses_for_joints(torch.from_numpy(found.poses[kept]).to(joints), len(joints)),
        trans=torch.from_numpy(found.trans[kept]).to(joints),
        scale=torch.from_numpy(found.scale[kept]).to(joints),
    )
    keeps_still = all(bool((x == x[:1]).all()) for x in (clip.poses, clip.trans, clip.scale))
    frames = tuple(found.frames[row] for row in kept)
    return CapturedMotion(clip.select(torch.tensor([0], device="cpu")) if keeps_still else clip, frames)


def same_bodies(a: BodyFrames, b: BodyFrames) -> bool:
    """Return whether both hold the same body parameters for the same frames."""
    pairs = ((getattr(a, name), getattr(b, name)) for name in ("poses", "trans", "scale"))
    return a.frames == b.frames and all(np.array_equal(x, y) for x, y in pairs)
