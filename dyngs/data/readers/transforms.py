"""Readers of transforms files (Blender, nerfstudio, instant-ngp), bodies next to them, and .ply
points."""

from __future__ import annotations

import math
import os
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import pairwise
from pathlib import Path, PurePosixPath
from typing import Any

import numpy as np

from dyngs.core.errors import DyngsError, wrap_read_errors
from dyngs.data.body_frames import match_frames, read_body_file
from dyngs.data.capture import (
    BodyFrames,
    Capture,
    CaptureFormat,
    Lens,
    PointCloud,
    Silhouette,
    Split,
    Splits,
    VideoFrame,
    View,
    all_views,
    map_views,
)
from dyngs.data.geometry import (
    MAX_SIDE,
    from_opengl_pose,
    match_intrinsics_to_image,
    pinhole_matrix,
    repair_warning,
    rescale_warning,
    validate_pose,
)
from dyngs.data.images.images import SUFFIXES, ImageHeader, read_header, try_read_header
from dyngs.io.containment import check_inside
from dyngs.io.fields import is_number, parse_matrix, read_json_object
from dyngs.io.find import FileFinder, normalize_name

GREY = 128
_NAMES = (
    ("red", "green", "blue"),
    ("diffuse_red", "diffuse_green", "diffuse_blue"),
    ("r", "g", "b"),
)


def point_colours(columns: Mapping[str, np.ndarray], count: int) -> np.ndarray:
    """Return (P, 3) uint8 colours of ``count`` points from ``columns`` by property name, else
    grey."""
    known = {
        name.lower(): np.ravel(column)
        for name, column in columns.items()
        if np.size(column) == count
    }
    for names in _NAMES:
        if known.keys() >= set(names):
            return _as_bytes(np.stack([known[name] for name in names], axis=1))
    return np.full((count, 3), GREY, np.uint8)


def _as_bytes(values: np.ndarray) -> np.ndarray:
    """Return colours as bytes; the value range is inferred from type and maximum."""
    if values.dtype == np.uint8:
        return values
    largest = values[np.isfinite(values)].max(initial=0)
    scale = 1.0
    if values.dtype.kind == "f" and largest <= 1:
        scale = 255.0
    elif largest > 255:
        scale = 1 / 257  # 16 bits
    scaled = np.nan_to_num(scale * values.astype(np.float64), nan=GREY)
    return np.clip(scaled + 0.5, 0, 255).astype(np.uint8)


SPLITS: tuple[Split, ...] = ("train", "val", "test")
MAX_FPS = 1e6
"""Higher frame rates are ignored as mistakes."""
_LARGEST = 1e300
_LARGEST_INTEGER = 2**53
_FOCAL_KEYS = ("fl_x", "fl_y", "camera_angle_x", "camera_angle_y")


@dataclass(frozen=True)
class FrameEntry:
    """One entry of ``frames``: its ``own`` fields, with those of the file (``shared``) as
    defaults.

    Attributes:
        where: file and index, for messages.
        image: the image, if ``file_path`` does not name it.
        video: the video frame of the image, if any, and ``stored``, its (width, height).
    """

    where: str
    own: dict[str, object]
    shared: Mapping[str, object] = field(default_factory=dict)
    image: Path | None = None
    video: VideoFrame | None = None
    stored: tuple[int, int] | None = None

    def number(self, key: str) -> float | None:
        """Return the finite number at ``key``, None if absent."""
        return _number(self.own.get(key, self.shared.get(key)), key, self.where)

    def integer(self, key: str) -> int | None:
        """Return the integer at ``key`` of this frame alone, None if absent or not an integer."""
        value = self.own.get(key)
        if not is_number(value):
            return None
        return int(value) if value % 1 == 0 and abs(value) < _LARGEST_INTEGER else None

    def text(self, key: str) -> str | None:
        """Return the string at ``key``, None if absent."""
        value = self.own.get(key, self.shared.get(key))
        if value is not None and not isinstance(value, str):
            raise DyngsError(f"{self.where}: '{key}' must be a string, got {value!r:.40}")
        return value


@dataclass(frozen=True)
class FrameFile:
    """A transforms file: its path, its frames, and all its fields."""

    path: Path
    frames: Sequence[FrameEntry]
    fields: Mapping[str, object] = field(default_factory=dict)

    @property
    def fps(self) -> float | None:
        """Frames per second stated in the file, else None."""
        fps = self.fields.get("fps")
        return float(fps) if is_number(fps) and 0 < fps < MAX_FPS else None


