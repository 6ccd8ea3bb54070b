"""Reader and writer of AMASS motion files, and of other ``.npz`` with the parameters of SMPL,
SMPL-H and SMPL-X.

Local letter: B shape parameters.
"""

from __future__ import annotations

from contextlib import suppress
from pathlib import Path

import numpy as np
import torch
from scipy.spatial.transform import Rotation

from dyngs.core.errors import DyngsError, reading
from dyngs.data.capture import ShapeSpace
from dyngs.human.body.body import BodyTemplate
from dyngs.human.body.joints import SMPLX_ROWS
from dyngs.human.motion.motion import Motion, UpAxis, require_frame_count, require_frame_rate
from dyngs.human.motion.placement import place_on_floor
from dyngs.io.numpy_files import read_arrays
from dyngs.io.write import atomic_file

_MODELS = {24: "smpl", 52: "smplh", 55: "smplx", 22: "the body of all three"}
"""Names of the models by their number of joints."""
_PARTS = {"root_orient": 1, "pose_body": 21, "pose_jaw": 1, "pose_eye": 2, "pose_hand": 30}
"""Keys and joints of the parts of 55 joints, in order; all after the second may be missing."""
_NAMED = {"global_orient": 1, "body_pose": 21, "jaw_pose": 1, "leye_pose": 1, "reye_pose": 1} | {
    "left_hand_pose": 15,
    "right_hand_pose": 15,
}
"""The same as the package smplx names its arguments."""
_ALIASES = {"smpl_thetas": "poses", "smpl_betas": "betas", "transl": "trans", "cam_trans": "trans"}
"""Names of the package smplx, and of ROMP, by those of AMASS."""
_RATES = ("mocap_frame_rate", "mocap_framerate", "fps", "frame_rate")
# marks arrays of a file with the names of smplx or ROMP: nobody says which way is up
_ANY_AXES = "any axes"
_MAX_ANGLE = 4 * np.pi  # rad; no program writes a joint that is rotated by more than two turns
_MAX_SPEED = 20.0  # m/s, of the root; a sprinter reaches 12
_Y_UP_FROM_Z_UP = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]])


def read_amass(
    path: Path, body: BodyTemplate, up: UpAxis = "auto", fps: float | None = None
) -> Motion:
    """Read a motion of 55 joints, y up; joints that the file lacks do not rotate.

    Tensors are float32, but ``trans`` of a fit, a file with ``scale``, is float64 where the file
    has it so.

    Keys: ``poses``, or ``root_orient``, ``pose_body`` and the like; ``trans`` (F, 3);
    ``mocap_framerate`` or ``mocap_frame_rate``, else ``fps`` frames per second; ``betas`` (B,) or
    (F, B); ``scale`` (one or F) and ``up_axis`` in files of dyngs or a fit. Or the names of the
    package smplx: ``global_orient``, ``body_pose`` and the like, ``transl``, ``fps``; or those of
    ROMP. Poses are axis-angles or rotation matrices of 22, 24, 52 or 55 joints.

    AMASS files are z up: unless ``up`` or ``up_axis`` says otherwise, a file is z up if it has no
    ``scale``; with the names of smplx the axis nearest to the mean up direction of the pelvis is
    up. The rotation T to y up moves every vertex v to T v: R_0' = T R_0 about the pelvis J_0 of the
    shaped body, trans' = T (trans + s J_0) - s J_0. If ``body`` is of another family than a file
    without ``scale`` and ``up_axis``, shape parameters are set to zero and the lowest vertex to y =
    0. Raises DyngsError: names the file and what is missing or wrong.
    """
    with reading(path):
        return _motion(path, _arrays(path), body, up, fps)


