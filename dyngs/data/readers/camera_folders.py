"""Readers for fixed cameras with a folder or video each: cameras.json, and LLFF's poses_bounds.npy
(N3V)."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from dyngs.core.errors import DyngsError
from dyngs.data.capture import Capture, CaptureFormat, Splits, VideoFrame, View
from dyngs.data.geometry import (
    OPENGL_FROM_OPENCV,
    to_opengl_pose,
    validate_pose,
)
from dyngs.data.images.images import SUFFIXES, list_files
from dyngs.data.images.video import VideoFrames, colour_messages, list_videos, locate_cached_frames
from dyngs.data.readers.transforms import MAX_FPS, FrameEntry, FrameFile, read_views
from dyngs.io.fields import first_few, is_number, parse_matrix, read_json_object
from dyngs.io.numpy_files import read_npy

MIN_CAMERAS_TO_HOLD_OUT = 3
"""From this number on, the first camera is held out if the capture defines no test cameras."""


@dataclass(frozen=True)
class CameraSource:
    """Images of the camera ``name`` by frame number; those of a ``video`` may still have to be
    decoded."""

    name: str
    images: dict[int, Path]
    video: VideoFrames | None = None


def find_cameras(root: Path) -> dict[str, Path]:
    """Map camera names, sorted, to folders of images or, failing that, to video files.

    Images are in the folder itself or in ``images`` below it. Raises DyngsError for two videos of
    one camera.
    """
    found = {path.stem: path for path in list_videos(root)}
    for path in sorted(root.iterdir()):
        if path.is_dir() and not path.name.startswith("."):
            folder = next((f for f in (path, path / "images") if list_files(f, SUFFIXES)), None)
            if folder is not None:
                found[path.name] = folder
    return dict(sorted(found.items()))


def open_camera(name: str, path: Path) -> CameraSource:
    """List the images of a camera folder or video.

    Raises DyngsError for images without frame number or with the same one, and for unreadable
    videos.
    """
    if path.is_file():
        planned = locate_cached_frames(path)
        return CameraSource(name, dict(enumerate(planned.paths)), planned)
    images: dict[int, Path] = {}
    for image in list_files(path, SUFFIXES):
        digits = re.findall(r"\d+", image.stem)
        if not digits:
            raise DyngsError(
                f"{image}: no frame number in its name; rename it, for example to "
                f"frame_0000{image.suffix}"
            )
        other = images.setdefault(int(digits[-1]), image)
        if other != image:
            raise DyngsError(
                f"{path}: {other.name} and {image.name} have the same frame number; remove one "
                "of them"
            )
    return CameraSource(name, images)


def sequence_views(
    path: Path, cameras: Sequence[CameraSource], calibrations: Mapping[str, dict[str, object]]
) -> tuple[dict[str, tuple[View, ...]], list[str]]:
    """Return the views of each camera, and warnings. Times are 0 at the lowest frame number and 1
    at the highest.

    Args:
        path: the calibration file in the capture's folder.
        cameras: in the order of their ``camera_id``.
        calibrations: by camera name, the fields of a frame in a transforms file: ``fl_x``,
            ``transform_matrix``, ...
    """
    numbers = sorted({number for camera in cameras for number in camera.images})
    span = max(numbers[-1] - numbers[0], 1)
    views: dict[str, tuple[View, ...]] = {}
    warnings = colour_messages(camera.video.info for camera in cameras if camera.video is not None)
    for index, camera in enumerate(cameras):
        own = calibrations[camera.name]
        where = f"{path}, camera {camera.name}"
        source = camera.video
        size = None if source is None else (source.info.width, source.info.height)
        frames = []
        for number, image in sorted(camera.images.items()):
            times = {"frame": number, "time": (number - numbers[0]) / span}
            fields = {**own, **times, "file_path": str(image), "camera": index}
            video = None if source is None else VideoFrame(source.source, number)
            frames.append(FrameEntry(where, fields, image=image, video=video, stored=size))
        read, notes = read_views(FrameFile(path, frames))
        views[camera.name] = tuple(read.values())
        if source is not None:  # named after the video, not after the cache
            views[camera.name] = tuple(
                replace(view, name=f"{camera.name}/{view.image_path.stem}")
                for view in read.values()
            )
        warnings += notes
    return views, warnings


def video_fps(cameras: Sequence[CameraSource]) -> float | None:
    """Return the frame rate of the first video that has one, else None."""
    return next(
        (camera.video.info.fps for camera in cameras if camera.video and camera.video.info.fps > 0),
        None,
    )


CALIBRATION = "cameras.json"


def read_camera_folders(root: Path) -> Capture:
    """Read ``cameras.json`` and the folders or videos named after its cameras.

    The file contains ``{"cameras": {NAME: {"fl_x", "fl_y", "cx", "cy", "w", "h", "k1", ..,
    "transform_matrix" (OpenGL camera-to-world) or "cam_from_world" (OpenCV)}}, "fps": .., "test":
    [NAME, ..]}``. Without ``test`` the first of three or more cameras is held out. Time 0 is the
    first frame number, time 1 the last one.
    """
    path = root / CALIBRATION
    calibrated, fps, test = _read_calibration(path)
    found = find_cameras(root)
    names = [name for name in sorted(calibrated) if name in found]
    if not names:
        raise DyngsError(
            f"{path}: no folder or video is named after a camera ({first_few(sorted(calibrated))})"
        )
    warnings = [
        f"{path.name}: {kind} for {first_few(sorted(some.keys() - others.keys()))}, skipped"
        for kind, some, others in (
            ("no folder or video", calibrated, found),
            ("no calibration", found, calibrated),
        )
        if some.keys() - others.keys()
    ]
    cameras = [open_camera(name, found[name]) for name in names]
    own = {name: _calibration(calibrated[name], f"{path}, camera {name}") for name in names}
    views, notes = sequence_views(path, cameras, own)
    splits, more = _splits(path, test, views)
    return Capture(
        root,
        "camera_folders",
        splits,
        fps=fps or video_fps(cameras),
        warnings=(*warnings, *notes, *more),
    )


def _read_calibration(path: Path) -> tuple[dict[str, object], float | None, object]:
    """Return calibrations by camera name, frames per second, and ``test`` as written."""
    wrong = "must be an object whose 'cameras' maps camera names to calibrations"
    fields = read_json_object(path, wrong)
    cameras = fields.get("cameras")
    if not isinstance(cameras, dict) or not cameras:
        raise DyngsError(f"{path}: {wrong}")
    fps = fields.get("fps")
    if fps is not None and not (is_number(fps) and 0 < fps < MAX_FPS):
        raise DyngsError(f"{path}: 'fps' must be a positive number, got {fps!r:.40}")
    return cameras, None if fps is None else float(fps), fields.get("test")


def _calibration(value: object, where: str) -> dict[str, object]:
    """Return the fields of a frame in a transforms file, with the pose as ``transform_matrix``."""
    if not isinstance(value, dict):
        raise DyngsError(
            f"{where}: must be an object with fl_x and transform_matrix or cam_from_world"
        )
    own = {str(key): field for key, field in value.items()}
    if ("transform_matrix" in own) == ("cam_from_world" in own):
        raise DyngsError(
            f"{where}: give either transform_matrix (OpenGL, camera-to-world) or cam_from_world "
            f"(OpenCV), not {'both' if 'cam_from_world' in own else 'neither'}"
        )
    if "cam_from_world" not in own:
        return own
    pose, _ = validate_pose(parse_matrix(where, "cam_from_world", own.pop("cam_from_world")), where)
    own["transform_matrix"] = to_opengl_pose(pose).tolist()
    return own


def _splits(
    path: Path, test: object, views: dict[str, tuple[View, ...]]
) -> tuple[Splits, list[str]]:
    """Hold out the cameras in ``test``, else the first of enough cameras; return splits and
    warnings."""
    notes = []
    if test is None:
        if len(views) < MIN_CAMERAS_TO_HOLD_OUT:
            return {"train": _held_out(views, [])["train"]}, []
        test = [min(views)]
        notes = [f"{path.name} lists no 'test' cameras; the first one, {test[0]}, is held out"]
    elif not isinstance(test, list) or not all(isinstance(name, str) for name in test):
        raise DyngsError(f"{path}: 'test' must be a list of camera names")
    unknown = sorted(set(test) - views.keys())
    if unknown:
        raise DyngsError(
            f"{path}: 'test' names {first_few(unknown)}, but the cameras are "
            f"{first_few(sorted(views))}"
        )
    return _held_out(views, test), notes


def _held_out(views: dict[str, tuple[View, ...]], test: Sequence[str]) -> Splits:
    splits: Splits = {"train": (), "test": ()}
    for name, kept in views.items():
        splits["test" if name in test else "train"] += kept
    return splits


FORMAT = CaptureFormat(
    "camera_folders", CALIBRATION, lambda root: (root / CALIBRATION).is_file(), read_camera_folders
)


POSES = "poses_bounds.npy"


def read_llff(root: Path) -> Capture:
    """Read ``poses_bounds.npy`` and one video ``camNN.mp4`` or folder ``camNN`` per camera, by
    name.

    Each row contains a 3x5 matrix, row by row, and near and far bounds (unused). Its columns are
    the camera's down, right and backward axes, its position, and height, width and focal length of
    the full image in pixels (Mildenhall et al. 2019). The first camera is the test view, as in
    N3V. Raises DyngsError for an unreadable file, differing numbers of rows and cameras, and
    invalid poses, images or videos.
    """
    path = root / POSES
    rows = _read_rows(path)
    found = find_cameras(root)
    # There may be folders of other programs, too.
    found = {
        name: at for name, at in found.items() if re.fullmatch(r"cam[-_]?\d+", name, re.IGNORECASE)
    } or found
    names = list(found)
    if len(names) != len(rows):
        raise DyngsError(
            f"{path}: has {len(rows)} poses, but there are {len(names)} videos or folders of "
            f"frames ({first_few(names)}); make the numbers equal"
        )
    cameras = [open_camera(name, found[name]) for name in names]
    calibrations = {name: _llff_calibration(row) for name, row in zip(names, rows, strict=True)}
    views, notes = sequence_views(path, cameras, calibrations)
    splits = _held_out(views, names[:1] if len(names) > 1 else [])
    return Capture(root, "llff", splits, fps=video_fps(cameras), warnings=tuple(notes))


def _read_rows(path: Path) -> np.ndarray:
    rows = read_npy(path)
    if rows.ndim != 2 or rows.shape[1] != 17 or not len(rows):
        raise DyngsError(
            f"{path}: must have 17 columns, one row per camera; got shape {rows.shape}"
        )
    return rows


def _llff_calibration(row: np.ndarray) -> dict[str, object]:
    matrix = row[:15].reshape(3, 5)
    down, right, backward, position, (height, width, focal) = matrix.T
    world_from_cam = np.eye(4)
    world_from_cam[:3] = np.stack([right, down, -backward, position], axis=1)
    pose = (world_from_cam @ OPENGL_FROM_OPENCV).tolist()
    return {"fl_x": float(focal), "w": float(width), "h": float(height), "transform_matrix": pose}


LLFF_FORMAT = CaptureFormat("llff", POSES, lambda root: (root / POSES).is_file(), read_llff)
