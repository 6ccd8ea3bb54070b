"""Reader and writer of AMASS motion files, and of other ``.npz`` with the parameters of SMPL, SMPL-H and SMPL-X.

Local letter: B shape parameters.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import torch
from scipy.spatial.transform import Rotation

from dyngs.data.capture import ShapeSpace
from dyngs.errors import DyngsError, reading
from dyngs.files.numpy_files import read_arrays
from dyngs.files.write import atomic_file
from dyngs.human.motion.motion import Motion, UpAxis, require_frame_count, require_frame_rate
from dyngs.human.motion.placement import place_on_floor
from dyngs.human.template.body import BodyTemplate
from dyngs.human.template.joints import SMPLX_ROWS

_MODELS = {72: "smpl", 156: "smplh", 165: "smplx"}
_PARTS = {"root_orient": 3, "pose_body": 63, "pose_jaw": 3, "pose_eye": 6, "pose_hand": 90}
"""Keys and widths of the parts of 165 numbers, in order; all after the second may be missing."""
_NAMED = {"global_orient": 3, "body_pose": 63, "jaw_pose": 3, "leye_pose": 3, "reye_pose": 3} | {
    "left_hand_pose": 45,
    "right_hand_pose": 45,
}
"""The same as the package smplx names its arguments."""
_RATES = ("mocap_frame_rate", "mocap_framerate", "fps", "frame_rate")
_ANY_AXES = "any axes"  # marks arrays of a file with the names of smplx: nobody says which way is up
_Y_UP_FROM_Z_UP = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]])


def read_amass(path: Path, body: BodyTemplate, up: UpAxis = "auto") -> Motion:
    """Read a motion of 55 joints, y up; joints that the file lacks do not rotate.

    Tensors are float32, but ``trans`` of a fit, a file with ``scale``, is float64 where the file has it so.

    Keys: ``poses`` (F, 72, 156 or 165), or ``root_orient``, ``pose_body`` and the like; ``trans`` (F, 3);
    ``mocap_framerate`` or ``mocap_frame_rate``; ``betas`` (B,); ``scale`` (one or F) and ``up_axis`` in files of dyngs
    or a fit. Or the names of the package smplx: ``global_orient``, ``body_pose`` and the like, ``transl``, ``fps``.

    AMASS files are z up: unless ``up`` or ``up_axis`` says otherwise, a file is z up if it has no ``scale``; with the
    names of smplx the axis nearest to the mean up direction of the pelvis is up. The rotation T to y up moves every
    vertex v to T v: R_0' = T R_0 about the pelvis J_0 of the shaped body, trans' = T (trans + s J_0) - s J_0. If
    ``body`` is of another family than a file without ``scale`` and ``up_axis``, shape parameters are set to zero and
    the lowest vertex to y = 0. Raises DyngsError: names the file and what is missing or wrong.
    """
    with reading(path):
        return _motion(path, _arrays(path), body, up)


def write_amass(motion: Motion, path: Path, shape_space: ShapeSpace = "smpl") -> None:
    """Write the motion of 55 joints as an AMASS file of SMPL-X with ``up_axis`` y; reading it gives the same motion.

    ``shape_space`` is that of the shape parameters: with "anny" the file names the free template as its model. Raises
    DyngsError: the suffix is not ``.npz``, or the file cannot be written.
    """
    if path.suffix.lower() != ".npz":
        raise DyngsError(f"cannot write {path}: a motion is written as .npz")
    if motion.poses.shape[1:] != (55, 3):
        raise ValueError(f"poses must be (F, 55, 3), got {tuple(motion.poses.shape)}")
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


def _motion(path: Path, arrays: dict[str, np.ndarray], body: BodyTemplate, up: UpAxis) -> Motion:
    poses, width = _poses(path, arrays)
    frames = len(poses)
    trans = _numbers(path, arrays, "trans")
    if trans.shape != (frames, 3):
        raise DyngsError(f"{path}: 'trans' must be {frames} x 3 numbers as 'poses' has {frames} frames, {_got(trans)}")
    betas = np.atleast_1d(_numbers(path, arrays, "betas").squeeze()) if "betas" in arrays else np.zeros(10)
    if betas.ndim != 1:
        raise DyngsError(f"{path}: 'betas' must be one row of numbers, {_got(betas)}")
    scale = _scale(path, arrays, frames)
    is_own = "scale" in arrays or "up_axis" in arrays
    is_other_model = not is_own and body.name != _MODELS[width]
    if not is_own:
        betas = np.zeros_like(betas) if is_other_model else betas[: body.num_shapes]
    turn = _y_up_from_file(path, arrays, up, poses[:, 0])
    if turn is not None:
        pelvis = scale[:, None] * _pelvis(body, betas)
        poses[:, 0] = (Rotation.from_matrix(turn) * Rotation.from_rotvec(poses[:, 0])).as_rotvec()
        trans = (trans + pelvis) @ turn.T - pelvis
    tensors = [torch.from_numpy(x).float() for x in (poses, betas, scale)]
    # A fit may lie so far from the origin that float32 is too coarse.
    is_fine = "scale" in arrays and arrays["trans"].dtype == np.float64
    place = torch.from_numpy(trans if is_fine else trans.astype(np.float32))
    motion = Motion(tensors[0], place, tensors[1], _fps(path, arrays), tensors[2])
    return place_on_floor(motion, body) if is_other_model else motion


def _arrays(path: Path) -> dict[str, np.ndarray]:
    """Return the arrays that are needed; others, which may hold objects, are not read."""
    keys = ("poses", *_PARTS, *_NAMED, "trans", "transl", "betas", "scale", "up_axis", *_RATES)
    if not path.is_file():
        raise DyngsError(f"{path}: no such file")
    found = read_arrays(path, lambda names: [key for key in keys if key in names])
    if "poses" not in found and "root_orient" not in found and "global_orient" in found:
        return _renamed(path, found)
    return found


def _renamed(path: Path, arrays: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Return the arrays of a file with the names of the package smplx under those of AMASS, with poses of 165."""
    rest = {key: x for key, x in arrays.items() if key not in _NAMED} | {_ANY_AXES: np.ones(1)}
    rest["poses"] = _joined(path, arrays, _NAMED)
    betas = rest.get("betas")
    if betas is not None and betas.ndim == 2 and len(betas) == len(rest["poses"]):
        rest["betas"] = _numbers(path, arrays, "betas").mean(axis=0)  # of one person, fitted to each frame anew
    if "transl" in rest:
        rest["trans"] = rest.pop("transl")
    return rest


