"""Reader and writer of AMASS motion files, and of other ``.npz`` with the parameters of SMPL,
SMPL-H and SMPL-X.

Local letter: B shape parameters.
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
"""Body models by number of joints; 22 joints are common to all three."""
_PARTS = {"root_orient": 1, "pose_body": 21, "pose_jaw": 1, "pose_eye": 2, "pose_hand": 30}
"""AMASS keys of the 55 joints in order, with joint counts. Only the first two are required."""
_NAMED = {"global_orient": 1, "body_pose": 21, "jaw_pose": 1, "leye_pose": 1, "reye_pose": 1} | {
    "left_hand_pose": 15,
    "right_hand_pose": 15,
}
"""The same for the argument names of the package smplx."""
_ALIASES = {"smpl_thetas": "poses", "smpl_betas": "betas", "transl": "trans", "cam_trans": "trans"}
"""AMASS names of keys of ROMP and of the package smplx."""
_RATES = ("mocap_frame_rate", "mocap_framerate", "fps", "frame_rate")


def read_amass(
    path: Path, body: BodyTemplate, up: UpAxis = "auto", fps: float | None = None
) -> Motion:
    """Read a motion of 55 joints, y up; joints that the file lacks do not rotate.

    Tensors are float32. ``trans`` stays float64 in files with ``scale``, which are body fits.

    Keys of AMASS: ``poses``, or its parts ``root_orient``, ``pose_body``, ...; ``trans`` (F, 3);
    ``betas`` (B,) or (F, B); ``mocap_framerate`` or ``mocap_frame_rate``, else argument ``fps``.
    Files of dyngs also have ``scale`` (one or F) and ``up_axis``. Names of the package smplx
    (``global_orient``, ``body_pose``, ``transl``, ...) and of ROMP are read, too. Poses are
    axis-angles or rotation matrices of 22, 24, 52 or 55 joints.

    The up axis is that of ``up``, else of ``up_axis``. Otherwise files with ``scale`` are y up and
    AMASS files z up; in files with smplx or ROMP names, the axis nearest to the mean up direction
    of the pelvis is up. The rotation T to y up maps vertices v to T v. With the pelvis J_0 of the
    shaped body and scale s: R_0' = T R_0, trans' = T (trans + s J_0) - s J_0.

    Files without ``scale`` and ``up_axis`` may be of another body model than ``body``. Then shape
    parameters are set to zero and the lowest vertex is placed at y = 0.
    Raises DyngsError: a key is missing or wrong.
    """
    with wrap_read_errors(path, "give an AMASS file of a motion"):
        keys = ("poses", *_PARTS, *_NAMED, "trans", "betas", *_ALIASES, "scale", "up_axis", *_RATES)
        # Other arrays are not read, since they may be pickled objects.
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
        is_dyngs_file = "scale" in arrays or "up_axis" in arrays
        is_other_model = not is_dyngs_file and body.name != model
        if not is_dyngs_file:
            betas = np.zeros_like(betas) if is_other_model else betas[: body.num_shapes]
        rate = _frame_rate(path, arrays, fps)
        turn, notes = _y_up_from_file(path, arrays, up, poses[:, 0], has_smplx_names)
        if turn is not None:
            pelvis = scale[:, None] * _pelvis(body, betas)
            roots = Rotation.from_matrix(turn) * Rotation.from_rotvec(poses[:, 0])
            poses[:, 0] = roots.as_rotvec()
            trans = (trans + pelvis) @ turn.T - pelvis
        # A fit may lie so far from the origin that float32 is too coarse.
        is_fine = "scale" in arrays and arrays["trans"].dtype == np.float64
        motion = Motion(
            poses=torch.from_numpy(poses).float(),
            trans=torch.from_numpy(trans if is_fine else trans.astype(np.float32)),
            betas=torch.from_numpy(betas).float(),
            fps=rate,
            scale=torch.from_numpy(scale).float(),
            notes=notes,
        )
        return place_on_floor(motion, body) if is_other_model else motion


def write_amass(motion: Motion, path: Path, shape_space: ShapeSpace = "smpl") -> None:
    """Write the motion of 55 joints as an AMASS file (``.npz``) of SMPL-X with ``up_axis`` y;
    reading it gives the same motion.

    ``shape_space``: "anny" if shape parameters are those of the free template.
    Raises DyngsError: the file cannot be written.
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
    """Return axis-angles (F, 55, 3), and the name of the body model of the file."""
    if "poses" in arrays:
        given = _axis_angles(path, arrays, "poses", tuple(_MODELS))
        model = _MODELS[given.shape[1]]
        rows = list(SMPLX_ROWS.get(given.shape[1], range(22)))
        poses = np.zeros((len(given), 55, 3))
        poses[:, rows] = given[:, : len(rows)]
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
            f"{path}: a joint is rotated by {largest:.0f} rad, more than two turns; convert degrees first"
        )
    return poses, model


