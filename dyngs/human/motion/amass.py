"""Reader and writer of AMASS motion files and other ``.npz`` with SMPL, SMPL-H or SMPL-X
parameters.

Symbols: F frames, J joints, B shape parameters.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import torch
from scipy.spatial.transform import Rotation

from dyngs.core.errors import DyngsError, wrap_read_errors
from dyngs.data.capture import ShapeSpace
from dyngs.human.body.body import BodyTemplate
from dyngs.human.body.joints import SMPLX_ROWS
from dyngs.human.motion.motion import Motion, UpAxis, require_frame_count, require_frame_rate
from dyngs.human.motion.placement import place_on_floor
from dyngs.io.numpy_files import read_arrays
from dyngs.io.write import atomic_file

_MODELS = {24: "smpl", 52: "smplh", 55: "smplx", 22: "the body of all three"}
"""Model names by number of joints."""
_PARTS = {"root_orient": 1, "pose_body": 21, "pose_jaw": 1, "pose_eye": 2, "pose_hand": 30}
"""AMASS keys and joint counts of the parts of 55 joints, in order; the first two are required."""
_NAMED = {"global_orient": 1, "body_pose": 21, "jaw_pose": 1, "leye_pose": 1, "reye_pose": 1} | {
    "left_hand_pose": 15,
    "right_hand_pose": 15,
}
"""The same parts with the names of the package smplx."""
_ALIASES = {"smpl_thetas": "poses", "smpl_betas": "betas", "transl": "trans", "cam_trans": "trans"}
"""Keys of the package smplx and of ROMP, with the AMASS keys that they stand for."""
_RATES = ("mocap_frame_rate", "mocap_framerate", "fps", "frame_rate")


def read_amass(
    path: Path, body: BodyTemplate, up: UpAxis = "auto", fps: float | None = None
) -> Motion:
    """Read a motion of 55 joints, y up; joints missing in the file do not rotate.

    Accepted keys: AMASS (``poses``, or ``root_orient``, ``pose_body`` ..; ``trans`` (F, 3);
    ``betas`` (B,) or (F, B); ``mocap_framerate``), the package smplx (``global_orient``,
    ``body_pose``, ``transl``, ..) or ROMP. Poses are axis-angles or rotation matrices of 22, 24,
    52 or 55 joints. Files of dyngs also have ``scale`` (1 or F) and ``up_axis``; their ``trans``
    stays float64.

    AMASS files are z up, unless ``up``, ``up_axis`` or ``scale`` say otherwise; for smplx and ROMP
    keys, up is the axis nearest to the mean up direction of the pelvis. The rotation T to y up
    maps R_0' = T R_0 about the pelvis J_0 and trans' = T (trans + s J_0) - s J_0. For a file of
    another model than ``body``, without ``scale`` and ``up_axis``, shape parameters are set to
    zero and the motion is placed on the floor (y = 0).

    Args:
        path: of the ``.npz`` file.
        body: template that plays the motion.
        up: up axis of the file.
        fps: frame rate of files without one.

    Raises:
        DyngsError: names the file and what is missing or wrong.
    """
    with wrap_read_errors(path, "give an AMASS file of a motion"):
        keys = ("poses", *_PARTS, *_NAMED, "trans", "betas", *_ALIASES, "scale", "up_axis", *_RATES)
        # Other keys may hold objects and are not read.
        arrays = read_arrays(path, lambda names: [key for key in keys if key in names])
        renamed = [key for key, name in _ALIASES.items() if key in arrays and name not in arrays]
        for key in renamed:
            arrays[_ALIASES[key]] = arrays.pop(key)
        has_smplx_names = bool(renamed) or (
            "poses" not in arrays and "root_orient" not in arrays and "global_orient" in arrays
        )
        poses, model = _poses(path, arrays)
        frames = len(poses)
        trans = _numbers(path, arrays, "trans").reshape(frames, 3)
        scale = np.ones(1)
        if "scale" in arrays:
            scale = _numbers(path, arrays, "scale")
            if not (scale > 0).all():
                raise DyngsError(f"{path}: 'scale' must be positive")
        scale = np.broadcast_to(scale, frames).copy()
        betas = np.zeros(10)
        if "betas" in arrays:
            betas = _numbers(path, arrays, "betas")
            betas = betas.reshape(-1, betas.shape[-1]).mean(0)
        is_fit = "scale" in arrays or "up_axis" in arrays
        is_other_model = not is_fit and body.name != model
        if not is_fit:
            betas = np.zeros_like(betas) if is_other_model else betas[: body.num_shapes]
        rate = _frame_rate(path, arrays, fps)
        y_from_file, notes = _y_up_from_file(path, arrays, up, poses[:, 0], has_smplx_names)
        if y_from_file is not None:
            pelvis = scale[:, None] * _pelvis(body, betas)
            roots = Rotation.from_matrix(y_from_file) * Rotation.from_rotvec(poses[:, 0])
            poses[:, 0] = roots.as_rotvec()
            trans = (trans + pelvis) @ y_from_file.T - pelvis
        # float32 is too coarse for a fit far from the origin.
        has_float64_trans = "scale" in arrays and arrays["trans"].dtype == np.float64
        motion = Motion(
            poses=torch.from_numpy(poses).float(),
            trans=torch.from_numpy(trans if has_float64_trans else trans.astype(np.float32)),
            betas=torch.from_numpy(betas).float(),
            fps=rate,
            scale=torch.from_numpy(scale).float(),
            notes=notes,
        )
        return place_on_floor(motion, body) if is_other_model else motion


def write_amass(motion: Motion, path: Path, shape_space: ShapeSpace = "smpl") -> None:
    """Write a motion of 55 joints as an AMASS file (``.npz``) of SMPL-X with ``up_axis`` y.

    Reading it returns the same motion. With ``shape_space`` "anny" the file names the free
    template as its model. Raises DyngsError: the file cannot be written.
    """
    with atomic_file(path) as temporary, temporary.open("wb") as file:
        np.savez(
            file,
            poses=motion.poses.reshape(len(motion), -1).cpu().numpy(),
            trans=motion.trans.cpu().numpy(),
            betas=motion.betas.cpu().numpy(),
            scale=motion.scale.cpu().numpy(),
            mocap_frame_rate=np.float64(motion.fps),
            surface_model_type="smplx" if shape_space == "smpl" else shape_space,
            gender="neutral",
            up_axis="y",
        )


def _poses(path: Path, arrays: dict[str, np.ndarray]) -> tuple[np.ndarray, str]:
    """Return axis-angles (F, 55, 3) and the name of the model of the file."""
    if "poses" in arrays:
        values = _axis_angles(path, arrays, "poses", tuple(_MODELS))
        model = _MODELS[values.shape[1]]
        rows = list(SMPLX_ROWS.get(values.shape[1], range(22)))
        poses = np.zeros((len(values), 55, 3))
        poses[:, rows] = values[:, : len(rows)]
    else:
        parts = _PARTS if "root_orient" in arrays or "global_orient" not in arrays else _NAMED
        root, body, *_ = parts
        turns = {
            key: _axis_angles(path, arrays, key, (21, 23) if key == body else (count,))
            for key, count in parts.items()
            if key in arrays or key in (root, body)
        }
        model = "smplx" if turns[body].shape[1] == 21 else "smpl"
        poses = np.zeros((len(turns[root]), 55, 3))
        start = 0
        for key, count in parts.items():
            if key in turns:  # omits the last two joints of SMPL, the hands
                poses[:, start : start + count] = turns[key][:, :count]
            start += count
    require_frame_count(path, len(poses), 55)
    largest = np.linalg.norm(poses, axis=-1).max()
    if largest > 4 * np.pi:
        raise DyngsError(
            f"{path}: a joint rotates by {largest:.0f} rad, more than two turns; convert degrees "
            "to radians"
        )
    return poses, model


def _axis_angles(
    path: Path, arrays: dict[str, np.ndarray], key: str, counts: tuple[int, ...]
) -> np.ndarray:
    """Return the axis-angles (F, J, 3) of a key: from (F, 3 J), (F, J, 3) or matrices (F, J, 3,
    3).

    J must be one of ``counts``.
    """
    value = _numbers(path, arrays, key)
    if value.ndim == 4 and value.shape[2:] == (3, 3):
        matrices = Rotation.from_matrix(value.reshape(-1, 3, 3))
        value = matrices.as_rotvec().reshape(value.shape[:3])
    rotvecs = value.reshape(len(value), -1, 3)
    if rotvecs.shape[1] not in counts or value.shape[2:] not in ((), (3,)):
        raise DyngsError(
            f"{path}: '{key}' must hold axis-angles or rotation matrices of "
            f"{' or '.join(map(str, sorted(counts)))} joints per frame, got shape "
            f"{' x '.join(map(str, value.shape))}; convert quaternions and 6D rotations, save "
            "hands with use_pca=False"
        )
    return rotvecs


def _numbers(path: Path, arrays: dict[str, np.ndarray], key: str) -> np.ndarray:
    if key not in arrays:
        raise DyngsError(f"{path}: the key '{key}' is missing; give an AMASS file of a motion")
    value = arrays[key]
    if value.dtype.kind not in "fiu":
        raise DyngsError(f"{path}: '{key}' must hold numbers, not {value.dtype}")
    with np.errstate(invalid="ignore"):  # signalling NaNs are rejected below
        value = value.astype(np.float64)
    if not (np.abs(value) < 1e9).all():
        raise DyngsError(f"{path}: '{key}' holds NaN or huge numbers; repair or export it again")
    return value


def _frame_rate(path: Path, arrays: dict[str, np.ndarray], fps: float | None) -> float:
    """Return the frame rate of a file (a number or text), or ``fps``."""
    key = next((key for key in _RATES if key in arrays), None)
    if key is not None:
        fps = float(arrays[key].ravel()[0])
    if fps is None:
        raise DyngsError(
            f"{path}: has no frame rate; add one: dyngs data motion FILE OUT.npz --fps 30"
        )
    return require_frame_rate(path, fps)


def _y_up_from_file(
    path: Path, arrays: dict[str, np.ndarray], up: UpAxis, roots: np.ndarray, has_smplx_names: bool
) -> tuple[np.ndarray | None, tuple[str, ...]]:
    """Return the rotation (3, 3) to y up (None: the identity), and a note if the up axis was
    guessed.

    ``up`` or the key ``up_axis`` decide, else AMASS files are z up. For smplx and ROMP keys
    (``has_smplx_names``), up is the signed axis nearest to the mean up direction of the root
    ``roots`` (F, 3).
    """
    if up != "auto":
        chosen = up
    elif "up_axis" in arrays:
        chosen = str(arrays["up_axis"])
        if chosen not in ("y", "z"):
            raise DyngsError(f"{path}: 'up_axis' must be 'y' or 'z', not {chosen!r:.20}")
    else:
        chosen = "y" if "scale" in arrays else "z"
    direction = np.eye(3)["xyz".index(chosen)]
    notes = ()
    if up == "auto" and "up_axis" not in arrays and has_smplx_names:
        mean = Rotation.from_rotvec(roots).as_matrix()[:, :, 1].mean(axis=0)
        axis = int(np.abs(mean).argmax())
        direction = np.eye(3)[axis] * (1.0 if mean[axis] >= 0 else -1.0)
        name = f"{'' if mean[axis] >= 0 else '-'}{'xyz'[axis]}"
        notes = (f"{path}: no up axis in the file; using {name}, for which the pelvis is upright",)
    if direction[1]:
        return (None if direction[1] > 0 else np.diag([1.0, -1.0, -1.0])), notes
    across = np.cross(direction, [0.0, 1.0, 0.0])
    return Rotation.from_rotvec(np.pi / 2 * across).as_matrix().round(), notes


def _pelvis(body: BodyTemplate, betas: np.ndarray) -> np.ndarray:
    """Return the root joint (3,) of the shaped body in the rest pose."""
    pelvis = body.joints[0].double().cpu().numpy()
    if body.joint_shape_dirs is None:
        return pelvis
    directions = body.joint_shape_dirs[0].double().cpu().numpy()[:, : len(betas)]
    return pelvis + directions @ betas[: directions.shape[1]]