def write_amass(motion: Motion, path: Path, shape_space: ShapeSpace = "smpl") -> None:
    """Write the motion of 55 joints as an AMASS file of SMPL-X with ``up_axis`` y; reading it gives
    the same motion.

    ``shape_space`` is that of the shape parameters: with "anny" the file names the free template as
    its model. Raises DyngsError: the suffix is not ``.npz``, or the file cannot be written.
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


def _motion(
    path: Path, arrays: dict[str, np.ndarray], body: BodyTemplate, up: UpAxis, fps: float | None
) -> Motion:
    poses, model = _poses(path, arrays)
    frames = len(poses)
    trans = _numbers(path, arrays, "trans")
    if trans.shape[-1:] != (3,) or _without_ones(trans.shape[:-1]) != _without_ones((frames,)):
        raise DyngsError(
            f"{path}: 'trans' must be {frames} x 3 numbers as 'poses' has {frames} frames, {_got(trans)}"
        )
    trans = trans.reshape(frames, 3)
    scale = _scale(path, arrays, frames)
    is_own = "scale" in arrays or "up_axis" in arrays
    is_other_model = not is_own and body.name != model
    betas, notes = _betas(path, arrays, frames)
    if not is_own:
        betas = np.zeros_like(betas) if is_other_model else betas[: body.num_shapes]
    if notes and is_other_model:
        notes = [f"{notes[0]}, but dropped as the template is '{body.name}'"]
    rate = _fps(path, arrays, fps)
    turn, assumed = _y_up_from_file(path, arrays, up, poses[:, 0])
    if turn is not None:
        pelvis = scale[:, None] * _pelvis(body, betas)
        poses[:, 0] = (Rotation.from_matrix(turn) * Rotation.from_rotvec(poses[:, 0])).as_rotvec()
        trans = (trans + pelvis) @ turn.T - pelvis
    tensors = [torch.from_numpy(x).float() for x in (poses, betas, scale)]
    # A fit may lie so far from the origin that float32 is too coarse.
    is_fine = "scale" in arrays and arrays["trans"].dtype == np.float64
    place = torch.from_numpy(trans if is_fine else trans.astype(np.float32))
    notes += [*assumed, *([] if "scale" in arrays else _about_speed(trans, rate))]
    motion = Motion(
        tensors[0], place, tensors[1], rate, tensors[2], tuple(f"{path}: {note}" for note in notes)
    )
    return place_on_floor(motion, body) if is_other_model else motion


def _about_speed(trans: np.ndarray, fps: float) -> list[str]:
    """Return a warning if the root moves so fast that its positions (F, 3) can hardly be metres."""
    speeds = np.linalg.norm(np.diff(trans, axis=0), axis=1) * fps
    speed = float(np.quantile(speeds, 0.9)) if len(speeds) else 0.0
    if speed <= _MAX_SPEED:
        return []
    return [
        f"the root moves at {speed:.0f} m/s; 'trans' must be metres: divide it by 1000 if it is millimetres"
    ]


def _arrays(path: Path) -> dict[str, np.ndarray]:
    """Return the arrays that are needed by AMASS's names; others, which may hold objects, are not
    read."""
    keys = ("poses", *_PARTS, *_NAMED, "trans", "betas", *_ALIASES, "scale", "up_axis", *_RATES)
    if not path.is_file():
        raise DyngsError(f"{path}: no such file")
    found = read_arrays(path, lambda names: [key for key in keys if key in names])
    renamed = [alias for alias, key in _ALIASES.items() if alias in found and key not in found]
    for alias in renamed:
        found[_ALIASES[alias]] = found.pop(alias)
    if renamed or (
        "poses" not in found and "root_orient" not in found and "global_orient" in found
    ):
        found[_ANY_AXES] = np.ones(1)
    return found


def _poses(path: Path, arrays: dict[str, np.ndarray]) -> tuple[np.ndarray, str]:
    """Return axis-angles (F, 55, 3), and the name of the model that the file is for."""
    if "poses" in arrays:
        given = _axis_angles(path, arrays, "poses", tuple(_MODELS))
        model = _MODELS[given.shape[1]]
    else:
        given, model = _joined(path, arrays)
    if not len(given):
        raise DyngsError(f"{path}: has no frames")
    require_frame_count(path, len(given), 55)
    rows = list(SMPLX_ROWS.get(given.shape[1], range(22)))
    poses = np.zeros((len(given), 55, 3))
    poses[:, rows] = given[:, : len(rows)]
    largest = np.linalg.norm(poses, axis=-1).max()
    if largest > _MAX_ANGLE:
        raise DyngsError(
            f"{path}: a joint is rotated by {largest:.0f} rad, more than two turns; convert degrees first"
        )
    return poses, model


def _joined(path: Path, arrays: dict[str, np.ndarray]) -> tuple[np.ndarray, str]:
    """Return axis-angles (F, 55, 3) of parts, zero for those that lack but for root and body; and
    the model's name."""
    parts = _NAMED if "root_orient" not in arrays and "global_orient" in arrays else _PARTS
    root, body, *others = parts
    if parts is _PARTS and not (root in arrays and body in arrays):
        missing = body if root in arrays else root
        raise DyngsError(
            f"{path}: has neither 'poses' nor '{missing}' nor 'global_orient'; give an AMASS file of a motion"
        )
    found = [_axis_angles(path, arrays, root, (1,)), _axis_angles(path, arrays, body, (21, 23))]
    model = "smplx" if found[1].shape[1] == 21 else "smpl"
    found[1] = found[1][:, :21]  # SMPL's last two joints are the hands
    frames = len(found[0])
    for key in others:
        found.append(
            _axis_angles(path, arrays, key, (parts[key],))
            if key in arrays
            else np.zeros((frames, parts[key], 3))
        )
    for key, part in zip(parts, found, strict=True):
        if len(part) != frames:
            raise DyngsError(
                f"{path}: '{key}' must have {frames} frames as '{root}' has, {_got(arrays[key])}"
            )
    return np.concatenate(found, axis=1), model