def read_frame_file(path: Path) -> FrameFile:
    """Read the fields and frames of a transforms file."""
    wrong = "the list 'frames' is missing; is this a transforms file?"
    fields = read_json_object(path, wrong)
    listed = fields.get("frames")
    if not isinstance(listed, list):
        raise DyngsError(f"{path}: {wrong}")
    frames = []
    for index, own in enumerate(listed):
        where = f"{path}, frame {index}"
        if not isinstance(own, dict):
            raise DyngsError(f"{where}: must be an object with file_path and transform_matrix")
        if isinstance(own.get("file_path"), str):
            where += f" ({own['file_path']:.200})"
        frames.append(FrameEntry(where, own, fields))
    return FrameFile(path, frames, fields)


def read_views(file: FrameFile) -> tuple[dict[str, View], list[str]]:
    """Return views by ``file_path``, in the order of the file, and warnings.

    Raises DyngsError for missing or invalid fields, invalid poses, inconsistent sizes and
    duplicate images.
    """
    root = file.path.parent
    files = FileFinder(root)
    paths = [_image_path(files, frame) for frame in file.frames]
    twice = [path for path, count in Counter(paths).items() if count > 1]
    if twice:
        raise DyngsError(
            f"{file.path}: {twice[0]} is listed more than once; remove the duplicate frames"
        )
    headers = [
        try_read_header(path) if frame.video is None else None
        for frame, path in zip(file.frames, paths, strict=True)
    ]
    # images without a size of their own share the focal length of the file
    sizes = (x.upright_size for x in headers if x is not None)
    common = next(sizes, None)
    repaired: dict[str, float] = {}
    rescaled: list[str] = []
    views = {}
    for frame, path, header in zip(file.frames, paths, headers, strict=True):
        view, repaired[frame.where], is_rescaled = _view(frame, files, path, header, common)
        rescaled += [frame.where] if is_rescaled else []
        views[str(frame.own["file_path"])] = view
    return _with_flow_targets(views), repair_warning(repaired) + rescale_warning(rescaled)


def find_tracks_file(file: FrameFile) -> Path | None:
    """Return the file of 2D tracks given by ``tracks_file_path``, else None."""
    frame = FrameEntry(str(file.path), {}, file.fields)
    return _named_file(FileFinder(file.path.parent), frame, "tracks_file_path")


def view_name(path: Path, root: Path) -> str:
    """Return a view name: the image path below ``root`` without extension, safe as a relative file
    name."""
    relative = PurePosixPath(os.path.relpath(path, root).replace(os.sep, "/")).with_suffix("")
    return "/".join(part for part in relative.parts if part not in ("..", "/"))


def _view(
    frame: FrameEntry,
    files: FileFinder,
    path: Path,
    header: ImageHeader | None,
    common: tuple[int, int] | None,
) -> tuple[View, float, bool]:
    """Return a view, the repair error of its rotation, and whether its intrinsics were
    rescaled."""
    described = _described_size(frame)
    stored = header.size_matching(described) if header else frame.stored
    described = described or stored or common
    if described is None:
        described = read_header(path).upright_size  # raises the error
    intrinsics, size, rescaled = match_intrinsics_to_image(
        _intrinsics(frame, *described), described, stored, frame.where
    )
    if frame.own.get("transform_matrix") is None:
        raise DyngsError(f"{frame.where}: the key 'transform_matrix' is missing")
    matrix = parse_matrix(frame.where, "transform_matrix", frame.own["transform_matrix"])
    pose, error = validate_pose(matrix, frame.where)
    motion_mask = _named_file(files, frame, "motion_mask_path")
    labels = _named_file(files, frame, "instance_mask_path")
    silhouette = _named_file(files, frame, "silhouette_path")
    camera = frame.integer("camera")
    view = View(
        name=view_name(path, files.root),
        image_path=path,
        cam_from_world=from_opengl_pose(pose),
        intrinsics=intrinsics,
        width=size[0],
        height=size[1],
        lens=_lens(frame),
        camera_id=(camera if camera is not None else frame.integer("camera_id")) or 0,
        mask_path=_named_file(files, frame, "mask_path"),
        time=_number(frame.own.get("time"), "time", frame.where),
        frame=frame.integer("frame"),
        video=frame.video,
        silhouette=None if silhouette is None else Silhouette(silhouette, "white"),
        depth_path=_named_file(files, frame, "depth_file_path"),
        motion_mask_path=motion_mask or labels,
        motion_mask_labels=motion_mask is None and labels is not None,
        flow_path=_named_file(files, frame, "flow_file_path"),
        exposure=header.exposure if header else None,
    )
    return view, error, rescaled


