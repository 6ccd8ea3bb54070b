"""Body parameters per frame: validation, coordinate transforms, and files of fitted parameters.

Local letters: F frames, J joints, B shape coefficients. Body models are SMPL (Loper et al. 2015),
SMPL-H and SMPL-X.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path, PurePosixPath

import numpy as np

from dyngs.core.errors import DyngsError, wrap_read_errors
from dyngs.data.capture import (
    BODY_KINDS,
    BodyFrames,
    Capture,
    Split,
    Splits,
    View,
    all_views,
    map_views,
)
from dyngs.io.containment import restrict_paths_to
from dyngs.io.fields import LARGEST, as_float_array, first_few, parse_numbers
from dyngs.io.numpy_files import read_npz


def build_body_frames(
    where: Path,
    frames: Sequence[int],
    poses: object,
    trans: object,
    betas: object,
    scale: object = 1.0,
    origin_rotations: object = None,
) -> BodyFrames:
    """Validate body parameters and return them sorted by frame number.

    Arrays may have any shape with one row per frame. Raises DyngsError on mismatching counts or
    widths, non-finite values, non-positive scales and duplicate frames.

    Args:
        where: file for error messages.
        frames: F distinct frame numbers.
        poses: F rows of 72, 156 or 165 numbers: axis-angles of the joints, rad.
        trans, origin_rotations: F rows of 3 numbers.
        betas: (B,), or F rows of B, which are averaged.
        scale: factor from body units to world units: one number, or one per frame.
        origin_rotations: axis-angles about the origin, applied after posing (``Rh`` of ZJU-MoCap).
    """
    order = np.argsort(np.asarray(frames, dtype=np.int64), kind="stable")
    numbers = tuple(int(frames[i]) for i in order)
    if not numbers:
        raise DyngsError(f"{where}: no frames found; export the body parameters again")
    if len(set(numbers)) < len(numbers):
        twice = numbers[int(np.argmin(np.diff(numbers)))]
        raise DyngsError(
            f"{where}: frame {twice} has two sets of body parameters; remove one of them"
        )
    rows = _rows(where, "poses", poses, frames)
    if rows.shape[1] // 3 not in BODY_KINDS or rows.shape[1] % 3:
        wanted = ", ".join(f"{3 * joints} ({kind})" for joints, kind in BODY_KINDS.items())
        raise DyngsError(
            f"{where}: 'poses' has {rows.shape[1]} numbers per frame; supported bodies: {wanted}"
        )
    scale = np.asarray(scale)
    scale = np.full(len(frames), scale.item()) if scale.size == 1 else scale
    scales = _rows(where, "scale", scale, frames, 1)
    if not (scales > 0).all():
        raise DyngsError(f"{where}: 'scale' must be positive; export the file again")
    shape = as_float_array(betas)
    if shape is not None and (shape.ndim == 1 or len(shape) == 1):
        shape = parse_numbers(f"{where}: 'betas'", shape, None)
    else:
        shape = _rows(where, "betas", betas, frames).mean(axis=0)
    return BodyFrames(
        frames=numbers,
        poses=rows[order].reshape(len(rows), -1, 3),
        trans=_rows(where, "trans", trans, frames, 3)[order],
        betas=shape,
        scale=scales[order, 0],
        origin_rotations=None
        if origin_rotations is None
        else _rows(where, "origin_rotations", origin_rotations, frames, 3)[order],
    )


def merge_root_rotation(body: BodyFrames, pelvis: np.ndarray) -> BodyFrames:
    """Merge ``origin_rotations`` into the rotation of the root joint.

    The pelvis keeps its world position ``scale * R j + trans``, where R is the origin rotation and
    j the rest position of the pelvis of the fitted body (of the given ``pelvis`` (3,) if the files
    do not store it). Hence ``root' = R root`` and ``trans' = trans + scale * (R j - pelvis)``.
    """
    fitted_pelvis = pelvis if body.pelvis is None else body.pelvis
    poses = body.poses
    rotated_pelvis = fitted_pelvis
    if body.origin_rotations is not None:
        from scipy.spatial.transform import Rotation  # late: importing it takes a tenth of a second

        turns = Rotation.from_rotvec(body.origin_rotations)
        rotated_pelvis = turns.apply(fitted_pelvis)
        roots = (turns * Rotation.from_rotvec(poses[:, 0])).as_rotvec()
        poses = np.concatenate([roots[:, None], poses[:, 1:]], axis=1)
    trans = body.trans + body.scale[:, None] * (rotated_pelvis - pelvis)
    return replace(
        body,
        poses=poses,
        trans=trans,
        origin_rotations=None,
        pelvis=np.asarray(pelvis, dtype=np.float64),
    )


def transform_body(body: BodyFrames, shift: np.ndarray, factor: float) -> BodyFrames:
    """Apply ``x -> factor * (x - shift)``, with ``shift`` (3,), to the world coordinates of the
    body."""
    return replace(body, trans=factor * (body.trans - shift), scale=factor * body.scale)


def match_frames(where: Path, body: BodyFrames, views: Sequence[View]) -> np.ndarray:
    """Return the row of ``body`` for each of the V views, (V,) int64.

    Raises DyngsError if a view has no frame number or its frame has no body parameters.
    """
    rows = {number: row for row, number in enumerate(body.frames)}
    unnumbered = next((view.image_path for view in views if view.frame is None), None)
    if unnumbered is not None:
        raise DyngsError(f"{where}: {unnumbered} has no frame number; give each image its 'frame'")
    lacking = sorted({frame_number(view) for view in views} - rows.keys())
    if lacking:
        raise DyngsError(
            f"{where}: no body parameters for {len(lacking)} frames that have images "
            f"({first_few(lacking)}); the file has {len(rows)} frames from {body.frames[0]} to "
            f"{body.frames[-1]}; add them or remove the images"
        )
    return np.array([rows[frame_number(view)] for view in views], dtype=np.int64)


def share_body_across_splits(body: BodyFrames) -> dict[Split, BodyFrames]:
    """Return ``Capture.body`` for a capture whose splits all show the same clip."""
    return {"train": body, "val": body, "test": body}


def _rows(
    where: Path, name: str, value: object, frames: Sequence[int], width: int | None = None
) -> np.ndarray:
    """Return the values as (F, width) float64. ``width``: None accepts any.

    Raises DyngsError: another shape, or NaN, infinite or huge values (above ``LARGEST``).
    """
    array = as_float_array(value)
    if array is None or array.shape[:1] != (len(frames),):
        raise DyngsError(
            f"{where}: '{name}' must have one row of numbers for each of {len(frames)} frames; "
            "export the file again"
        )
    array = array.reshape(len(frames), -1)
    if width not in (None, array.shape[1]):
        raise DyngsError(
            f"{where}: '{name}' has {array.shape[1]} numbers per frame instead of {width}; "
            "export it again"
        )
    bad = ~(np.abs(array) <= LARGEST).all(axis=1)
    if bad.any():
        raise DyngsError(
            f"{where}: '{name}' of frame {frames[int(np.argmax(bad))]} contains NaN, infinite or "
            "huge values; repair or remove it"
        )
    return array


def read_body_file(path: Path) -> BodyFrames:
    """Read body parameters from an .npz.

    Arrays: ``poses`` (F, 72, 156 or 165), ``trans`` (F, 3), ``betas`` and optionally ``scale`` and
    ``frames`` (F,). Without ``frames``, row n belongs to frame n. If ``surface_model_type`` is
    "anny", ``betas`` are shape coefficients of the free template. ``fitted_to`` identifies the
    template that dyngs fitted.
    """
    found = read_npz(
        path, ("poses", "trans", "betas"), ("scale", "surface_model_type", "frames", "fitted_to")
    )
    count = len(found["poses"]) if found["poses"].ndim else 0
    numbers = found.get("frames", np.arange(count))
    if numbers.ndim != 1 or numbers.dtype.kind not in "iu" or len(numbers) != count:
        raise DyngsError(
            f"{path}: 'frames' must hold one whole number for each row of 'poses'; export it again"
        )
    frames = [int(number) for number in numbers]
    body = build_body_frames(
        path, frames, found["poses"], found["trans"], found["betas"], found.get("scale", 1.0)
    )
    if str(found.get("surface_model_type")) == "anny":
        return replace(body, shape_space="anny")
    return replace(body, fitted_to=str(found.get("fitted_to", "")))


def attach_fitted_body(capture: Capture, folder: Path) -> Capture:
    """Return the capture with the body parameters in ``folder``.

    These are ``body_train.npz`` and, for the split ``pose``, ``body_pose.npz``. Without the latter,
    the split ``pose`` is dropped.
    """
    if not (folder / "body_train.npz").is_file():
        raise DyngsError(
            f"{folder / 'body_train.npz'}: no such file (data.body); to reuse a fit by `dyngs "
            f"train human`, train with data.root={capture.root} and another run.dir"
        )
    with (
        restrict_paths_to(folder, False),
        wrap_read_errors(folder, "give a folder that `dyngs data fit` wrote"),
    ):
        train = read_body_file(folder / "body_train.npz")
        body: dict[Split, BodyFrames] = {"train": train, "val": train, "test": train}
        if (folder / "body_pose.npz").is_file():
            body["pose"] = read_body_file(folder / "body_pose.npz")
    splits = assign_frame_numbers(capture.splits)
    if "pose" in splits and "pose" not in body:
        splits = {name: views for name, views in splits.items() if name != "pose"}
    return capture.replace(splits=splits, body=body)


def parse_frame_number(where: Path, name: str) -> int:
    """Return the frame number in an image name.

    Accepts ``000123.jpg``, ``frame_000123`` and ``Camera (1)_0123_2019-08-23_16.592.jpg``.
    """
    stem = PurePosixPath(name.replace("\\", "/")).name
    # The number follows "Camera (1)_" in some captures of ZJU-MoCap, else it ends the name.
    found = re.search(r"\)_(\d{1,15})(?!\d)", stem) or re.search(
        r"(?<!\d)(\d{1,15})(?:\.\w+)?$", stem
    )
    if not found:
        raise DyngsError(
            f"{where}: no frame number in the name {name!r:.80}; rename the image, for example "
            "to 000000.jpg"
        )
    return int(found[1])


def frame_number(view: View) -> int:
    """Return the frame number of a view, -1 if it has none."""
    return -1 if view.frame is None else view.frame


def assign_frame_numbers(splits: Splits) -> Splits:
    """Return views with frame numbers; if any is missing, all are numbered in order of time."""
    views = all_views(splits)
    if all(view.frame is not None for view in views):
        return splits
    order = {time: i for i, time in enumerate(sorted({view.time or 0.0 for view in views}))}
    return map_views(splits, lambda view: replace(view, frame=order[view.time or 0.0]))
