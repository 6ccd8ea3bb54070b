"""Reader for sequences of several static cameras: a folder or a video file per camera, and ``cameras.json``."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from dyngs.data.capture import Capture, Splits, View
from dyngs.data.geometry.poses import checked_pose, opengl_from_cam
from dyngs.data.readers.shared.camera_sequences import (
    MIN_CAMERAS_TO_HOLD_OUT,
    find_cameras,
    open_camera,
    sequence_views,
    video_fps,
)
from dyngs.data.readers.shared.capture_format import CaptureFormat
from dyngs.data.readers.shared.transforms import MAX_FPS
from dyngs.errors import DyngsError
from dyngs.files.fields import first_few, is_number, matrix_of, read_json_object

CALIBRATION = "cameras.json"


@dataclass(frozen=True)
class _CalibrationFile:
    """The fields of ``cameras.json``: camera name to calibration, frames per second, and ``test`` as written."""

    cameras: dict[str, object]
    fps: float | None
    test: object


def is_camera_folders(root: Path) -> bool:
    """Whether the folder holds ``cameras.json``."""
    return (root / CALIBRATION).is_file()


def read_camera_folders(root: Path) -> Capture:
    """Read ``cameras.json`` and the folders or videos named like its cameras.

    The file holds ``{"cameras": {NAME: {"fl_x", "fl_y", "cx", "cy", "w", "h", "k1", .., "transform_matrix" (OpenGL
    camera-to-world) or "cam_from_world" (OpenCV)}}, "fps": .., "test": [NAME, ..]}``. Without ``test`` the first camera
    is held out where there are three or more. Times run from the first frame number to the last one.

    Raises:
        DyngsError: broken or incomplete calibration, no images, images without a number in their name, bad videos.
    """
    path = root / CALIBRATION
    file = _read_calibration(path)
    calibrated = file.cameras
    found = find_cameras(root)
    names = [name for name in sorted(calibrated) if name in found]
    if not names:
        raise DyngsError(f"{path}: no folder or video is named like its cameras ({first_few(sorted(calibrated))})")
    warnings = []
    if len(names) < len(calibrated):
        absent = sorted(calibrated.keys() - found.keys())
        warnings.append(f"{path.name}: no folder or video for {first_few(absent)}, left out")
    unknown = sorted(found.keys() - calibrated.keys())
    if unknown:
        warnings.append(f"{path.name}: no calibration for {first_few(unknown)}, left out")
    cameras = [open_camera(name, found[name]) for name in names]
    own = {name: _calibration(calibrated[name], f"{path}, camera {name}") for name in names}
    views, notes = sequence_views(path, cameras, own)
    splits, more = _splits(path, file.test, views)
    fps = file.fps or video_fps(cameras)
    return Capture(root, "camera_folders", splits, fps=fps, warnings=(*warnings, *notes, *more))


def _read_calibration(path: Path) -> _CalibrationFile:
    wrong = "must be an object whose 'cameras' maps camera names to calibrations"
    fields = read_json_object(path, wrong)
    cameras = fields.get("cameras")
    if not isinstance(cameras, dict) or not cameras:
        raise DyngsError(f"{path}: {wrong}")
    fps = fields.get("fps")
    if fps is not None and not (is_number(fps) and 0 < fps < MAX_FPS):
        raise DyngsError(f"{path}: 'fps' must be a positive number, got {fps!r:.40}")
    return _CalibrationFile(cameras, None if fps is None else float(fps), fields.get("test"))


def _calibration(value: object, where: str) -> dict[str, object]:
    """Return the fields of a frame in a transforms file, with the pose as ``transform_matrix``."""
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
    pose, _ = checked_pose(matrix_of(where, "cam_from_world", own.pop("cam_from_world")), where)
    own["transform_matrix"] = opengl_from_cam(pose).tolist()
    return own


def _splits(path: Path, test: object, views: dict[str, tuple[View, ...]]) -> tuple[Splits, list[str]]:
    """Hold out the cameras that ``test`` lists, else the first one if there are enough; return splits and warnings."""
    notes = []
    if test is None:
        if len(views) < MIN_CAMERAS_TO_HOLD_OUT:
            return {"train": tuple(view for kept in views.values() for view in kept)}, []
        test = [min(views)]
        notes = [f"{path.name} names no 'test' cameras: the first one, {test[0]}, is held out"]
    elif not isinstance(test, list) or not all(isinstance(name, str) for name in test):
        raise DyngsError(f"{path}: 'test' must be a list of camera names")
    unknown = sorted(set(test) - views.keys())
    if unknown:
        raise DyngsError(f"{path}: 'test' names {first_few(unknown)}, but the cameras are {first_few(sorted(views))}")
    return {
        "train": tuple(view for name, kept in views.items() if name not in test for view in kept),
        "test": tuple(view for name, kept in views.items() if name in test for view in kept),
    }, notes


FORMAT = CaptureFormat("camera_folders", CALIBRATION, is_camera_folders, read_camera_folders)
