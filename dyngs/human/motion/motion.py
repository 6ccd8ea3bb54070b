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
from dyngs.core.state import move_fields_to
from dyngs.data.body_frames import match_frames, merge_root_rotation
from dyngs.data.capture import BodyFrames, View
from dyngs.human.body.joints import JOINT_NAMES, SMPLX_ROWS
from dyngs.human.body.skinning import axis_angle_to_matrix
from dyngs.io.containment import LIMITS_VARIABLE, scaled_limit

UpAxis = Literal["auto", "y", "z"]
MAX_JOINT_POSES = 5_000_000
"""Limit on joints (at least 55) times frames of a motion: 90,909 frames, or 50 minutes at 30 frames
per second."""


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
        return move_fields_to(self, device)

    def for_joints(self, count: int) -> Motion:
        """Return the motion for a body of 55 (SMPL-X), 52 (SMPL-H) or 24 (SMPL) joints, see
        ``poses_for_joints``."""
        return replace(self, poses=poses_for_joints(self.poses, count))

    def resampled(self, fps: float) -> Motion:
        """Return the motion at ``fps`` > 0 frames per second, from the first frame to at most the
        last one.

        Rotations are interpolated spherically the shorter way, all else linearly. Nothing is
        smoothed.
        """
        if fps == self.fps:
            return self
        times = sample_times(len(self) - 1, self.fps, fps)
        before = np.minimum(times.astype(np.int64), max(len(self) - 2, 0))
        after = np.minimum(before + 1, len(self) - 1)
        return replace(self, fps=fps, **_between(self, before, after, times - before))


def require_frame_count(path: Path, frames: float, joints: int) -> None:
    """Check that the motion of a file fits into memory before it is allocated.

    Raises DyngsError: it exceeds ``MAX_JOINT_POSES``.
    """
    count = max(joints, len(JOINT_NAMES))
    most = scaled_limit(MAX_JOINT_POSES)
    if not frames * count <= most:
        raise DyngsError(
            f"{path}: {frames:.0f} frames of {count} joints are too many; at most {most:,} poses of joints are read; "
            f"cut it into shorter pieces, or set {LIMITS_VARIABLE}=N to allow N times as many"
        )


def require_frame_rate(path: Path, fps: float) -> float:
    """Return ``fps`` if it is a plausible frame rate of a motion. Raises DyngsError: it is not."""
    if not 1e-3 <= fps <= 1e5:
        raise DyngsError(
            f"{path}: {fps:g} frames per second is not the rate of a motion (0.001 to 100,000); correct its frame rate "
            "or frame time"
        )
    return fps


def sample_times(last: float, from_fps: float, fps: float) -> np.ndarray:
    """Return times (F,) in [0, last], in frames of ``from_fps``, that are 1 / ``fps`` seconds
    apart.

    The last frame is included if it is missed by at most a thousandth of a frame.
    """
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


def compose_rotations(first: Tensor, second: Tensor) -> Tensor:
    """Return the axis-angle vectors (..., 3) of the products of two rotations, the second one
    applied before the first one; computed in float64.

    ``second`` (..., 3); ``first`` has the same shape, or is one vector (3,).
    """
    from scipy.spatial.transform import Rotation

    one, other = (
        Rotation.from_rotvec(x.double().cpu().numpy().reshape(-1, 3)) for x in (first, second)
    )
    return torch.from_numpy((one * other).as_rotvec()).to(second).reshape(second.shape)


def _between(
    frames: Motion | MotionClip, before: np.ndarray, after: np.ndarray, fraction: np.ndarray
) -> dict[str, Tensor]:
    """Return poses, translations and scales at ``fraction`` (F,) of the way between two rows:
    rotations R_a exp(s log(R_a^T R_b)), all else linearly."""

    def weight_for(values: Tensor) -> Tensor:
        return torch.from_numpy(fraction).to(values).reshape(-1, *[1] * (values.dim() - 1))

    start, end = (frames.poses[rows].double() for rows in (before, after))
    turn = compose_rotations(-start, end)
    found = {"poses": compose_rotations(start, weight_for(turn) * turn).to(frames.poses)}
    for name in ("trans", "scale"):
        values: Tensor = getattr(frames, name)
        found[name] = torch.lerp(values[before], values[after], weight_for(values))
    return found


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
        return replace(move_fields_to(self, device), times=self.times)

    def select(self, rows: Tensor) -> MotionClip:
        """Return the frames at ``rows`` (long, on the CPU, ascending)."""
        return MotionClip(self.times[rows], self.poses[rows], self.trans[rows], self.scale[rows])

    @staticmethod
    def joined(clips: Sequence[MotionClip]) -> MotionClip:
        """Return the frames of several clips, one after the other."""
        rows = [(x.times, x.poses, x.trans, x.scale) for x in clips]
        return MotionClip(*(torch.cat(parts) for parts in zip(*rows, strict=True)))

    def replace_rows(self, rows: Sequence[int], frames: MotionClip) -> MotionClip:
        """Return the clip with ``frames`` (R of them) in place of its R ``rows``."""
        index = torch.tensor(rows, device="cpu")
        names = ("times", "poses", "trans", "scale")
        pairs = {name: (getattr(self, name), getattr(frames, name)) for name in names}
        return MotionClip(
            **{name: x.index_copy(0, index, y.to(x)) for name, (x, y) in pairs.items()}
        )

    def at(self, time: float | None) -> MotionClip:
        """Return a clip of one frame at ``time``, clamped to the clip; None: the first frame.

        Between frames rotations are interpolated spherically the shorter way, all else linearly.
        """
        times = self.times
        first, last = times[[0, -1]].tolist()
        moment = first if time is None else min(max(time, first), last)
        after = int(torch.searchsorted(times, moment - 1e-9).clamp_max(len(self) - 1))
        if abs(float(times[after]) - moment) <= 1e-9:
            return self.select(torch.tensor([after], device="cpu"))
        fraction = (moment - times[after - 1]) / (times[after] - times[after - 1])
        rows = (np.array([after - 1]), np.array([after]))
        return MotionClip(
            times.new_tensor([moment]), **_between(self, *rows, fraction[None].numpy())
        )


def motion_clip(motion: Motion) -> MotionClip:
    """Return the motion as a clip, its frames spread evenly over [0, 1]; place and size stay as
    given."""
    times = torch.from_numpy(np.linspace(0, 1, len(motion)))
    return MotionClip(times, motion.poses.float(), motion.trans.float(), motion.scale.float())


@dataclass(frozen=True)
class CapturedMotion:
    """A clip of the frames that have images."""

    # of F frames, or of one where the person keeps one pose in one place: nothing moves
    clip: MotionClip
    frames: tuple[int, ...]  # (F,) frame numbers, as views name them

    @cached_property
    def rows(self) -> dict[int, int]:
        """The row of the clip that shows each frame."""
        return {frame: min(row, len(self.clip) - 1) for row, frame in enumerate(self.frames)}

    def clip_of_frames(self, frames: Sequence[int]) -> MotionClip:
        """Return a clip with a row for each of the ``frames``, also of who never moves."""
        return self.clip.select(torch.tensor([self.rows[x] for x in frames], device="cpu"))

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
    found = merge_root_rotation(given, joints[0].double().cpu().numpy())
    rows = match_frames(where, found, views)
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


def has_same_parameters(a: BodyFrames, b: BodyFrames) -> bool:
    """Return whether both hold the same body parameters for the same frames."""
    pairs = ((getattr(a, name), getattr(b, name)) for name in ("poses", "trans", "scale"))
    return a.frames == b.frames and all(np.array_equal(x, y) for x, y in pairs)
