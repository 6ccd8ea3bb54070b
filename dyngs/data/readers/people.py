"""What captures of people have beside pictures: body parameters per frame and silhouettes, and arrays in files.

Local letters: F frames, J joints, B shape coefficients. The bodies are those of SMPL (Loper et al. 2015) and its heirs.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Sequence
from dataclasses import dataclass, replace
from importlib import import_module
from pathlib import Path
from types import EllipsisType
from typing import Any, Literal

import numpy as np
import torch
from scipy.spatial.transform import Rotation
from torch import Tensor

from dyngs.data.capture import Split, View
from dyngs.data.pictures.images import read_picture
from dyngs.errors import DyngsError, reading
from dyngs.files.archives import read_arrays
from dyngs.files.trust import check_size, inside

BodyKind = Literal["smpl", "smplh", "smplx"]

MASKS = "masks"
"""Name of the data set of silhouettes in an HDF5 file."""

_KINDS: dict[int, BodyKind] = {24: "smpl", 52: "smplh", 55: "smplx"}


@dataclass(frozen=True)
class BodyFrames:
    """Body parameters of the frames of one clip, float64, in the world and the unit of the cameras of that clip.

    A point x of the shaped template at rest comes to ``scale * turn(LBS(x; poses)) + trans``. LBS turns everything by
    ``poses[:, 0]`` about the pelvis (joint 0), ``turn`` about the template's origin; ``about_pelvis`` does without.

    Attributes:
        frames: (F,) numbers, ascending, as in ``View.frame`` of the views of the same clip.
        poses: (F, J, 3) axis-angle, radians, J = 24, 52 or 55.
        trans: (F, 3).
        betas: (B,) shape coefficients.
        scale: (F,) world units per metre of the template, positive.
        turns: (F, 3) axis-angle, radians; None where there is nothing to turn.
        pelvis: (3,) where the pelvis of the body that was fitted is at rest, None where the files do not say.
    """

    frames: tuple[int, ...]
    poses: np.ndarray
    trans: np.ndarray
    betas: np.ndarray
    scale: np.ndarray
    turns: np.ndarray | None = None
    pelvis: np.ndarray | None = None

    @property
    def kind(self) -> BodyKind:
        """The model whose joints these are."""
        return _KINDS[self.poses.shape[1]]


@dataclass(frozen=True)
class Silhouette:
    """Where a person is in a picture.

    Attributes:
        path: a picture of the same size, or an HDF5 file whose data set ``masks`` has a row (H, W) per frame.
        person: how the person's pixels are marked: "white" (grey levels count as shares), "black" (as "white",
            inverted), or "nonzero" (labels: everything but 0).
        row: of the data set, None for a picture.
    """

    path: Path
    person: Literal["white", "black", "nonzero"]
    row: int | None = None


@dataclass(frozen=True)
class PersonView(View):
    """A view of a person in front of other things, which are not to be learned: ``silhouette`` becomes its alpha."""

    silhouette: Silhouette | None = None


def person_view(view: View, silhouette: Silhouette | None) -> PersonView:
    """The view with a silhouette."""
    return PersonView(**{**vars(view), "silhouette": silhouette})


def cut_out(pixels: Tensor, silhouette: Silhouette) -> Tensor:
    """(H, W, 4) uint8 straight-alpha picture of the person alone, from a picture (H, W, 3 or 4) uint8.

    Raises:
        DyngsError: the silhouette is missing, damaged or of another size.
    """
    alpha = _levels(silhouette)
    if alpha.shape != pixels.shape[:2]:
        raise DyngsError(
            f"{silhouette.path}: the mask is {alpha.shape[1]}x{alpha.shape[0]} but its picture is {pixels.shape[1]}x"
            f"{pixels.shape[0]}; make them the same size"
        )
    if pixels.shape[-1] == 4:
        alpha = (alpha.float() * pixels[..., 3].float() / 255).round().to(torch.uint8)
    return torch.cat([pixels[..., :3], alpha[..., None]], dim=-1)


def body_frames(
    where: Path,
    frames: Sequence[int],
    poses: object,
    trans: object,
    betas: object,
    scale: object = 1.0,
    turns: object = None,
    pelvis: object = None,
) -> BodyFrames:
    """Checked body parameters, sorted by frame; one row per frame in whatever shape the file has them.

    Args:
        where: the file, for messages.
        frames: F distinct numbers.
        poses: F rows of 72, 156 or 165 numbers.
        trans: F rows of 3.
        betas: (B,), or one such row per frame: then their mean counts.
        scale: one number, or one per frame.
        turns: F rows of 3, or None.
        pelvis: (3,) or None.

    Raises:
        DyngsError: counts that differ, another width, NaN, a scale that is not positive, a frame twice.
    """
    order = np.argsort(np.asarray(frames, dtype=np.int64), kind="stable")
    numbers = tuple(int(frames[i]) for i in order)
    if not numbers:
        raise DyngsError(f"{where}: holds no frame; export the body parameters again")
    if len(set(numbers)) < len(numbers):
        twice = numbers[int(np.argmin(np.diff(numbers)))]
        raise DyngsError(f"{where}: frame {twice} has body parameters twice; remove one of them")
    rows = _rows(where, "poses", poses, frames)
    if rows.shape[1] // 3 not in _KINDS or rows.shape[1] % 3:
        wanted = ", ".join(f"{3 * joints} ({kind})" for joints, kind in _KINDS.items())
        raise DyngsError(f"{where}: 'poses' has {rows.shape[1]} numbers per frame; the known bodies have {wanted}")
    scale = np.asarray(scale)
    scales = _rows(where, "scale", np.full(len(frames), scale.item()) if scale.size == 1 else scale, frames, 1)
    if not (scales > 0).all():
        raise DyngsError(f"{where}: 'scale' must be positive; export the file again")
    return BodyFrames(
        frames=numbers,
        poses=rows[order].reshape(len(rows), -1, 3),
        trans=_rows(where, "trans", trans, frames, 3)[order],
        betas=_mean_row(where, "betas", betas, frames),
        scale=scales[order, 0],
        turns=None if turns is None else _rows(where, "turns", turns, frames, 3)[order],
        pelvis=None if pelvis is None else numbers_of(f"{where}: 'pelvis'", pelvis, (3,)),
    )


def about_pelvis(body: BodyFrames, pelvis: np.ndarray) -> BodyFrames:
    """The same bodies without ``turns``, for a template whose pelvis (joint 0, shaped, at rest) is at ``pelvis`` (3,).

    The pelvis stays where it is in the world: at ``scale * turn(j) + trans`` with j that of the fitted body where the
    files say it, else ``pelvis``. Hence the root turns by ``turn * poses[:, 0]``, and
    ``trans' = trans + scale * (turn(j) - pelvis)``.
    """
    fitted = pelvis if body.pelvis is None else body.pelvis
    poses, turned = body.poses, fitted
    if body.turns is not None:
        turns = Rotation.from_rotvec(body.turns)
        turned = turns.apply(fitted)
        roots = (turns * Rotation.from_rotvec(poses[:, 0])).as_rotvec()
        poses = np.concatenate([roots[:, None], poses[:, 1:]], axis=1)
    trans = body.trans + body.scale[:, None] * (turned - pelvis)
    return replace(body, poses=poses, trans=trans, turns=None, pelvis=np.asarray(pelvis, dtype=np.float64))


def moved(body: BodyFrames, offset: np.ndarray) -> BodyFrames:
    """The bodies with ``offset`` (3,) subtracted from all positions, as ``dyngs.data.rebase.shifted`` moves cameras."""
    return replace(body, trans=body.trans - offset)


def rows_of(where: Path, body: BodyFrames, views: Sequence[View]) -> np.ndarray:
    """(V,) row of ``body`` for each view, by frame number.

    Args:
        where: the file of the body parameters, for messages.

    Raises:
        DyngsError: a view without a frame number, or whose frame has no parameters.
    """
    rows = {number: row for row, number in enumerate(body.frames)}
    found = []
    for view in views:
        if view.frame is None:
            raise DyngsError(f"{where}: {view.image_path} has no frame number; give each picture its 'frame'")
        found.append(rows.get(view.frame, -1))
    lacking = sorted({view.frame for view, row in zip(views, found, strict=True) if row < 0 and view.frame is not None})
    if lacking:
        raise DyngsError(
            f"{where}: no body parameters for {len(lacking)} frames that have pictures ({some(lacking)}); the file has "
            f"{len(rows)} frames from {body.frames[0]} to {body.frames[-1]}; add them or remove the pictures"
        )
    return np.array(found, dtype=np.int64)


def of_one_clip(body: BodyFrames) -> dict[Split, BodyFrames]:
    """What ``Capture.body`` is where all splits show one clip."""
    return {"train": body, "val": body, "test": body}


def some(items: Collection[object]) -> str:
    """The first few, for messages."""
    return ", ".join(str(item) for item in list(items)[:5]) + (f" and {len(items) - 5} more" if len(items) > 5 else "")


def entry(where: object, fields: object, key: str) -> Any:
    """``fields[key]`` of a dictionary out of a file.

    Raises:
        DyngsError: it is no dictionary or lacks the key; ``where`` says which file.
    """
    if not isinstance(fields, dict):
        raise DyngsError(f"{where}: must be a dictionary with the key '{key}'; export it again")
    if key not in fields:
        raise DyngsError(f"{where}: the key '{key}' is missing; export it again")
    return fields[key]


def numbers_of(where: object, value: object, shape: tuple[int, ...] | None) -> np.ndarray:
    """The finite float64 numbers of ``value`` in ``shape``, or flat where that is None; a file may have another shape.

    Raises:
        DyngsError: other things, or another count; ``where`` says which file.
    """
    array = _float_array(value)
    fits = array is not None and (shape is None or array.size == math.prod(shape))
    if array is None or not fits or not np.isfinite(array).all():
        count = "x".join(map(str, shape)) + " " if shape else ""
        raise DyngsError(f"{where} must hold {count}finite numbers; export it again")
    return array.ravel() if shape is None else array.reshape(shape)


def read_npz(path: Path, keys: Collection[str], optional: Collection[str] = ()) -> dict[str, np.ndarray]:
    """The arrays of a ``.npz`` file: ``keys``, and of ``optional`` what is there; Python objects are refused.

    Raises:
        DyngsError: the file is missing or damaged, holds objects there, lacks a key, or asks for too much memory.
    """
    if not inside(path).is_file():
        raise DyngsError(f"{path}: no such file; it should hold the body parameters {', '.join(keys)}")
    found = read_arrays(path, lambda names: [name for name in (*keys, *optional) if name in names])
    for key in keys:
        entry(path, found, key)
    return found


def read_hdf5(path: Path, key: str, rows: int | EllipsisType = ...) -> np.ndarray:
    """The data set ``key`` of an HDF5 file, or one row of it.

    Raises:
        DyngsError: h5py is not installed; the file is missing or damaged, or lacks the data set or the row.
    """
    return np.asarray(_hdf5(path, key, rows))


def hdf5_length(path: Path, key: str) -> int:
    """Number of rows of the data set ``key``. Raises as ``read_hdf5``."""
    return int(_hdf5(path, key, None)[0])


def _levels(silhouette: Silhouette) -> Tensor:
    """(H, W) uint8, 255 where the person is."""
    if silhouette.row is None:
        levels = read_picture(silhouette.path)[..., :3]
        levels = levels.amax(-1) if silhouette.person == "nonzero" else levels.float().mean(-1).round().to(torch.uint8)
    else:
        row = read_hdf5(silhouette.path, MASKS, silhouette.row)
        if row.ndim != 2 or row.dtype not in (np.uint8, np.bool_):
            raise DyngsError(f"{silhouette.path}: '{MASKS}' must hold bytes in the shape (F, H, W); export it again")
        levels = torch.from_numpy(row.astype(np.uint8))
    if silhouette.person == "nonzero":
        return (levels > 0).to(torch.uint8) * 255
    return 255 - levels if silhouette.person == "black" else levels


def _float_array(value: object) -> np.ndarray | None:
    """float64, None where these are no numbers."""
    try:
        array = np.asarray(value) if _is_numeric(value) else None
        return array.astype(np.float64) if array is not None and array.dtype.kind in "biuf" else None
    except (TypeError, ValueError, OverflowError):
        return None


def _is_numeric(value: object) -> bool:
    """Whether there are but numbers in it: NumPy would make every text among them as long as the longest."""
    if isinstance(value, (list, tuple)):
        return all(_is_numeric(part) for part in value)
    if isinstance(value, np.ndarray):
        return value.dtype.kind in "biuf"
    return isinstance(value, (int, float, np.generic)) and not isinstance(value, (str, bytes))


def _rows(where: Path, name: str, value: object, frames: Sequence[int], width: int = 0) -> np.ndarray:
    """(F, width) finite float64, any width where that is 0."""
    array = _float_array(value)
    if array is None:
        raise DyngsError(f"{where}: '{name}' must hold as many numbers for each frame; export the file again")
    if not array.ndim or len(array) != len(frames):
        count = len(array) if array.ndim else 1
        raise DyngsError(f"{where}: '{name}' has {count} rows for {len(frames)} frames; export the file again")
    array = array.reshape(len(frames), -1)
    if width and array.shape[1] != width:
        raise DyngsError(
            f"{where}: '{name}' has {array.shape[1]} numbers per frame instead of {width}; export it again"
        )
    bad = ~np.isfinite(array).all(axis=1)
    if bad.any():
        frame = frames[int(np.argmax(bad))]
        raise DyngsError(f"{where}: '{name}' of frame {frame} holds NaN or infinite numbers; repair or remove it")
    return array


def _mean_row(where: Path, name: str, value: object, frames: Sequence[int]) -> np.ndarray:
    """(width,) from one row, or the mean of one per frame."""
    array = _float_array(value)
    if array is not None and array.ndim == 1:
        array = array[None]
    if array is not None and array.ndim > 1 and len(array) == 1:
        return numbers_of(f"{where}: '{name}'", array, None)
    return _rows(where, name, value, frames).mean(axis=0)


def _hdf5(path: Path, key: str, rows: int | EllipsisType | None) -> Any:
    """Rows of a data set; its shape where ``rows`` is None."""
    try:
        h5py = import_module("h5py")
    except ImportError:
        raise DyngsError(f"{path}: HDF5 files need the package h5py; run pip install 'dyngs[people]'") from None
    if not inside(path).is_file():
        raise DyngsError(f"{path}: no such file; restore it")
    advice = f"'{key}' must be a data set in an HDF5 file; copy the file again"
    with reading(path, advice), h5py.File(path, "r") as file:
        # A link inside the file may lead to another file.
        found: Any = file.get(key) if isinstance(file.get(key, getlink=True), h5py.HardLink) else None
        if not isinstance(found, h5py.Dataset) or not found.shape or found.external or found.is_virtual:
            raise DyngsError(f"{path}: the data set '{key}' is missing; export it again")
        if rows is None:
            return found.shape
        if found.dtype.kind not in "biuf":
            raise DyngsError(f"{path}: '{key}' must hold numbers; export it again")
        shape = found.shape if isinstance(rows, EllipsisType) else found.shape[1:]
        check_size(path, max(math.prod(shape), math.prod(found.chunks or ())), max(1, found.dtype.itemsize // 4))
        return found[rows]
