"""How a body moves: pose parameters per frame, read from and written to files.

Local letters: J joints, F frames, B shape parameters.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Literal

import numpy as np
import torch
from torch import Tensor

from dyngs.data.write import whole_file
from dyngs.errors import DyngsError

if TYPE_CHECKING:
    from dyngs.human.body import Body

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

Up = Literal["auto", "y", "z"]


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
            DyngsError: ``fps`` is not a positive number, or asks for more than a million frames.
        """
        if not len(self) * fps <= 1_000_000 * self.fps:
            raise DyngsError(f"cannot resample the motion to {fps:g} frames per second; ask for 30 or the like")
        times = sample_times(len(self) - 1, self.fps, fps)
        if fps == self.fps:
            return self
        before = np.minimum(times.astype(np.int64), max(len(self) - 2, 0))
        after = np.minimum(before + 1, len(self) - 1)
        share = torch.from_numpy(times - before).to(self.trans.dtype)

        def linear(values: Tensor) -> Tensor:
            weight = share.reshape(-1, *[1] * (values.dim() - 1))
            return torch.lerp(values[before], values[after], weight)

        poses = _turned_partly(self.poses[before], self.poses[after], times - before)
        return Motion(poses, linear(self.trans), self.betas, fps, linear(self.scale))


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
    path: Path, body: Body | None = None, fps: float | None = None, up: Up = "auto", clip: str | None = None
) -> Motion:
    """The motion of an AMASS ``.npz``, a ``.bvh``, a ``.glb`` or a ``.gltf``, of 55 joints, in float32.

    Args:
        path: of the file. What was not made for ``body`` ends up with the lowest vertex of the clip at y = 0.
        body: that is to move (default: the one that comes with dyngs). The motion of another skeleton is retargeted.
        fps: frames per second to resample to; None keeps those of the file, of glTF 30.
        up: the up axis of an ``.npz``; "auto" as ``dyngs.human.amass.read_amass`` tells.
        clip: name of the animation of a glTF file; needed where there are several.

    Raises:
        DyngsError: names the file and what is wrong with it.
    """
    from dyngs.human.amass import read_amass
    from dyngs.human.body import default_body
    from dyngs.human.bvh import read_bvh
    from dyngs.human.gltf import read_gltf
    from dyngs.human.retarget import retarget

    path, kind = Path(path), Path(path).suffix.lower()
    if kind not in (".npz", ".bvh", ".glb", ".gltf"):
        raise DyngsError(f"{path}: unknown kind of motion; give an AMASS .npz, a .bvh, a .glb or a .gltf")
    if up != "auto" and kind != ".npz":
        raise DyngsError(f"{path}: the up axis can only be told of an .npz; that of a {kind} is known")
    if clip is not None and kind not in (".glb", ".gltf"):
        raise DyngsError(f"{path}: a {kind} holds one motion without a name; do not ask for '{clip}'")
    body = default_body() if body is None else body
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
    with whole_file(path) as temporary, temporary.open("wb") as file:
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