def _poses(path: Path, arrays: dict[str, np.ndarray]) -> tuple[np.ndarray, int]:
    """Return axis-angle poses (F, 55, 3), and how many numbers a frame has in the file."""
    if "poses" in arrays:
        flat = _numbers(path, arrays, "poses")
        if flat.ndim != 2 or flat.shape[1] not in _MODELS:
            raise DyngsError(f"{path}: 'poses' must have 72, 156 or 165 numbers per frame, {_got(flat)}")
    else:
        flat = _joined(path, arrays, _PARTS)
    if not len(flat):
        raise DyngsError(f"{path}: has no frames")
    require_frame_count(path, len(flat), 55)
    rows = list(SMPLX_ROWS[flat.shape[1] // 3])
    poses = np.zeros((len(flat), 55, 3))
    poses[:, rows] = flat.reshape(len(flat), -1, 3)[:, : len(rows)]
    return poses, flat.shape[1]


def _joined(path: Path, arrays: dict[str, np.ndarray], widths: dict[str, int]) -> np.ndarray:
    """Return poses (F, 165) of parts by their widths; zero for those that lack, but for root and body."""
    root, body = list(widths)[:2]
    missing = [key for key in (root, body) if key not in arrays]
    if missing and widths is _PARTS:
        raise DyngsError(
            f"{path}: has neither 'poses' nor '{missing[0]}' nor 'global_orient'; give an AMASS file of a motion"
        )
    frames = len(np.atleast_1d(arrays[root]))
    parts = []
    for key, width in widths.items():
        part = _numbers(path, arrays, key) if key in arrays or key == body else np.zeros((frames, width))
        if widths is _NAMED and part.ndim:
            part = part.reshape(len(part), -1)
            part = part[:, :63] if key == body and part.shape[1] == 69 else part  # SMPL's last two joints: the hands
        if part.shape != (frames, width):
            advice = "; save axis-angles, hands with use_pca=False" if widths is _NAMED and part.ndim == 2 else ""
            raise DyngsError(f"{path}: '{key}' must be {frames} x {width} numbers, {_got(part)}{advice}")
        parts.append(part)
    return np.concatenate(parts, axis=1)


def _numbers(path: Path, arrays: dict[str, np.ndarray], key: str) -> np.ndarray:
    if key not in arrays:
        raise DyngsError(f"{path}: the key '{key}' is missing; give an AMASS file of a motion")
    value = arrays[key]
    if value.dtype.kind not in "fiu":
        raise DyngsError(f"{path}: '{key}' must hold numbers, not {value.dtype}")
    with np.errstate(invalid="ignore", over="ignore"):  # NaN and the like, which are refused below
        value = value.astype(np.float64)
    if not (np.abs(value) < 1e9).all():
        raise DyngsError(f"{path}: '{key}' holds NaN or huge numbers; repair or export it again")
    return value


def _fps(path: Path, arrays: dict[str, np.ndarray]) -> float:
    key = next((key for key in _RATES if key in arrays), "fps" if _ANY_AXES in arrays else _RATES[1])
    rate = _numbers(path, arrays, key)
    if rate.size != 1 or not rate.item() > 0:
        raise DyngsError(f"{path}: '{key}' must be one positive number")
    return require_frame_rate(path, rate.item())


def _scale(path: Path, arrays: dict[str, np.ndarray], frames: int) -> np.ndarray:
    """Return the scale (F,) of the template; 1 where the file has none."""
    scale = _numbers(path, arrays, "scale") if "scale" in arrays else np.ones(())
    if scale.shape not in ((), (1,), (frames,)) or not (scale > 0).all():
        raise DyngsError(f"{path}: 'scale' must be one positive number, or one for each of {frames} frames")
    return np.broadcast_to(scale, frames).copy()


def _y_up_from_file(path: Path, arrays: dict[str, np.ndarray], up: UpAxis, roots: np.ndarray) -> np.ndarray | None:
    """Return the rotation (3, 3) to y up, None if there is nothing to turn.

    By ``up``, the key ``up_axis``, as AMASS files are, or by rotations (F, 3) of the root: the signed axis nearest to
    the mean up direction becomes y, by half a turn about x for -y.
    """
    if up == "auto" and "up_axis" in arrays:
        up = "z" if str(arrays["up_axis"]) == "z" else "y"
        if str(arrays["up_axis"]) not in ("y", "z"):
            raise DyngsError(f"{path}: 'up_axis' must be 'y' or 'z', not {str(arrays['up_axis'])!r:.20}")
    elif up == "auto" and _ANY_AXES in arrays:
        mean = Rotation.from_rotvec(roots).as_matrix()[:, :, 1].mean(axis=0)
        axis = int(np.abs(mean).argmax())
        if axis == 1:
            return None if mean[1] >= 0 else np.diag([1.0, -1.0, -1.0])
        across = np.cross(np.eye(3)[axis] * (1.0 if mean[axis] >= 0 else -1.0), [0.0, 1.0, 0.0])
        return Rotation.from_rotvec(np.pi / 2 * across).as_matrix()
    is_z_up = up == "z" or (up == "auto" and "scale" not in arrays)
    return _Y_UP_FROM_Z_UP if is_z_up else None


def _pelvis(body: BodyTemplate, betas: np.ndarray) -> np.ndarray:
    """Return the root joint (3,) of the shaped body at rest."""
    pelvis = body.joints[0].double().cpu().numpy()
    if body.joint_shape_dirs is None:
        return pelvis
    directions = body.joint_shape_dirs[0].double().cpu().numpy()[:, : len(betas)]
    return pelvis + directions @ betas[: directions.shape[1]]


def _got(value: np.ndarray) -> str:
    return f"has {' x '.join(map(str, value.shape)) or 'one number'}"