def _axis_angles(
    path: Path, arrays: dict[str, np.ndarray], key: str, counts: tuple[int, ...]
) -> np.ndarray:
    """Return axis-angles (F, J, 3) of a key; J must be one of ``counts``.

    The file may hold axis-angles (F, 3 J) or (F, J, 3), or rotation matrices (F, J, 3, 3).
    """
    value = _numbers(path, arrays, key)
    if value.ndim == 4 and value.shape[2:] == (3, 3):
        matrices = Rotation.from_matrix(value.reshape(-1, 3, 3))
        value = matrices.as_rotvec().reshape(value.shape[:3])
    found = value.reshape(len(value), -1, 3)
    if found.shape[1] not in counts or value.shape[2:] not in ((), (3,)):
        raise DyngsError(
            f"{path}: '{key}' must hold axis-angles or rotation matrices of {' or '.join(map(str, sorted(counts)))} "
            f"joints per frame, has {' x '.join(map(str, value.shape))}; convert quaternions and 6D rotations, save "
            "hands with use_pca=False"
        )
    return found


def _numbers(path: Path, arrays: dict[str, np.ndarray], key: str) -> np.ndarray:
    if key not in arrays:
        raise DyngsError(f"{path}: the key '{key}' is missing; give an AMASS file of a motion")
    value = arrays[key]
    if value.dtype.kind not in "fiu":
        raise DyngsError(f"{path}: '{key}' must hold numbers, not {value.dtype}")
    with np.errstate(invalid="ignore"):  # signalling NaNs, which are refused just below
        value = value.astype(np.float64)
    if not (np.abs(value) < 1e9).all():
        raise DyngsError(f"{path}: '{key}' holds NaN or huge numbers; repair or export it again")
    return value


def _frame_rate(path: Path, arrays: dict[str, np.ndarray], fps: float | None) -> float:
    """Return the frame rate of a file, which may be stored as text; ``fps`` if it has none."""
    key = next((key for key in _RATES if key in arrays), None)
    if key is not None:
        fps = float(arrays[key].ravel()[0])
    if fps is None:
        raise DyngsError(
            f"{path}: has no frame rate; write a file that has one: dyngs data motion FILE OUT.npz --fps 30"
        )
    return require_frame_rate(path, fps)


def _y_up_from_file(
    path: Path, arrays: dict[str, np.ndarray], up: UpAxis, roots: np.ndarray, has_smplx_names: bool
) -> tuple[np.ndarray | None, tuple[str, ...]]:
    """Return the rotation (3, 3) to y up, and a note if the up axis was estimated.

    The rotation is None if the file is y up. See ``read_amass`` for the choice of the up axis;
    ``roots`` (F, 3) are axis-angles of the pelvis, which decide for smplx and ROMP names. -y is
    turned to y about x.
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
        notes = (
            f"{path}: the file does not name its up axis; {name} is used, as the pelvis is upright then",
        )
    if direction[1]:
        return (None if direction[1] > 0 else np.diag([1.0, -1.0, -1.0])), notes
    across = np.cross(direction, [0.0, 1.0, 0.0])
    return Rotation.from_rotvec(np.pi / 2 * across).as_matrix().round(), notes


def _pelvis(body: BodyTemplate, betas: np.ndarray) -> np.ndarray:
    """Return the root joint (3,) of the shaped body at rest."""
    pelvis = body.joints[0].double().cpu().numpy()
    if body.joint_shape_dirs is None:
        return pelvis
    directions = body.joint_shape_dirs[0].double().cpu().numpy()[:, : len(betas)]
    return pelvis + directions @ betas[: directions.shape[1]]
