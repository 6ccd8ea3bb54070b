"""Body motion: pose parameters per frame, and clips in world coordinates that are sampled at any
time.

Symbols: F frames, J joints, B shape parameters.
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
"""Limit on frames times joints (at least 55) of a motion: 50 minutes at 30 frames per second."""


@dataclass(frozen=True)
class Motion:
    """Body parameters per frame, y up."""

    poses: Tensor  # (F, J, 3) axis-angle relative to the parent joint, rad
    trans: Tensor  # (F, 3) m, added after skinning; float64 in a fit to a capture
    betas: Tensor  # (B,) shape parameters
    fps: float  # frames per second
    scale: Tensor  # (F,) uniform scale of the template
    notes: tuple[str, ...] = ()  # assumptions made when reading the file

    def __len__(self) -> int:
        return len(self.poses)

    def to(self, *, device: torch.device | str) -> Motion:
        """Return the motion with its tensors on ``device``."""
        return move_fields_to(self, device)

    def for_joints(self, count: int) -> Motion:
        """Convert the motion to 55 (SMPL-X), 52 (SMPL-H) or 24 (SMPL) joints, see
        ``poses_for_joints``."""
        return replace(self, poses=poses_for_joints(self.poses, count))

    def resampled(self, fps: float) -> Motion:
        """Resample the motion at ``fps`` > 0, from the first frame to at most the last one.

        Rotations are interpolated spherically, all else linearly, without smoothing.
        """
        if fps == self.fps:
            return self
        times = sample_times(len(self) - 1, self.fps, fps)
        before = np.minimum(times.astype(np.int64), max(len(self) - 2, 0))
        after = np.minimum(before + 1, len(self) - 1)
        return replace(self, fps=fps, **_interpolate(self, before, after, times - before))


def require_frame_count(path: Path, frames: float, joints: int) -> None:
    """Raise DyngsError if a motion exceeds ``MAX_JOINT_POSES``, before it is allocated."""
    count = max(joints, len(JOINT_NAMES))
    most = scaled_limit(MAX_JOINT_POSES)
    if not frames * count <= most:
        raise DyngsError(
            f"{path}: {frames:.0f} frames of {count} joints exceed the limit of {most:,} joint "
            f"poses; split the motion, or set {LIMITS_VARIABLE}=N to allow N times as many"
        )


def require_frame_rate(path: Path, fps: float) -> float:
    """Return ``fps`` if it is a plausible frame rate; raise DyngsError otherwise."""
    if not 1e-3 <= fps <= 1e5:
        raise DyngsError(
            f"{path}: frame rate {fps:g} is outside 0.001 to 100,000 frames per second; correct "
            "the frame rate or frame time"
        )
    return fps


def sample_times(last: float, from_fps: float, fps: float) -> np.ndarray:
    """Return sample times (F,) in [0, last], in frames of ``from_fps``, spaced 1 / ``fps``
    seconds.

    The last frame is included if it is missed by at most a thousandth of a frame.
    """
    count = math.floor(last / from_fps * fps + 1e-3) + 1
    return np.minimum(np.arange(count) * (from_fps / fps), last)


def poses_for_joints(poses: Tensor, count: int) -> Tensor:
    """Convert axis-angle poses (F, J, 3) to (F, count, 3) for a body with ``count`` joints.

    J and ``count`` are 55 (SMPL-X), 52 (SMPL-H) or 24 (SMPL); joints missing on either side do not
    rotate.
    """
    if poses.shape[1] == count:
        return poses
    source_rows = SMPLX_ROWS[poses.shape[1]]
    target_rows = SMPLX_ROWS[count]
    smplx = poses.new_zeros(len(poses), len(JOINT_NAMES), 3)
    smplx[:, list(source_rows)] = poses[:, : len(source_rows)]
    converted = poses.new_zeros(len(poses), count, 3)
    converted[:, : len(target_rows)] = smplx[:, list(target_rows)]
    return converted


def compose_rotations(first: Tensor, second: Tensor) -> Tensor:
    """Return axis-angle vectors (..., 3) of the product R(first) R(second), computed in float64.

    ``first`` has the shape of ``second`` (..., 3) or is a single vector (3,).
    """
    from scipy.spatial.transform import Rotation

    one, other = (
        Rotation.from_rotvec(x.double().cpu().numpy().reshape(-1, 3)) for x in (first, second)
    )
    return torch.from_numpy((one * other).as_rotvec()).to(second).reshape(second.shape)


def _interpolate(
    frames: Motion | MotionClip, before: np.ndarray, after: np.ndarray, fraction: np.ndarray
) -> dict[str, Tensor]:
    """Interpolate poses, translations and scales between rows at ``fraction`` (F,).

    Rotations are R_a exp(s log(R_a^T R_b)), all else is linear.
    """

    def weight_for(values: Tensor) -> Tensor:
        return torch.from_numpy(fraction).to(values).reshape(-1, *[1] * (values.dim() - 1))

    start, end = (frames.poses[rows].double() for rows in (before, after))
    rotation = compose_rotations(-start, end)
    interpolated = {
        "poses": compose_rotations(start, weight_for(rotation) * rotation).to(frames.poses)
    }
    for name in ("trans", "scale"):
        values: Tensor = getattr(frames, name)
        interpolated[name] = torch.lerp(values[before], values[after], weight_for(values))
    return interpolated


@dataclass(frozen=True)
class SkeletonMotion:
    """Motion of S joints of another skeleton; float64, in any unit of length."""

    path: Path  # source file, for messages
    names: tuple[str, ...]  # (S,) joint names
    rest: np.ndarray  # (S, 3) joints in the rest pose, in the axes of the file
    rotations: np.ndarray  # (F, S, 3, 3) world_from_rest of each joint
    positions: np.ndarray  # (F, S, 3) joints in world coordinates
    fps: float  # frames per second
    world_is_y_up: bool  # if False, the world has the axes of the rest pose


@dataclass(frozen=True)
class MotionClip:
    """Body parameters at F >= 1 times."""

    times: Tensor  # (F,) float64 in [0, 1], strictly ascending; always on the CPU
    poses: Tensor  # (F, J, 3) axis-angle relative to the parent joint, rad
    trans: Tensor  # (F, 3) world units, added last
    scale: Tensor  # (F,) world units per metre of the template

    def __len__(self) -> int:
        return len(self.times)

    @cached_property
    def rotations(self) -> Tensor:
        """Rotations (F, J, 3, 3) relative to the parent joints."""
        return axis_angle_to_matrix(self.poses)

    def to(self, *, device: torch.device | str) -> MotionClip:
        """Return the clip with its poses, translations and scales on ``device``."""
        return replace(move_fields_to(self, device), times=self.times)

    def select(self, rows: Tensor) -> MotionClip:
        """Return the frames at ``rows`` (long, on the CPU, ascending)."""
        return MotionClip(self.times[rows], self.poses[rows], self.trans[rows], self.scale[rows])

    @staticmethod
    def joined(clips: Sequence[MotionClip]) -> MotionClip:
        """Concatenate the frames of several clips."""
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

        Between frames, rotations are interpolated spherically, all else linearly.
        """
        times = self.times
        first, last = times[[0, -1]].tolist()
        clamped = first if time is None else min(max(time, first), last)
        after = int(torch.searchsorted(times, clamped - 1e-9).clamp_max(len(self) - 1))
        if abs(float(times[after]) - clamped) <= 1e-9:
            return self.select(torch.tensor([after], device="cpu"))
        fraction = (clamped - times[after - 1]) / (times[after] - times[after - 1])
        rows = (np.array([after - 1]), np.array([after]))
        return MotionClip(
            times.new_tensor([clamped]), **_interpolate(self, *rows, fraction[None].numpy())
        )