def _with_flow_targets(views: dict[str, View]) -> dict[str, View]:
    """Set ``flow_to`` of views with flow to the next view of the same camera."""
    if all(view.flow_path is None for view in views.values()):
        return views
    ordered = sorted(
        views.items(), key=lambda item: (item[1].camera_id, item[1].time or 0.0, item[1].name)
    )
    following = {
        key: after.name if after.camera_id == view.camera_id else None
        for (key, view), (_, after) in pairwise(ordered)
    }
    return {key: replace(view, flow_to=following.get(key)) for key, view in views.items()}


def _named_file(files: FileFinder, frame: FrameEntry, key: str) -> Path | None:
    written = frame.text(key)
    return _below(files, written, frame.where) if written else None


def _number(value: object, key: str, where: str) -> float | None:
    if value is None:
        return None
    if not is_number(value) or not abs(value) < _LARGEST:
        raise DyngsError(f"{where}: '{key}' must be a finite number, got {value!r:.40}")
    return float(value)


def _below(files: FileFinder, written: str, where: str) -> Path:
    path = files.find(written)
    if not path.name or path == Path(os.path.normpath(files.root)) or "\0" in written:
        raise DyngsError(
            f"{where}: {written!r:.80} is not a file path; give the path relative to the capture "
            "folder"
        )
    return path


def _image_path(files: FileFinder, frame: FrameEntry) -> Path:
    """Return the image file; without an extension the known ones are tried, PNG first."""
    if frame.image is not None:
        return frame.image
    written = frame.own.get("file_path")
    if not isinstance(written, str) or not written:
        raise DyngsError(f"{frame.where}: the key 'file_path' is missing")
    path = _below(files, written, frame.where)
    if path.suffix.lower() in SUFFIXES or path.is_file():
        return path
    candidates = [files.find(written + suffix) for suffix in SUFFIXES]
    return next((candidate for candidate in candidates if candidate.is_file()), candidates[0])


def _described_size(frame: FrameEntry) -> tuple[int, int] | None:
    width = frame.number("w")
    height = frame.number("h")
    if width is None or height is None:
        return None
    if not (1 <= width <= MAX_SIDE and 1 <= height <= MAX_SIDE):
        raise DyngsError(
            f"{frame.where}: w and h must be from 1 to {MAX_SIDE:,}, got {width:g} and {height:g}"
        )
    return round(width), round(height)


def _intrinsics(frame: FrameEntry, width: int, height: int) -> np.ndarray:
    source = frame.own if any(key in frame.own for key in _FOCAL_KEYS) else frame.shared
    focal_x = _focal(source, "x", width, frame.where)
    focal_y = _focal(source, "y", height, frame.where) or focal_x
    if focal_y is None:
        raise DyngsError(
            f"{frame.where}: focal length missing; add fl_x (px) or camera_angle_x (radians)"
        )
    cx = frame.number("cx")
    cy = frame.number("cy")
    return pinhole_matrix(
        focal_x or focal_y,
        focal_y,
        0.5 * width if cx is None else cx,
        0.5 * height if cy is None else cy,
    )


def _focal(source: Mapping[str, object], axis: str, size: int, where: str) -> float | None:
    focal = _number(source.get(f"fl_{axis}"), f"fl_{axis}", where)
    # An angle next to an fl_x for the other axis only repeats it rounded: square pixels are the
    # better guess.
    if focal is None and not any(source.get(key) is not None for key in ("fl_x", "fl_y")):
        angle = _number(source.get(f"camera_angle_{axis}"), f"camera_angle_{axis}", where)
        if angle is None:
            return None
        if not 0 < angle < math.pi:
            raise DyngsError(
                f"{where}: camera_angle_{axis} must lie between 0 and pi radians, got {angle:g}"
            )
        focal = 0.5 * size / max(math.tan(0.5 * angle), 1e-300)
    if focal is not None and focal <= 0:
        raise DyngsError(f"{where}: fl_{axis} must be positive, got {focal:g}")
    return focal


