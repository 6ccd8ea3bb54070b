"""Readers of transforms files: Blender (NeRF-synthetic, D-NeRF), nerfstudio and instant-ngp, people
with body files."""

from __future__ import annotations

import os
from dataclasses import replace
from pathlib import Path

from dyngs.core.errors import DyngsError
from dyngs.data.body_frames import read_body_file, rows_of
from dyngs.data.capture import (
    BodyFrames,
    Capture,
    CaptureFormat,
    Split,
    Splits,
    View,
    all_views,
    each_view,
)
from dyngs.data.readers.colmap import find_masks, mask_of, unmasked_warning
from dyngs.data.readers.transforms import (
    SPLITS,
    FrameFile,
    find_points,
    read_frame_file,
    read_views,
    tracks_path_of,
)


def read_blender(root: Path) -> Capture:
    """Read ``transforms_{train,val,test}.json`` with OpenGL camera-to-world poses; val and test are
    optional.

    Intrinsics: ``camera_angle_x``, or ``w, h, fl_x, fl_y, cx, cy`` of the file or the frame.
    Points: see ``find_points``. Masks: ``mask_path`` of the frames, else those in ``masks/`` that
    are named as images.
    """
    splits: Splits = {}
    warnings: list[str] = []
    train = read_frame_file(root / "transforms_train.json")
    for name in SPLITS:
        path = root / f"transforms_{name}.json"
        if name != "train" and not path.is_file():
            continue
        views, notes = read_views(train if name == "train" else read_frame_file(path))
        splits[name] = tuple(views.values())
        warnings += [f"{path.name}: {note}" for note in notes]
        if not views:
            warnings.append(f"{path.name}: lists no frames")
    splits, notes = _with_masks(root, splits)
    return _capture_of(root, "blender", train, splits, [*warnings, *notes])


def _with_masks(root: Path, splits: Splits) -> tuple[Splits, list[str]]:
    """Return the views with masks of ``masks/`` where the files name none, and a line about views
    without one."""
    views = all_views(splits)
    has_people = any(view.silhouette for view in views) or any(root.glob("body_*.npz"))
    if has_people or any(view.mask_path for view in views):
        return splits, []
    masks = find_masks(root / "masks")
    images = root / "images"

    def with_mask(view: View) -> View:
        found = (
            mask_of(os.path.relpath(view.image_path, folder), masks) for folder in (images, root)
        )
        return replace(view, mask_path=next(filter(None, found), None))

    splits = each_view(splits, with_mask)
    return splits, unmasked_warning(all_views(splits), bool(masks))


def _capture_of(
    root: Path, format: str, file: FrameFile, splits: Splits, warnings: list[str]
) -> Capture:
    points, path, notes = find_points(file)
    tracks = tracks_path_of(file)
    lines = (*warnings, *notes)
    return Capture(
        root, format, splits, points, path, fps=file.fps, tracks_path=tracks, warnings=lines
    )


def training_capture(root: Path, format: str, file: FrameFile, *more: str) -> Capture:
    """Return the capture of a file whose frames are all for training, with ``more`` warnings."""
    views, warnings = read_views(file)
    return _capture_of(root, format, file, {"train": tuple(views.values())}, [*warnings, *more])


FORMAT = CaptureFormat(
    "blender",
    "transforms_train.json",
    lambda root: (root / "transforms_train.json").is_file(),
    read_blender,
)


def read_nerfstudio(root: Path) -> Capture:
    """Read ``transforms.json`` with OpenGL camera-to-world poses and, if there, a ``.ply`` file of
    points.

    The lists ``train_filenames``, ``val_filenames`` and ``test_filenames`` decide the splits; a val
    list without a test list is used for testing. Points and poses are read as they stand:
    ``applied_transform`` has been applied to both.
    """
    file = read_frame_file(root / "transforms.json")
    views, warnings = read_views(file)
    splits, notes = _nerfstudio_splits(file, views)
    splits, more = _with_masks(root, splits)
    return _capture_of(root, "nerfstudio", file, splits, [*warnings, *notes, *more])


def _nerfstudio_splits(file: FrameFile, views: dict[str, View]) -> tuple[Splits, list[str]]:
    """Splits by the lists in the file, all views for training where it has none; and warnings."""
    listed = {name: file.fields.get(f"{name}_filenames") for name in SPLITS}
    if all(value is None for value in listed.values()):
        return {"train": tuple(views.values())}, []
    splits: Splits = {}
    unknown: list[str] = []
    for name in SPLITS:
        value = listed[name]
        if value is None:
            continue
        if not isinstance(value, list) or not all(isinstance(item, str) for item in value):
            raise DyngsError(f"{file.path}: '{name}_filenames' must be a list of file paths")
        splits[name] = tuple(views[item] for item in dict.fromkeys(value) if item in views)
        unknown += [item for item in value if item not in views]
    held_out = {view.name for kept in splits.values() for view in kept}
    splits.setdefault("train", tuple(view for view in views.values() if view.name not in held_out))
    if "test" not in splits and "val" in splits:
        splits["test"] = splits.pop("val")
    used = {view.name for kept in splits.values() for view in kept}
    notes = [f"{len(unknown)} listed images have no frame, first {unknown[0]}"] if unknown else []
    if len(used) < len(views):
        notes.append(f"{len(views) - len(used)} frames are in no split and are ignored")
    return splits, notes


NERFSTUDIO_FORMAT = CaptureFormat(
    "nerfstudio",
    "transforms.json",
    lambda root: (root / "transforms.json").is_file(),
    read_nerfstudio,
)


def read_body_json(root: Path) -> Capture:
    """Read ``transforms_{train,val,test,pose}.json`` with body parameters; all but the first file
    are optional.

    Each split has the parameters of its ``body_SPLIT.npz``: poses (T, 72, 156 or 165), trans (T,
    3), betas and, if there, scale; row n is for the frame whose ``frame`` is n. Without such a
    file, val and test show the frames of train. ``surface_model_type`` "anny" says that betas are
    of the free template's shape space. ``pose`` is another clip, with frame numbers, times and
    parameters of its own. Parameters and cameras share one world; unlike with AMASS files nothing
    is rotated to make it y up.
    """
    capture = read_blender(root)  # whose points are of no use: people begin on a template
    splits = dict(capture.splits)
    warnings = capture.warnings
    path = root / "transforms_pose.json"
    if path.is_file():
        views, notes = read_views(read_frame_file(path))
        splits["pose"] = tuple(views.values())
        warnings = (*warnings, *(f"{path.name}: {note}" for note in notes))
    train = read_body_file(root / "body_train.npz")
    body: dict[Split, BodyFrames] = {
        name: _body_of(root, name, views, train) for name, views in splits.items()
    }
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
    if not path.is_file() and split == "pose":
        raise DyngsError(
            f"{path}: no such file; transforms_pose.json shows another clip, which needs its own parameters"
        )
    body = read_body_file(path) if path.is_file() and split != "train" else train
    rows_of(path if path.is_file() else root / "body_train.npz", body, views)
    return body


BODY_FORMAT = CaptureFormat(
    "body_json",
    "transforms_train.json and body_train.npz",
    lambda root: (root / "transforms_train.json").is_file() and any(root.glob("body_*.npz")),
    read_body_json,
    extends="blender",
)