def motion_clip(motion: Motion) -> MotionClip:
    """Convert a motion to a clip with frames spread evenly over [0, 1]; position and size are
    kept."""
    times = torch.from_numpy(np.linspace(0, 1, len(motion)))
    return MotionClip(times, motion.poses.float(), motion.trans.float(), motion.scale.float())


@dataclass(frozen=True)
class CapturedMotion:
    """Clip of the frames that have images."""

    clip: MotionClip  # of F frames, or of one if the person does not move
    frames: tuple[int, ...]  # (F,) frame numbers of the views

    @cached_property
    def rows(self) -> dict[int, int]:
        """Clip row by frame number."""
        return {frame: min(row, len(self.clip) - 1) for row, frame in enumerate(self.frames)}

    def clip_of_frames(self, frames: Sequence[int]) -> MotionClip:
        """Return a clip with one row per given frame, also for a static person."""
        return self.clip.select(torch.tensor([self.rows[x] for x in frames], device="cpu"))

    def to(self, *, device: torch.device | str) -> CapturedMotion:
        """Return the motion with its clip on ``device``."""
        return CapturedMotion(self.clip.to(device=device), self.frames)


def captured_motion(
    where: Path, body_frames: BodyFrames, views: Sequence[View], joints: Tensor
) -> CapturedMotion:
    """Return the motion of the frames that ``views`` show, for a body with rest-pose ``joints``
    (J, 3).

    Joints missing in ``body_frames`` do not rotate. Views without times are spread over [0, 1] by
    frame number. Raises DyngsError: a view without body parameters.
    """
    centred = merge_root_rotation(body_frames, joints[0].double().cpu().numpy())
    rows = match_frames(where, centred, views)
    last = max(len(centred.frames) - 1, 1)
    times = {
        row: row / last if view.time is None else view.time
        for view, row in zip(views, rows.tolist(), strict=True)
    }
    order = sorted(times, key=lambda row: (times[row], row))
    unique_rows = [row for i, row in enumerate(order) if i == 0 or times[row] > times[order[i - 1]]]
    clip = MotionClip(
        times=torch.tensor([times[row] for row in unique_rows], dtype=torch.float64, device="cpu"),
        poses=poses_for_joints(
            torch.from_numpy(centred.poses[unique_rows]).to(joints), len(joints)
        ),
        trans=torch.from_numpy(centred.trans[unique_rows]).to(joints),
        scale=torch.from_numpy(centred.scale[unique_rows]).to(joints),
    )
    is_static = all(bool((x == x[:1]).all()) for x in (clip.poses, clip.trans, clip.scale))
    frames = tuple(centred.frames[row] for row in unique_rows)
    return CapturedMotion(
        clip.select(torch.tensor([0], device="cpu")) if is_static else clip, frames
    )


def interpolate_linearly(times: Tensor, values: Tensor, at: Tensor) -> Tensor:
    """Return ``values`` (F, ...) at ascending ``times`` (F,), interpolated at times ``at`` (G,).

    Before the first and after the last time they are constant.
    """
    after = torch.searchsorted(times, at).clamp(1, len(times) - 1)
    start = times[after - 1]
    end = times[after]
    fractions = ((at - start) / (end - start)).clamp(0, 1).to(values)
    fractions = fractions.view(-1, *[1] * (values.dim() - 1))
    after = after.to(values.device)
    return torch.lerp(values[after - 1], values[after], fractions)


def has_same_parameters(a: BodyFrames, b: BodyFrames) -> bool:
    """True if both hold the same body parameters for the same frames."""
    return a.frames == b.frames and all(
        np.array_equal(getattr(a, name), getattr(b, name)) for name in ("poses", "trans", "scale")
    )
