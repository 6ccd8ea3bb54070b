"""How a body moves: pose parameters per frame, read from and written to files.

Local letters: J joints, F frames, B shape parameters.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Literal

import numpy as np
import torch
from torch import Tensor

from dyngs.errors import DyngsError, reading
from dyngs.files.limits import VARIABLE, allowed
from dyngs.files.write import atomic_file

if TYPE_CHECKING:
    from dyngs.human.template.body import BodyTemplate

_FINGERS = tuple(f"{finger}{i}" for finger in ("index", "middle", "pinky", "ring", "thumb") for i in (1, 2, 3))

JOINTS = (
    *("pelvis", "left_hip", "right_hip", "spine1", "left_knee", "right_knee", "spine2", "left_ankle", "right_ankle"),
    *("spine3", "left_foot", "right_foot", "neck", "left_collar", "right_collar", "head", "left_shoulder"),
    *("right_shoulder", "left_elbow", "right_elbow", "left_wrist", "right_wrist", "jaw", "left_eye", "right_eye"),
    *(f"left_{name}" for name in _FINGERS),
    *(f"right_{name}" for name in _FINGERS),
)
"""The 55 joints of SMPL-X in their order."""

ROWS = {55: tuple(range(55)), 52: (*range(22), *range(25, 55)), 24: tuple(range(22))}
"""By number of joints of a body: which of the 55 its first joints are. SMPL's last two, the hands, are none of them."""

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
        kept = self.poses[:, list(ROWS[count])]
        rest = kept.new_zeros(len(kept), count - kept.shape[1], 3)
        return replace(self, poses=torch.cat([kept, rest], dim=1))

    def resampled(self, fps: float) -> Motion:
        """The motion at ``fps`` frames per second, from the first frame on and not beyond the last one.

        Rotations turn at constant speed the shorter way between two frames, all else is linear. Nothing is smoothed.

        Raises:
            DyngsError: ``fps`` is not a positive number, or asks for more frames than ``MAX_JOINT_POSES`` allows.
        """
        most = allowed(MAX_JOINT_POSES) / len(JOINTS)
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
    amount, most = frames * max(joints, len(JOINTS)), allowed(MAX_JOINT_POSES)
    if not amount <= most:
        factor = f"{math.ceil(amount / MAX_JOINT_POSES)}" if amount < 1e15 else "N"
        raise DyngsError(
            f"{path}: {frames:.0f} frames of {max(joints, len(JOINTS))} joints are too many, {most:,} poses of joints "
            f"are read at most; cut it into shorter pieces, or set the environment variable {VARIABLE}={factor}"
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


def read_motion(
    path: Path, body: BodyTemplate | None = None, fps: float | None = None, up: UpAxis = "auto", clip: str | None = None
) -> Motion:
    """The motion of an AMASS ``.npz``, a ``.bvh``, a ``.glb`` or a ``.gltf``, of 55 joints, in float32.

    Args:
        path: of the file. What was not made for ``body`` ends up with the lowest vertex of the clip at y = 0.
        body: that is to move (default: the one that comes with dyngs). The motion of another skeleton is retargeted.
        fps: frames per second to resample to; None keeps those of the file, of glTF 30.
        up: the up axis of an ``.npz``; "auto" as ``dyngs.human.motion.amass.read_amass`` tells.
        clip: name of the animation of a glTF file; needed where there are several.

    Raises:
        DyngsError: names the file and what is wrong with it.
    """
    from dyngs.human.motion.amass import read_amass
    from dyngs.human.motion.bvh import read_bvh
    from dyngs.human.motion.gltf import read_gltf
    from dyngs.human.motion.retarget import retarget
    from dyngs.human.template.body import default_template

    path, kind = Path(path), Path(path).suffix.lower()
    if kind not in (".npz", ".bvh", ".glb", ".gltf"):
        raise DyngsError(f"{path}: unknown kind of motion; give an AMASS .npz, a .bvh, a .glb or a .gltf")
    if up != "auto" and kind != ".npz":
        raise DyngsError(f"{path}: the up axis can only be told of an .npz; that of a {kind} is known")
    if clip is not None and kind not in (".glb", ".gltf"):
        raise DyngsError(f"{path}: a {kind} holds one motion without a name; do not ask for '{clip}'")
    body = default_template() if body is None else body
    with reading(path):
        if kind == ".npz":
            motion = read_amass(path, body, up)
        elif kind == ".bvh":
            motion = retarget(read_bvh(path), body)
        else:
            motion = retarget(read_gltf(path, 30.0 if fps is None else fps, clip), body)
    return motion if fps is None else motion.resampled(fps)


def save_motion(motion: Motion, path: Path) -> None:
    """Write the motion of 55 joints as an AMASS file of SMPL-X that says ``up_axis`` y, from which it is read back
    exactly.

    Raises:
        DyngsError: the suffix is not ``.npz``, or the file cannot be written.
    """
    if path.suffix.lower() != ".npz":
        raise DyngsError(f"cannot write {path}: a motion is written as .npz")
    if motion.poses.shape[1:] != (55, 3):
        raise ValueError(f"poses must be (F, 55, 3), got {tuple(motion.poses.shape)}")
    with atomic_file(path) as temporary, temporary.open("wb") as file:
        np.savez(
            file,
            poses=motion.poses.reshape(len(motion), -1).numpy(),
            trans=motion.trans.numpy(),
            betas=motion.betas.numpy(),
            scale=motion.scale.numpy(),
            mocap_frame_rate=np.float64(motion.fps),
            surface_model_type="smplx",
            gender="neutral",
            up_axis="y",
        )


def _turned_partly(before: Tensor, after: Tensor, share: np.ndarray) -> Tensor:
    """(F, J, 3) rotations between two of those, ``share`` (F,) of the way: R_a exp(s log(R_a^T R_b))."""
    from scipy.spatial.transform import Rotation

    start = Rotation.from_rotvec(before.reshape(-1, 3).double().numpy())
    turn = start.inv() * Rotation.from_rotvec(after.reshape(-1, 3).double().numpy())
    part = Rotation.from_rotvec(turn.as_rotvec() * np.repeat(share, before.shape[1])[:, None])
    return torch.from_numpy((start * part).as_rotvec()).to(before).reshape(before.shape)
