"""Reader for videos from several cameras at rest: a folder or a video file per camera, and ``cameras.json``.

What is common to such captures, however they are calibrated, is here, too; see also ``dyngs.data.readers.llff``.
"""

from __future__ import annotations

import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from dyngs.data.capture import Capture, Split, VideoFrame, View
from dyngs.data.intrinsics import match_size, rescale_warning
from dyngs.data.pictures.frame_cache import VideoFrames, planned_frames
from dyngs.data.pictures.images import SUFFIXES
from dyngs.data.pictures.video import VIDEO_SUFFIXES, VideoInfo
from dyngs.data.poses import checked_pose, inverse_rigid
from dyngs.data.readers.transforms import Frame, FrameFile, read_views
from dyngs.errors import DyngsError
from dyngs.files.json_object import read_json_object

CALIBRATION = "cameras.json"
OPENGL_FROM_OPENCV = np.diag([1.0, -1.0, -1.0, 1.0])
_MIN_TO_HOLD_ONE_OUT = 3


@dataclass(frozen=True)
class CameraSource:
    """The pictures of one camera.

    Attributes:
        name: of its folder, or of its video without the suffix.
        pictures: frame number to file; the files of a video may have to be decoded first.
        video: its frames, None for a folder.
    """

    name: str
    pictures: dict[int, Path]
    video: VideoFrames | None = None


def is_camera_folders(root: Path) -> bool:
    """Whether the folder holds ``cameras.json``."""
    return (root / CALIBRATION).is_file()


def read_camera_folders(root: Path) -> Capture:
    """The capture of ``cameras.json`` and the folders or videos named like the cameras in it.

    The file holds ``{"cameras": {NAME: {"fl_x", "fl_y", "cx", "cy", "w", "h", "k1", .., "transform_matrix" (OpenGL
    camera-to-world) or "cam_from_world" (OpenCV)}}, "fps": .., "test": [NAME, ..]}``. Without ``test`` the first camera
    is held out where there are three or more. Times run from the first frame number to the last one.

    Raises:
        DyngsError: broken or incomplete calibration, no pictures, pictures without a number in their name, bad videos.
    """
    path = root / CALIBRATION
    fields = _read_calibration(path)
    calibrated = fields["cameras"]
    assert isinstance(calibrated, dict)
    found = find_cameras(root)
    names = [name for name in sorted(calibrated) if name in found]
    if not names:
        raise DyngsError(f"{path}: no folder or video is named like its cameras ({_some(sorted(calibrated))})")
    warnings = []
    if len(names) < len(calibrated):
        absent = sorted(calibrated.keys() - found.keys())
        warnings.append(f"{path.name}: no folder or video for {_some(absent)}, left out")
    unknown = sorted(found.keys() - calibrated.keys())
    if unknown:
        warnings.append(f"{path.name}: no calibration for {_some(unknown)}, left out")
    cameras = [open_camera(name, found[name]) for name in names]
    own = {name: _calibration(calibrated[name], f"{path}, camera {name}") for name in names}
    views, notes = sequence_views(path, cameras, own)
    splits, more = _splits(path, fields, views)
    return Capture(root, "camera_folders", splits, warnings=(*warnings, *notes, *more))


def calibrated_fps(root: Path) -> float | None:
    """``fps`` of ``cameras.json``, None where it or the file is absent."""
    if not is_camera_folders(root):
        return None
    fps = _read_calibration(root / CALIBRATION).get("fps")
    return None if fps is None else float(fps)  # type: ignore[arg-type]


def find_cameras(root: Path) -> dict[str, Path]:
    """Camera name to its folder of pictures, or to its video file where it has no such folder; sorted by name.

    Pictures lie in the folder itself or in ``images`` below it.

    Raises:
        DyngsError: two videos for one camera.
    """
    found: dict[str, Path] = {}
    for path in sorted(root.iterdir()):
        if path.suffix.lower() in VIDEO_SUFFIXES and path.is_file() and not path.name.startswith("."):
            if path.stem in found:
                raise DyngsError(f"{root}: {found[path.stem].name} and {path.name} are one camera; remove one of them")
            found[path.stem] = path
    for path in sorted(root.iterdir()):
        if path.is_dir() and not path.name.startswith("."):
            folder = next((f for f in (path, path / "images") if _pictures(f)), None)
            if folder is not None:
                found[path.name] = folder
    return dict(sorted(found.items()))


def open_camera(name: str, path: Path) -> CameraSource:
    """The pictures of the camera that ``find_cameras`` found at ``path``.

    Raises:
        DyngsError: a picture without a number, two with the same one, or a video that cannot be opened.
    """
    if path.is_file():
        planned = planned_frames(path)
        return CameraSource(name, dict(enumerate(planned.paths)), planned)
    pictures: dict[int, Path] = {}
    for picture in _pictures(path):
        digits = re.findall(r"\d+", picture.stem)
        if not digits:
            raise DyngsError(f"{picture}: no frame number in its name; call it frame_0000{picture.suffix} or the like")
        other = pictures.setdefault(int(digits[-1]), picture)
        if other != picture:
            raise DyngsError(f"{path}: {other.name} and {picture.name} have the same frame number; remove one of them")
    return CameraSource(name, pictures)