def _axis_angles(
    path: Path, arrays: dict[str, np.ndarray], key: str, counts: tuple[int, ...]
) -> np.ndarray:
    """Return the axis-angles (F, J, 3) of a key, J one of ``counts``, with or without a batch
    dimension of 1."""
    value = _numbers(path, arrays, key)
    is_batch = value.ndim > 2 and len(value) == 1
    for clip in (value, value[0]) if is_batch else (value,):
        for count in counts:
            found = _rotations(clip, count)
            if found is not None:
                return found
    joints = " or ".join(map(str, sorted(counts)))
    raise DyngsError(
        f"{path}: '{key}' must hold axis-angles or rotation matrices of {joints} joints per frame, {_got(value)}; "
        "convert quaternions and 6D rotations, save hands with use_pca=False"
    )


def _rotations(clip: np.ndarray, count: int) -> np.ndarray | None:
    """Return the axis-angles (F, J, 3) of J = ``count`` joints or of their rotation matrices, None
    of others."""
    rest = _without_ones(clip.shape[1:])
    if rest in ((3 * count,), (count, 3)):
        return clip.reshape(len(clip), count, 3)
    if rest not in ((9 * count,), _without_ones((count, 3, 3))):
        return None
    matrices = clip.reshape(-1, 3, 3)
    errors = np.abs(matrices @ matrices.transpose(0, 2, 1) - np.eye(3))
    # Half precision errs by a tenth of that.
    if errors.max(initial=0) > 0.01 or (np.linalg.det(matrices) < 0).any():
        return None
    return Rotation.from_matrix(matrices).as_rotvec().reshape(len(clip), count, 3)


def _without_ones(shape: tuple[int, ...]) -> tuple[int, ...]:
    return tuple(size for size in shape if size != 1)


def _betas(path: Path, arrays: dict[str, np.ndarray], frames: int) -> tuple[np.ndarray, list[str]]:
    """Return the shape parameters (B,), the mean if each frame has its own; and a note that says
    so."""
    if "betas" not in arrays:
        return np.zeros(10), []
    betas = np.atleast_2d(_numbers(path, arrays, "betas").squeeze())
    if betas.ndim != 2 or len(betas) not in (1, frames):
        raise DyngsError(
            f"{path}: 'betas' must be one row of numbers or one for each frame, {_got(arrays['betas'])}"
        )
    span = np.ptp(betas, axis=0).max(initial=0)
    if not span:
        return betas[0], []
    return betas.mean(axis=0), [
        f"'betas' differ between frames by up to {span:.2g}: the mean is taken"
    ]


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