def _lens(frame: FrameEntry) -> Lens:
    model = (frame.text("camera_model") or "OPENCV").upper()
    k1, k2, k3, k4, k5, k6, p1, p2 = (
        frame.number(key) or 0.0 for key in ("k1", "k2", "k3", "k4", "k5", "k6", "p1", "p2")
    )
    if (
        model == "OPENCV_FISHEYE"
        or frame.own.get("is_fisheye", frame.shared.get("is_fisheye")) is True
    ):
        return Lens("fisheye", (k1, k2, k3, k4))
    if model in ("PINHOLE", "SIMPLE_PINHOLE"):
        return Lens()
    if model not in ("OPENCV", "FULL_OPENCV", "RADIAL", "SIMPLE_RADIAL", "PERSPECTIVE"):
        raise DyngsError(
            f"{frame.where}: camera_model {model} is not supported; use PINHOLE, OPENCV or "
            "OPENCV_FISHEYE"
        )
    if k4 and not (k5 or k6 or model == "FULL_OPENCV"):
        raise DyngsError(
            f"{frame.where}: k4 is ambiguous for {model}; use FULL_OPENCV or set it to 0"
        )
    params = (k1, k2, p1, p2, k3, k4, k5, k6)
    while len(params) > 4 and not params[-1]:
        params = params[:-1]
    return Lens("opencv", params) if any(params) else Lens()


USUAL_NAMES = ("points3d.ply", "points3D.ply", "fused.ply", "points.ply")
"""File names of initial points in 4DGaussians, COLMAP and nerfstudio, in order of priority."""
KEY = "ply_file_path"


def find_points(file: FrameFile) -> tuple[PointCloud | None, Path | None, list[str]]:
    """Return the points that belong to a transforms file, their file, and warnings.

    The file is that of ``ply_file_path``, else the first of ``USUAL_NAMES`` in the folder, else
    the only ``.ply`` there. An unreadable file that is not named explicitly is ignored with a
    warning. Raises DyngsError if the named file is missing, unreadable, or outside the capture.
    """
    root = file.path.parent
    written = file.fields.get(KEY)
    if isinstance(written, str) and written:
        path = check_inside(FileFinder(root).find(written))
        return read_points(path), path, []
    usual = [root / name for name in USUAL_NAMES if (root / name).is_file()]
    there = [path for path in root.iterdir() if path.suffix.lower() == ".ply" and path.is_file()]
    if not usual and len(there) != 1:
        return None, None, []
    path = (usual or there)[0]
    try:
        points = read_points(check_inside(path))
    except DyngsError as error:
        return None, None, [f"initial points not read: {error}"]
    return (points, path, []) if len(points.xyz) else (None, None, [])


def read_points(path: Path) -> PointCloud:
    """Read the points of a ``.ply`` file with trimesh; colours as in ``point_colours``."""
    import trimesh

    if not path.is_file():
        raise DyngsError(f"{path}: no such point file; restore it or remove {KEY}")
    # From an open file: given a path, trimesh would look for textures next to it.
    with (
        wrap_read_errors(path, "it must be a .ply file of points; export it again"),
        path.open("rb") as file,
    ):
        loaded: Any = trimesh.load(file, file_type="ply", process=False, skip_materials=True)
        xyz = np.asarray(loaded.vertices, dtype=np.float64).reshape(-1, 3)
        columns = loaded.metadata["_ply_raw"]["vertex"]["data"]
        if isinstance(columns, np.ndarray):  # of a binary file
            columns = {name: columns[name] for name in columns.dtype.names or ()}
        rgb = point_colours(columns, len(xyz))
    return PointCloud(xyz, rgb)


def find_masks(folder: Path) -> dict[str, Path]:
    """Map the normalised paths of masks below ``folder``, with and without extension, to files."""
    found: dict[str, Path] = {}
    for path in sorted(check_inside(folder).rglob("*")) if folder.is_dir() else ():
        if path.suffix.lower() in SUFFIXES:
            relative = path.relative_to(folder)
            found[normalize_name(relative.as_posix())] = path
            found.setdefault(normalize_name(relative.with_suffix("").as_posix()), path)
    return found


