"""How a body moves: pose parameters per frame, read from and written to files.

Local letters: J joints, F frames, B shape parameters.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

import numpy as np
import torch
from torch import Tensor

from dyngs.errors import DyngsError
from dyngs.files.limits import VARIABLE, allowed
from dyngs.human.template.joints import JOINT_NAMES, SMPLX_ROWS

UpAxis = Literal["auto", "y", "z"]

MAX_JOINT_POSES = 5_000_000
"""Joints (55 at least) times frames of a motion at most: 90,909 frames, or 50 minutes at 30 frames per second."""
_RATES = (1e-3, 1e5)
"""Frames per second that a file may say."""
_CHUNK = 1024
"""Frames that are worked on at once: what is needed beside the motion itself does not grow with its length."""


@dataclass(frozen=True)
class Motion:
    """Body parameters per frame; y up.

    Attributes:
        poses: (F, J, 3) axis-angle relative to the parent joint, rad.
        trans: (F, 3) m, added after skinning.
        betas: (B,) shape parameters.
        fps: frames per second.
        scale: (F,) uniform scale of the template.
    """

    poses: Tensor
    trans: Tensor
    betas: Tensor
    fps: float
    scale: Tensor

    def __len__(self) -> int:
        return len(self.poses)

    def for_joints(self, count: int) -> Motion:
        """The same motion for a body of 55 (SMPL-X), 52 (SMPL-H) or 24 (SMPL) joints, from that of 55.

        Joints that the body lacks are left out; the hands of SMPL, which have no counterpart, do not turn.
        """
        kept = self.poses[:, list(SMPLX_ROWS[count])]
        rest = kept.new_zeros(len(kept), count - kept.shape[1], 3)
        return replace(self, poses=torch.cat([kept, rest], dim=1))

    def resampled(self, fps: float) -> Motion:
        """The motion at ``fps`` frames per second, from the first frame on and not beyond the last one.

        Rotations turn at constant speed the shorter way between two frames, all else is linear. Nothing is smoothed.

        Raises:
            DyngsError: ``fps`` is not a positive number, or asks for more frames than ``MAX_JOINT_POSES`` allows.
        """
        most = allowed(MAX_JOINT_POSES) / len(JOINT_NAMES)
        if not len(self) * fps <= most * self.fps:
            raise DyngsError(
                f"cannot resample the motion to {fps:g} frames per second, as it would have more than {most:,.0f} "
                f"frames; ask for 30 or the like, or set {VARIABLE}=N to allow N times as many"
            )
        times = sample_times(len(self) - 1, self.fps, fps)
        if fps == self.fps:
            return self
        return concatenated([self._between(times[rows], fps) for rows in frame_chunks(len(times))])

    def _between(self, times: np.ndarray, fps: float) -> Motion:
        """The motion at ``times`` (F,), in its own frames."""
        before = np.minimum(times.astype(np.int64), max(len(self) - 2, 0))
        after = np.minimum(before + 1, len(self) - 1)
        share = torch.from_numpy(times - before).to(self.trans.dtype)

        def linear(values: Tensor) -> Tensor:
            weight = share.reshape(-1, *[1] * (values.dim() - 1))
            return torch.lerp(values[before], values[after], weight)

        poses = _turned_partly(self.poses[before], self.poses[after], times - before)
        return Motion(poses, linear(self.trans), self.betas, fps, linear(self.scale))


def concatenated(parts: Sequence[Motion]) -> Motion:
    """One motion after the other; at least one, all of one person and rate."""
    whole = {name: torch.cat([getattr(part, name) for part in parts]) for name in ("poses", "trans", "scale")}
    return replace(parts[0], **whole)


def frame_chunks(count: int) -> list[slice]:
    """Slices of at most a thousand frames that make up ``count`` of them."""
    return [slice(start, min(start + _CHUNK, count)) for start in range(0, count, _CHUNK)]


def require_frame_count(path: Path, frames: float, joints: int) -> None:
    """Check that the motion of a file fits into memory, before it is made.

    Raises:
        DyngsError: it has more than ``MAX_JOINT_POSES``.
    """
    amount, most = frames * max(joints, len(JOINT_NAMES)), allowed(MAX_JOINT_POSES)
    if not amount <= most:
        factor = f"{math.ceil(amount / MAX_JOINT_POSES)}" if amount < 1e15 else "N"
        raise DyngsError(
            f"{path}: {frames:.0f} frames of {max(joints, len(JOINT_NAMES))} joints are too many, {most:,} poses of "
            f"joints are read at most; cut it into shorter pieces, or set the environment variable {VARIABLE}={factor}"
        )


def require_frame_rate(path: Path, fps: float) -> float:
    """``fps``, if it is a rate of frames per second that a motion can have.

    Raises:
        DyngsError: it is not.
    """
    if not _RATES[0] <= fps <= _RATES[1]:
        raise DyngsError(
            f"{path}: {fps:g} frames per second are not those of a motion ({_RATES[0]:g} to {_RATES[1]:g}); repair its "
            "frame rate or frame time"
        )
    return fps


def sample_times(last: float, from_fps: float, fps: float) -> np.ndarray:
    """(F,) moments in [0, last], in frames of ``from_fps``, that are 1 / ``fps`` seconds apart.

    The last one counts also if it is missed by a thousandth of a frame.

    Raises:
        DyngsError: ``fps`` is not a positive number.
    """
    if not 0 < fps < math.inf:
        raise DyngsError(f"{fps:g} frames per second make no motion; ask for 30 or the like")
    count = math.floor(last / from_fps * fps + 1e-3) + 1
    return np.minimum(np.arange(count) * (from_fps / fps), last)


def _turned_partly(before: Tensor, after: Tensor, share: np.ndarray) -> Tensor:
    """(F, J, 3) rotations between two of those, ``share`` (F,) of the way: R_a exp(s log(R_a^T R_b))."""
    from scipy.spatial.transform import Rotation

    start = Rotation.from_rotvec(before.reshape(-1, 3).double().numpy())
    turn = start.inv() * Rotation.from_rotvec(after.reshape(-1, 3).double().numpy())
    part = Rotation.from_rotvec(turn.as_rotvec() * np.repeat(share, before.shape[1])[:, None])
    return torch.from_numpy((start * part).as_rotvec()).to(before).reshape(before.shape)
