"""Reader for Blender captures of a person with body parameters: ``transforms_*.json`` and ``body_*.npz``."""

from __future__ import annotations

from pathlib import Path
from typing import cast

from dyngs.data.body_frames import rows_of
from dyngs.data.capture import BodyFrames, Capture, Split, View
from dyngs.data.fitted_body import read_body_file
from dyngs.data.readers.blender import read_blender
from dyngs.data.readers.shared.capture_format import CaptureFormat
from dyngs.data.readers.shared.transforms import read_frame_file, read_views
from dyngs.errors import DyngsError, reading

_TRAIN = "body_train.npz"
_NEW_POSES = cast(Split, "pose")


def is_body_json(root: Path) -> bool:
    """Whether the folder holds ``transforms_train.json`` and some ``body_*.npz``."""
    return (root / "transforms_train.json").is_file() and any(root.glob("body_*.npz"))


def read_body_json(root: Path) -> Capture:
    """Read ``transforms_{train,val,test,pose}.json`` with body parameters; all but the first file are optional.

    Each split has the parameters of its ``body_SPLIT.npz``: poses (T, 72, 156 or 165), trans (T, 3), betas and, if
    there, scale; row n is for the frame whose ``frame`` is n. Without such a file, val and test show the frames of
    train. ``surface_model_type`` "anny" says that betas are of the free template's shape space.
    ``pose`` is another clip, with frame numbers, times and parameters of its own. Parameters and cameras share
    one world; unlike with AMASS files nothing is rotated to make it y up.

    Raises:
        DyngsError: missing or bad parameters, and see ``dyngs.data.readers.shared.transforms.read_views``.
    """
    with reading(root):
        return _read(root)


def _read(root: Path) -> Capture:
    capture = read_blender(root)  # whose points are of no use: people begin on a template
    splits, warnings = dict(capture.splits), capture.warnings
    path = root / "transforms_pose.json"
    if path.is_file():
        views, notes = read_views(read_frame_file(path))
        splits[_NEW_POSES] = tuple(views.values())
        warnings = (*warnings, *(f"{path.name}: {note}" for note in notes))
    train = read_body_file(root / _TRAIN)
    body: dict[Split, BodyFrames] = {name: _body_of(root, name, views, train) for name, views in splits.items()}
    return capture.replace(
        format="body_json",
        splits=splits,
        points=None,
        points_file=None,
        body={"val": train, "test": train, **body},
        warnings=warnings,
    )


def _body_of(root: Path, split: Split, views: tuple[View, ...], train: BodyFrames) -> BodyFrames:
    path = root / f"body_{split}.npz"
    if not path.is_file() and split == _NEW_POSES:
        raise DyngsError(
            f"{path}: no such file; transforms_pose.json shows another clip, which needs its own parameters"
        )
    body = read_body_file(path) if path.is_file() and split != "train" else train
    rows_of(path if path.is_file() else root / _TRAIN, body, views)
    return body


FORMAT = CaptureFormat(
    "body_json", "transforms_train.json and body_train.npz", is_body_json, read_body_json, extends="blender"
)
