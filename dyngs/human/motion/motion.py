"""The motion of a body, pose parameters per frame; and a clip in the world of the cameras, at any
time between.

Local letter: B shape parameters.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Literal

import numpy as np
import torch
from torch import Tensor

from dyngs.core.errors import DyngsError
from dyngs.core.state import fields_moved_to
from dyngs.data.body_frames import about_pelvis, rows_of
from dyngs.data.capture import BodyFrames, View
from dyngs.human.body.joints import JOINT_NAMES, SMPLX_ROWS
from dyngs.human.body.skinning import axis_angle_to_matrix
from dyngs.io.containment import LIMITS_VARIABLE, allowed

UpAxis = Literal["auto", "y", "z"]
MAX_JOINT_POSES = 5_000_000
"""Limit on joints (at least 55) times frames of a motion: 90,909 frames, or 50 minutes at 30 frames
per second."""
_RATES = (1e-3, 1e5)  # frames per second that a file may have
# frames per block, so that temporary memory does not grow with the length of a motion
_CHUNK = 1024


@dataclass(frozen=True)
class Motion:
    """Body parameters per frame; y up."""

    poses: Tensor  # (F, J, 3) axis-angle relative to the parent joint, rad
    trans: Tensor  # (F, 3) m, added after skinning; float64 in a fit to a capture
    betas: Tensor  # (B,) shape parameters
    fps: float  # frames per second
    scale: Tensor  # (F,) uniform scale of the template
    notes: tuple[str, ...] = ()  # assumptions that the reader of the file made

    def __len__(self) -> int:
        return len(self.poses)

    def to(self, *, device: torch.device | str) -> Motion:
        """Return the motion with its tensors on ``device``."""
        return fields_moved_to(self, device)

    def for_joints(self, count: int) -> Motion:
        """Return the motion for a body of 55 (SMPL-X), 52 (SMPL-H) or 24 (SMPL) joints, see
        ``poses_for_joints``."""
        return replace(self, poses=poses_for_joints(self.poses, count))

    def resampled(self, fps: float) -> Motion:
        """Return the motion at ``fps`` frames per second, from the first frame to at most the last
        one.

        Rotations are interpolated spherically the shorter way, all else linearly. Nothing is
        smoothed. Raises DyngsError: ``fps`` is not a positive number, or gives more frames than
        ``MAX_JOINT_POSES`` allows.
        """
        most = allowed(MAX_JOINT_POSES) / len(JOINT_NAMES)
        if not len(self) * fps <= most * self.fps:
            raise DyngsError(
                f"cannot resample the motion to {fps:g} frames per second, as it would have more than {most:,.0f} "
                f"frames; ask for 30 or the like, or set {LIMITS_VARIABLE}=N to allow N times as many"
            )
        times = sample_times(len(self) - 1, self.fps, fps)
        if fps == self.fps:
            return self
        parts = [self._interpolated(times[rows], fps) for rows in frame_chunks(len(times))]
        tensors = {
            name: torch.cat([getattr(part, name) for part in parts])
            for name in ("poses", "trans", "scale")
        }
        return replace(parts[0], **tensors, notes=self.notes)

    def _interpolated(self, times: np.ndarray, fps: float) -> Motion:
        before = np.minimum(times.astype(np.int64), max(len(self) - 2, 0))
        after = np.minimum(before + 1, len(self) - 1)
        fraction = torch.from_numpy(times - before)

        def linear(values: Tensor) -> Tensor:
            weight = fraction.to(values).reshape(-1, *[1] * (values.dim() - 1))
            return torch.lerp(values[before], values[after], weight)

        poses = interpolate_rotations(self.poses[before], self.poses[after], times - before)
        return Motion(poses, linear(self.trans), self.betas, fps, linear(self.scale))


def frame_chunks(count: int) -> list[slice]:
    """Return slices of at most 1024 frames that cover ``count`` frames."""
    return [slice(start, min(start + _CHUNK, count)) for start in range(0, count, _CHUNK)]


def require_frame_count(path: Path, frames: float, joints: int) -> None:
    """Check that the motion of a file fits into memory before it is allocated.

    Raises DyngsError: it exceeds ``MAX_JOINT_POSES``.
    """
    amount = frames * max(joints, len(JOINT_NAMES))
    most = allowed(MAX_JOINT_POSES)
    if not amount <= most:
        factor = f"{math.ceil(amount / MAX_JOINT_POSES)}" if amount < 1e15 else "N"
        raise DyngsError(
            f"{path}: {frames:.0f} frames of {max(joints, len(JOINT_NAMES))} joints are too many; at most {most:,} "
            f"poses of joints are read; cut it into shorter pieces, or set {LIMITS_VARIABLE}={factor}"
        )


def require_frame_rate(path: Path, fps: float) -> float:
    """Return ``fps`` if it is a plausible frame rate of a motion. Raises DyngsError: it is not."""
    if not _RATES[0] <= fps <= _RATES[1]:
        raise DyngsError(
            f"{path}: {fps:g} frames per second is not the rate of a motion ({_RATES[0]:g} to {_RATES[1]:g}); correct "
            "its frame rate or frame time"
        )
    return fps


def sample_times(last: float, from_fps: float, fps: float) -> np.ndarray:
    """Return times (F,) in [0, last], in frames of ``from_fps``, that are 1 / ``fps`` seconds
    apart.

    The last frame is included if it is missed by at most a thousandth of a frame. Raises
    DyngsError: ``fps`` is not a positive number.
    """
    if not 0 < fps < math.inf:
        raise DyngsError(f"{fps:g} frames per second is not a frame rate; ask for 30 or the like")
    count = math.floor(last / from_fps * fps + 1e-3) + 1
    return np.minimum(np.arange(count) * (from_fps / fps), last)


def poses_for_joints(poses: Tensor, count: int) -> Tensor:
    """Return axis-angle poses (F, count, 3) for a body of ``count`` joints from those (F, J, 3) of
    a body of J.

    Both have 55 (SMPL-X), 52 (SMPL-H) or 24 (SMPL) joints. Joints that one of them lacks do not
    rotate.
    """
    if poses.shape[1] == count:
        return poses
    theirs = SMPLX_ROWS[poses.shape[1]]
    ours = SMPLX_ROWS[count]
    smplx = poses.new_zeros(len(poses), len(JOINT_NAMES), 3)
    smplx[:, list(theirs)] = poses[:, : len(theirs)]
    wanted = poses.new_zeros(len(poses), count, 3)
    wanted[:, : len(ours)] = smplx[:, list(ours)]
    return wanted


def interpolate_rotations(before: Tensor, after: Tensor, fraction: np.ndarray) -> Tensor:
    """Return axis-angle vectors (F, J, 3) at ``fraction`` (F,) of the way between two: R_a exp(s
    log(R_a^T R_b))."""
    from scipy.spatial.transform import Rotation

    start = Rotation.from_rotvec(before.reshape(-1, 3).double().cpu().numpy())
    turn = start.inv() * Rotation.from_rotvec(after.reshape(-1, 3).double().cpu().numpy())
    part = Rotation.from_rotvec(turn.as_rotvec() * np.repeat(fraction, before.shape[1])[:, None])
    return torch.from_numpy((start * part).as_rotvec()).to(before).reshape(before.shape)


@dataclass(frozen=True)
class SkeletonMotion:
    """The motion of S joints of another skeleton than ours; float64, in any unit of length."""

    path: Path  # of the file, for messages
    names: tuple[str, ...]  # (S,) of the joints
    rest: np.ndarray  # (S, 3) joints in the rest pose, in its own axes
    rotations: np.ndarray  # (F, S, 3, 3) world_from_rest of each joint
    positions: np.ndarray  # (F, S, 3) of the joints in the world
    fps: float  # frames per second
    # whether the world is known to be y up; otherwise it has the axes of the rest pose
    world_is_y_up: bool


_SAME_TIME = 1e-9


@dataclass(frozen=True)
class MotionClip:
    """Body parameters at F >= 1 times."""

    # (F,) float64 in [0, 1], strictly ascending; always on the CPU, as they are read one by one
    times: Tensor
    poses: Tensor  # (F, J, 3) axis-angle relative to the parent joint, rad
    trans: Tensor  # (F, 3) world units, added last
    scale: Tensor  # (F,) world units per metre of the template

    def __len__(self) -> int:
        return len(self.times)

    @cached_property
    def rotations(self) -> Tensor:
        """Return the rotations (F, J, 3, 3) relative to the parent joints."""
        return axis_angle_to_matrix(self.poses)

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
        moment = (
            float(times[0]) if time is None else min(max(time, float(times[0])), float(times[-1]))
        )
        after = int(torch.searchsorted(times, moment - _SAME_TIME).clamp_max(len(self) - 1))
        if abs(float(times[after]) - moment) <= _SAME_TIME:
            return self.select(torch.tensor([after], device="cpu"))
        before = after - 1
        fraction = (moment - float(times[before])) / float(times[after] - times[before])
        return MotionClip(
            times=torch.tensor([moment], dtype=times.dtype, device=times.device),
            poses=interpolate_rotations(
                self.poses[before:after], self.poses[after : after + 1], np.array([fraction])
            ),
            trans=torch.lerp(self.trans[before], self.trans[after], fraction)[None],
            scale=torch.lerp(self.scale[before], self.scale[after], fraction)[None],
        )


def motion_clip(motion: Motion) -> MotionClip:
    """Return the motion as a clip, its frames spread evenly over [0, 1]; place and size stay as
    given."""
    count = len(motion)
    times = (
        torch.from_numpy(np.linspace(0, 1, count))
        if count > 1
        else torch.zeros(1, dtype=torch.float64, device="cpu")
    )
    return MotionClip(times, motion.poses.float(), motion.trans.float(), motion.scale.float())


@dataclass(frozen=True)
class CapturedMotion:
    """A clip of the frames that have images."""

    # of F frames, or of one where the person keeps one pose in one place: nothing moves
    clip: MotionClip
    frames: tuple[int, ...]  # (F,) frame numbers, as views name them

    @property
    def rows(self) -> dict[int, int]:
        """The row of the clip that shows each frame."""
        return {frame: min(row, len(self.clip) - 1) for row, frame in enumerate(self.frames)}

    def to(self, *, device: torch.device | str) -> CapturedMotion:
        """Return the motion with its clip on ``device``."""
        return CapturedMotion(self.clip.to(device=device), self.frames)


def captured_motion(
    where: Path, given: BodyFrames, views: Sequence[View], joints: Tensor
) -> CapturedMotion:
    """Return the frames of ``given`` that ``views`` show, for a body with ``joints`` (J, 3) at
    rest.

    Joints that the body of ``given`` lacks do not rotate. Views without times are spread over [0,
    1] by frame number. Raises DyngsError: a view without parameters.
    """
    found = about_pelvis(given, joints[0].double().cpu().numpy())
    rows = rows_of(where, found, views)
    last = max(len(found.frames) - 1, 1)
    times = {
        row: row / last if view.time is None else view.time
        for view, row in zip(views, rows.tolist(), strict=True)
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
    return CapturedMotion(
        clip.select(torch.tensor([0], device="cpu")) if keeps_still else clip, frames
    )


def same_bodies(a: BodyFrames, b: BodyFrames) -> bool:
    """Return whether both hold the same body parameters for the same frames."""
    pairs = ((getattr(a, name), getattr(b, name)) for name in ("poses", "trans", "scale"))
    return a.frames == b.frames and all(np.array_equal(x, y) for x, y in pairs)
