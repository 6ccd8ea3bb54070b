"""A motion clip in the world of the cameras: body parameters at given times, interpolated at any time between."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from dyngs.data.body_frames import about_pelvis, rows_of
from dyngs.data.capture import BodyFrames, View
from dyngs.human.motion.motion import Motion, interpolate_rotations, poses_for_joints
from dyngs.state import fields_moved_to

_SAME_TIME = 1e-9


@dataclass(frozen=True)
class MotionClip:
    """Body parameters at F >= 1 times."""

    times: Tensor  # (F,) float64 in [0, 1], strictly ascending; always on the CPU, as they are read one by one
    poses: Tensor  # (F, J, 3) axis-angle relative to the parent joint, rad
    trans: Tensor  # (F, 3) world units, added last
    scale: Tensor  # (F,) world units per metre of the template

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


@dataclass(frozen=True)
class CapturedMotion:
    """A clip of the frames that have images."""

    clip: MotionClip  # of F frames, or of one where the person keeps one pose in one place: nothing moves
    frames: tuple[int, ...]  # (F,) frame numbers, as views name them

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
    Raises DyngsError: a view without parameters.
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