def sequence_views(
    path: Path, cameras: Sequence[CameraSource], calibrations: Mapping[str, dict[str, object]]
) -> tuple[dict[str, tuple[View, ...]], list[str]]:
    """The views of each camera, and warnings; times run from 0 at the lowest frame number to 1 at the highest one.

    Args:
        path: the calibration file in the capture's folder.
        cameras: in the order of their ``camera_id``.
        calibrations: by camera name, the fields of a frame in a transforms file: ``fl_x``, ``transform_matrix``, ...

    Raises:
        DyngsError: see ``dyngs.data.readers.transforms.read_views``.
    """
    numbers = sorted({number for camera in cameras for number in camera.pictures})
    span = max(numbers[-1] - numbers[0], 1)
    views: dict[str, tuple[View, ...]] = {}
    warnings = _rate_warning(cameras)
    for index, camera in enumerate(cameras):
        own = dict(calibrations[camera.name])
        where = f"{path}, camera {camera.name}"
        if camera.video is not None and ("w" not in own or "h" not in own):
            own |= {"w": camera.video.info.width, "h": camera.video.info.height}
        frames = []
        for number, picture in sorted(camera.pictures.items()):
            times = {"frame": number, "time": (number - numbers[0]) / span}
            fields = {**own, **times, "file_path": str(picture), "camera": index}
            video = None if camera.video is None else VideoFrame(camera.video.source, number)
            frames.append(Frame(where, fields, {}, picture, video))
        read, notes = read_views(FrameFile(path, {}, tuple(frames)))
        views[camera.name], more = tuple(read.values()), []
        if camera.video is not None:
            views[camera.name], more = _at_video_size(camera.name, camera.video.info, views[camera.name], where)
        warnings += [*notes, *more]
    return views, warnings


def _at_video_size(
    name: str, video: VideoInfo, views: tuple[View, ...], where: str
) -> tuple[tuple[View, ...], list[str]]:
    """The views with names after the video, and of its size even where the frame has not been decoded yet."""
    sized, rescaled = [], []
    for view in views:
        described = (view.width, view.height)
        intrinsics, size, changed = match_size(view.intrinsics, described, (video.width, video.height), where)
        rescaled += [where] if changed else []
        frame = f"{name}/{view.image_path.stem}"
        sized.append(replace(view, name=frame, intrinsics=intrinsics, width=size[0], height=size[1]))
    return tuple(sized), rescale_warning(rescaled)


def _rate_warning(cameras: Sequence[CameraSource]) -> list[str]:
    videos = [
        (camera.name, camera.video.info.fps)
        for camera in cameras
        if camera.video is not None and camera.video.info.fps > 0
    ]
    odd = [(name, fps) for name, fps in videos if not math.isclose(fps, videos[0][1], rel_tol=0.01)]
    if not odd:
        return []
    first, (name, fps) = videos[0], odd[0]
    return [
        f"{first[0]} has {first[1]:g} frames per second, {name} {fps:g}: frames of one number are taken for "
        "simultaneous; convert the videos to one rate"
    ]


def _read_calibration(path: Path) -> dict[str, object]:
    wrong = "must be an object whose 'cameras' maps camera names to calibrations"
    fields = read_json_object(path, wrong)
    if not isinstance(fields.get("cameras"), dict) or not fields["cameras"]:
        raise DyngsError(f"{path}: {wrong}")
    fps = fields.get("fps")
    if fps is not None and (isinstance(fps, bool) or not isinstance(fps, (int, float)) or not 0 < fps < 1e6):
        raise DyngsError(f"{path}: 'fps' must be a positive number, got {fps!r:.40}")
    return fields


def _calibration(value: object, where: str) -> dict[str, object]:
    """The fields of a frame, with the pose as ``transform_matrix``."""
    if not isinstance(value, dict):
        raise DyngsError(f"{where}: must be an object with fl_x and transform_matrix or cam_from_world")
    own = {str(key): field for key, field in value.items()}
    if ("transform_matrix" in own) == ("cam_from_world" in own):
        raise DyngsError(
            f"{where}: give either transform_matrix (OpenGL, camera-to-world) or cam_from_world (OpenCV), not "
            f"{'both' if 'cam_from_world' in own else 'neither'}"
        )
    if "cam_from_world" not in own:
        return own
    try:
        matrix = np.array(own.pop("cam_from_world"), dtype=np.float64)
    except (TypeError, ValueError, OverflowError):
        raise DyngsError(f"{where}: cam_from_world must hold 4x4 numbers; export it again") from None
    pose, _ = checked_pose(matrix, where)
    own["transform_matrix"] = (inverse_rigid(pose) @ OPENGL_FROM_OPENCV).tolist()
    return own


def _splits(
    path: Path, fields: dict[str, object], views: dict[str, tuple[View, ...]]
) -> tuple[dict[Split, tuple[View, ...]], list[str]]:
    """Test cameras by ``test``, else the first one if there are enough; no test split if there are not."""
    test, notes = fields.get("test"), []
    if test is None:
        if len(views) < _MIN_TO_HOLD_ONE_OUT:
            return {"train": tuple(view for kept in views.values() for view in kept)}, []
        test = [min(views)]
        notes = [f"{path.name} names no 'test' cameras: the first one, {test[0]}, is held out"]
    elif not isinstance(test, list) or not all(isinstance(name, str) for name in test):
        raise DyngsError(f"{path}: 'test' must be a list of camera names")
    unknown = sorted(set(test) - views.keys())
    if unknown:
        raise DyngsError(f"{path}: 'test' names {_some(unknown)}, but the cameras are {_some(sorted(views))}")
    return {
        "train": tuple(view for name, kept in views.items() if name not in test for view in kept),
        "test": tuple(view for name, kept in views.items() if name in test for view in kept),
    }, notes


def _pictures(folder: Path) -> list[Path]:
    if not folder.is_dir():
        return []
    return sorted(p for p in folder.iterdir() if p.suffix.lower() in SUFFIXES and not p.name.startswith("."))


def _some(names: Sequence[str]) -> str:
    return ", ".join(names[:5]) + (f" and {len(names) - 5} more" if len(names) > 5 else "")