def _fps(path: Path, arrays: dict[str, np.ndarray], fps: float | None) -> float:
    """Return the frame rate of a file; ``fps`` if it has none."""
    key = next((key for key in _RATES if key in arrays), None)
    if key is None:
        if fps is not None:
            return require_frame_rate(path, fps)
        raise DyngsError(
            f"{path}: has no frame rate; write a file that has one: dyngs data motion FILE OUT.npz --fps 30"
        )
    with suppress(ValueError):  # text that is no number is refused below
        arrays = arrays | {key: arrays[key].astype(np.float64)}
    rates = np.unique(_numbers(path, arrays, key))
    if rates.size != 1 or not rates.item() > 0:
        raise DyngsError(f"{path}: '{key}' must be one positive number")
    return require_frame_rate(path, rates.item())


def _scale(path: Path, arrays: dict[str, np.ndarray], frames: int) -> np.ndarray:
    """Return the scale (F,) of the template; 1 where the file has none."""
    scale = _numbers(path, arrays, "scale") if "scale" in arrays else np.ones(())
    if scale.shape not in ((), (1,), (frames,)) or not (scale > 0).all():
        raise DyngsError(
            f"{path}: 'scale' must be one positive number, or one for each of {frames} frames"
        )
    return np.broadcast_to(scale, frames).copy()


def _y_up_from_file(
    path: Path, arrays: dict[str, np.ndarray], up: UpAxis, roots: np.ndarray
) -> tuple[np.ndarray | None, list[str]]:
    """Return the rotation (3, 3) to y up, None if there is nothing to turn; and a note if up had to
    be assumed.

    By ``up``, the key ``up_axis``, as AMASS files are, or by rotations (F, 3) of the root: the
    signed axis nearest to the mean up direction becomes y, by half a turn about x for -y.
    """
    notes = []
    if up == "auto" and "up_axis" in arrays:
        up = "z" if str(arrays["up_axis"]) == "z" else "y"
        if str(arrays["up_axis"]) not in ("y", "z"):
            raise DyngsError(
                f"{path}: 'up_axis' must be 'y' or 'z', not {str(arrays['up_axis'])!r:.20}"
            )
    elif up == "auto" and _ANY_AXES in arrays:
        mean = Rotation.from_rotvec(roots).as_matrix()[:, :, 1].mean(axis=0)
        axis = int(np.abs(mean).argmax())
        sign = 1.0 if mean[axis] >= 0 else -1.0
        notes = [
            f"the file does not say what is up; {'-' * (sign < 0)}{'xyz'[axis]} is taken, as the pelvis is upright so"
        ]
        if axis == 1:
            return (None if sign > 0 else np.diag([1.0, -1.0, -1.0])), notes
        across = np.cross(np.eye(3)[axis] * sign, [0.0, 1.0, 0.0])
        return Rotation.from_rotvec(np.pi / 2 * across).as_matrix(), notes
    elif up == "auto" and "scale" not in arrays:
        up = "z"
        if not any(key in arrays for key in _RATES):
            notes = [
                "the file does not say what is up; z is taken, as in files of AMASS; --up y takes y"
            ]
    return (_Y_UP_FROM_Z_UP if up == "z" else None), notes


def _pelvis(body: BodyTemplate, betas: np.ndarray) -> np.ndarray:
    """Return the root joint (3,) of the shaped body at rest."""
    pelvis = body.joints[0].double().cpu().numpy()
    if body.joint_shape_dirs is None:
        return pelvis
    directions = body.joint_shape_dirs[0].double().cpu().numpy()[:, : len(betas)]
    return pelvis + directions @ betas[: directions.shape[1]]


def _got(value: np.ndarray) -> str:
    return f"has {' x '.join(map(str, value.shape)) or 'one number'}"
