"""Reader for videos from several cameras at rest: a folder or a video file per camera, and ``cameras.json``."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from dyngs.data.capture import Capture, Split, View
from dyngs.data.geometry.poses import OPENGL_FROM_OPENCV, checked_pose, inverse_rigid
from dyngs.data.readers.shared.camera_sequences import find_cameras, open_camera, sequence_views
from dyngs.errors import DyngsError
from dyngs.files.json_files import read_json_object

CALIBRATION = "cameras.json"
_MIN_TO_HOLD_ONE_OUT = 3


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


def _some(names: Sequence[str]) -> str:
    return ", ".join(names[:5]) + (f" and {len(names) - 5} more" if len(names) > 5 else "")