def find_mask(image_name: str, masks: Mapping[str, Path]) -> Path | None:
    """Find the mask of ``a/b.jpg``: ``a/b.jpg.png``, ``a/b.jpg``, ``a/b.png`` or
    ``a/b.mask.png``."""
    stem = image_name.rpartition(".")[0]
    names = (f"{image_name}.png", image_name, stem, f"{stem}.mask")
    return next((masks[key] for name in names if (key := normalize_name(name)) in masks), None)


def missing_mask_warning(views: Sequence[View], has_masks: bool) -> list[str]:
    """Return a warning on training images without a mask, if other images have one."""
    without = [view.name for view in views if view.mask_path is None]
    return (
        [f"{len(without)} images have no mask, first {without[0]}"] if has_masks and without else []
    )


def read_blender(root: Path) -> Capture:
    """Read ``transforms_{train,val,test}.json`` with OpenGL camera-to-world poses; val and test
    are optional.

    Intrinsics: ``camera_angle_x``, or ``w, h, fl_x, fl_y, cx, cy`` of the file or the frame.
    Points: see ``find_points``. Masks: ``mask_path`` of the frames, else files in ``masks/`` named
    after the images.
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
            warnings.append(f"{path.name}: no frames listed")
    splits, notes = _with_masks(root, splits)
    return _capture_of(root, "blender", train, splits, [*warnings, *notes])


def _with_masks(root: Path, splits: Splits) -> tuple[Splits, list[str]]:
    """Add masks from ``masks/`` if the files name none; also return a warning on views without
    one."""
    views = all_views(splits)
    has_people = any(view.silhouette for view in views) or any(root.glob("body_*.npz"))
    if has_people or any(view.mask_path for view in views):
        return splits, []
    masks = find_masks(root / "masks")
    images = root / "images"

    def with_mask(view: View) -> View:
        found = (
            find_mask(os.path.relpath(view.image_path, folder), masks) for folder in (images, root)
        )
        return replace(view, mask_path=next(filter(None, found), None))

    splits = map_views(splits, with_mask)
    return splits, missing_mask_warning(splits["train"], bool(masks))


def _capture_of(
    root: Path, format: str, file: FrameFile, splits: Splits, warnings: list[str]
) -> Capture:
    points, path, notes = find_points(file)
    tracks = find_tracks_file(file)
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
    """Read ``transforms.json`` with OpenGL camera-to-world poses and an optional ``.ply`` of
    points.

    ``train_filenames``, ``val_filenames`` and ``test_filenames`` define the splits; a val list
    without a test list becomes test. Points and poses are used as stored: ``applied_transform`` is
    already applied to both.
    """
    file = read_frame_file(root / "transforms.json")
    views, warnings = read_views(file)
    splits, notes = _nerfstudio_splits(file, views)
    splits, more = _with_masks(root, splits)
    return _capture_of(root, "nerfstudio", file, splits, [*warnings, *notes, *more])


def _nerfstudio_splits(file: FrameFile, views: dict[str, View]) -> tuple[Splits, list[str]]:
    """Return splits by the lists in the file (all views for training without lists), and
    warnings."""
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
    notes = (
        [f"{len(unknown)} listed images are not in 'frames', first {unknown[0]}"] if unknown else []
    )
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
    """Read ``transforms_{train,val,test,pose}.json`` with body parameters; all but the first are
    optional.

    The parameters of a split are in ``body_SPLIT.npz``: poses (T, 72, 156 or 165), trans (T, 3),
    betas and optionally scale; row n belongs to the frame whose ``frame`` is n. Without such a
    file, val and test use those of train. ``surface_model_type`` "anny" marks betas of the free
    template's shape space. ``pose`` is a separate clip, with its own frame numbers, times and
    parameters. Parameters and cameras share one world; unlike AMASS files nothing is rotated to y
    up.
    """
    capture = read_blender(root)  # its points are not used: people begin on a template
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
            f"{path}: no such file; transforms_pose.json is a separate clip and needs its own "
            "body parameters"
        )
    body = read_body_file(path) if path.is_file() and split != "train" else train
    match_frames(path if path.is_file() else root / "body_train.npz", body, views)
    return body


BODY_FORMAT = CaptureFormat(
    "body_json",
    "transforms_train.json and body_train.npz",
    lambda root: (root / "transforms_train.json").is_file() and any(root.glob("body_*.npz")),
    read_body_json,
    extends="blender",
)
