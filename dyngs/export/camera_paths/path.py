"""Camera paths for rendering, their scene times, and their JSON files (docs/camera_paths.md)."""

from __future__ import annotations

import json
import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch

from dyngs.core.camera import Cameras
from dyngs.core.errors import DyngsError, printable
from dyngs.data.geometry import cam_from_opengl, checked_pose
from dyngs.export.camera_paths.foreign import as_document, flat_pose
from dyngs.export.camera_paths.keyframes import Keyframes, interpolate_keyframes
from dyngs.io.fields import read_json
from dyngs.io.limits import require_at_most
from dyngs.io.write import write_text

_MAX_FRAMES = 100_000
"""A longer path is taken for a typing mistake."""
_MOST_BYTES = 1 << 26  # of the JSON of a path
PLACED_PATHS = ("orbit", "spiral", "along")


@dataclass(frozen=True)
class CameraPath:
    """F cameras in the order of the frames, and scene times in [0, 1], or None for a static scene.

    There are warnings about changed input, and notes about where the cameras were placed.
    """

    cameras: Cameras
    fps: float = 30.0
    times: tuple[float, ...] | None = None
    warnings: tuple[str, ...] = ()
    notes: tuple[str, ...] = ()

    def __len__(self) -> int:
        return len(self.cameras)


def with_times(path: CameraPath, times: Sequence[float]) -> CameraPath:
    """Return the path with other scene times, as many as cameras; those outside [0, 1] are clamped,
    with a warning."""
    if len(times) != len(path):
        raise DyngsError(
            f"the camera path has {len(path)} cameras, but there are {len(times)} times; give as many"
        )
    clamped, warnings = _clamped(times, "times")
    return replace(path, times=clamped, warnings=path.warnings + warnings)


def static_path(camera: Cameras, times: Sequence[float], fps: float = 30.0) -> CameraPath:
    """Return the path of one fixed camera at F >= 1 scene times, as in ``with_times``."""
    if len(camera) != 1:
        raise ValueError(f"a static path needs one camera, got {len(camera)}")
    poses, intrinsics = (
        x.expand(len(times), *x.shape[1:]).clone()
        for x in (camera.cam_from_world, camera.intrinsics)
    )
    return with_times(
        CameraPath(Cameras(poses, intrinsics, camera.width, camera.height), fps), times
    )


def resize_cameras(cameras: Cameras, width: int, height: int) -> Cameras:
    """Return the cameras at another image size: the whole image stays visible, pixels stay
    square."""
    scale = min(width / cameras.width, height / cameras.height)
    intrinsics = cameras.intrinsics.clone()
    intrinsics[:, :2] *= scale
    intrinsics[:, 0, 2] += (width - scale * cameras.width) / 2
    intrinsics[:, 1, 2] += (height - scale * cameras.height) / 2
    return replace(cameras, intrinsics=intrinsics, width=width, height=height)


def path_file(path: str) -> Path | None:
    """Return the JSON file that ``path`` names; None for a path that is placed: orbit, spiral,
    along."""
    if path in PLACED_PATHS:
        return None
    if not path.endswith(".json"):
        names = ", ".join(PLACED_PATHS)
        raise DyngsError(
            f"no camera path {path!r}; use {names}, or a .json file (docs/camera_paths.md)"
        )
    return Path(path)


def parse_times(text: str) -> tuple[float, ...]:
    """Return COUNT evenly spaced times from ``START:STOP:COUNT``, both ends included; a single one
    is START.

    Raises DyngsError: ``text`` is anything else.
    """
    wanted = "write START:STOP:COUNT, for instance 0:1:60 for 60 evenly spaced times"
    shown = printable(repr(text), 60)
    try:
        start, stop, count = (
            kind(part) for kind, part in zip((float, float, int), text.split(":"), strict=True)
        )
    except ValueError:
        raise DyngsError(f"{shown} is no range of times; {wanted}") from None
    if not (math.isfinite(start) and math.isfinite(stop)):
        raise DyngsError(f"{shown}: times must be finite; {wanted}")
    if not 1 <= count <= _MAX_FRAMES:
        raise DyngsError(f"{shown}: the count must be from 1 to {_MAX_FRAMES}; {wanted}")
    return tuple(np.linspace(start, stop, int(count)).tolist())


def write_path(file: Path, path: CameraPath, world_offset: np.ndarray | None = None) -> None:
    """Write a path as JSON in the format of ``read_path``, atomically; ``world_offset`` as
    there."""
    cameras = path.cameras
    frames = []
    for i in range(len(cameras)):
        pose = cameras.cam_from_world[i].detach().cpu().double().numpy().copy()
        k = cameras.intrinsics[i].tolist()
        if world_offset is not None:
            pose = world_pose(pose, world_offset)
        frame = {
            "cam_from_world": pose.tolist(),
            "fl_x": k[0][0],
            "fl_y": k[1][1],
            "cx": k[0][2],
            "cy": k[1][2],
        }
        frames.append(frame if path.times is None else frame | {"time": path.times[i]})
    document = {"width": cameras.width, "height": cameras.height, "fps": path.fps, "frames": frames}
    write_text(file, json.dumps(document, indent=1) + "\n")


def world_pose(pose: np.ndarray, offset: np.ndarray) -> np.ndarray:
    """Return a ``cam_from_world`` pose (4, 4) with ``offset`` (3,) added to the camera's centre, in
    float64.

    Its rotation is made orthonormal: readers do that, and a far camera must not move by it.
    """
    if not np.any(offset):
        return pose
    left, _, right = np.linalg.svd(pose[:3, :3])
    moved = np.eye(4)
    moved[:3, :3] = left @ right
    moved[:3, 3] = pose[:3, 3] - moved[:3, :3] @ offset
    return moved


def read_path(
    file: Path, world_offset: np.ndarray | None = None, size: tuple[int, int] | None = None
) -> CameraPath:
    """Read a camera path from a JSON file (docs/camera_paths.md); cameras are float32 on the CPU.

    The file is in the coordinates of the capture, the returned cameras are in the world rebased by
    ``world_offset`` (3,), ``Capture.world_offset``. ``size``: of the images, for files without one.

    Raises:
        DyngsError: names the file, the frame and the key that is missing or wrong.
    """
    if file.is_file():
        require_at_most(file, file.stat().st_size, _MOST_BYTES, "bytes")
    document, notes = as_document(read_json(file), file)
    if size is not None and "width" not in document and "height" not in document:
        document |= {"width": size[0], "height": size[1]}
    given = [name for name in ("frames", "keyframes") if name in document]
    if len(given) != 1 or not isinstance(document[given[0]], list) or not document[given[0]]:
        raise DyngsError(
            f"{file}: a camera path needs one non-empty list, 'frames' or 'keyframes'; see docs"
        )
    require_at_most(file, len(document[given[0]]), _MAX_FRAMES, "cameras")
    width, height = (
        int(_number(document, key, str(file), low=1, high=65536)) for key in ("width", "height")
    )
    fps = _number(document, "fps", str(file), low=1e-3, high=1000, default=30.0)
    poses, intrinsics, times = _read_cameras(document, given[0], (width, height), file)
    if world_offset is not None:
        poses[:, :3, 3] += poses[:, :3, :3] @ world_offset
    if given[0] == "keyframes":
        keys, num_frames = _read_keyframes(
            document, Keyframes(poses, intrinsics, np.zeros(0), times), fps, file
        )
        made = interpolate_keyframes(keys, np.arange(num_frames) / fps)
        poses = made.cam_from_world
        intrinsics = made.intrinsics
        times = made.times
    cameras = Cameras(
        torch.from_numpy(poses).float(), torch.from_numpy(intrinsics).float(), width, height
    )
    path = CameraPath(cameras, fps, notes=notes)
    if times is None:
        return path
    clamped, warnings = _clamped(times.tolist(), str(file))
    return replace(path, times=clamped, warnings=warnings)


def _read_cameras(
    document: dict[str, Any], name: str, size: tuple[int, int], file: Path
) -> tuple[np.ndarray, np.ndarray, np.ndarray | None]:
    """Return world-to-camera poses (F, 4, 4), intrinsics (F, 3, 3) and times (F,), if any, of the
    list ``name``."""
    poses = []
    matrices = []
    for i, frame in enumerate(document[name]):
        where = f"{file}: {name}[{i}]"
        if not isinstance(frame, dict):
            raise DyngsError(
                f"{where} must be an object with 'cam_from_world' or 'transform_matrix'"
            )
        poses.append(_read_pose(frame, where))
        matrices.append(_read_intrinsics(document, frame, size, where))
    times = _numbers_of_all(document, name, "time", (-1e9, 1e9), file)
    return np.stack(poses), np.stack(matrices), times


def _numbers_of_all(
    document: dict[str, Any], name: str, key: str, limits: tuple[float, float], file: Path
) -> np.ndarray | None:
    """Return the numbers (F,) at ``key`` in each object of the list ``name``; None if none has
    it."""
    frames = document[name]
    without = [i for i, frame in enumerate(frames) if key not in frame]
    if without and len(without) < len(frames):
        raise DyngsError(
            f"{file}: {name}[{without[0]}] has no '{key}', others have; give it to all or to none"
        )
    low, high = limits
    found = [
        _number(frame, key, f"{file}: {name}[{i}]", low=low, high=high)
        for i, frame in enumerate(frames)
        if not without
    ]
    return np.array(found) if found else None


def _read_keyframes(
    document: dict[str, Any], keys: Keyframes, fps: float, file: Path
) -> tuple[Keyframes, int]:
    """Return keyframes with seconds and period, and the number of frames, by 'at', 'num_frames',
    'seconds', 'loop'."""
    loop = document.get("loop", False)
    count = len(keys.cam_from_world)
    if not isinstance(loop, bool):
        raise DyngsError(f"{file}: 'loop' is {loop!r}; it must be true or false")
    at = _numbers_of_all(document, "keyframes", "at", (0, 1e6), file)
    if at is not None and (np.diff(at) <= 0).any():
        i = int(np.argmax(np.diff(at) <= 0)) + 1
        raise DyngsError(
            f"{file}: keyframes[{i}] is 'at' {at[i]:g} s, not after the one before; put them in order"
        )
    num_frames = _read_num_frames(document, fps, file)
    if at is None:
        intervals = count if loop else max(count - 1, 1)
        length = float(intervals) if num_frames is None else (num_frames - (not loop)) / fps
        at = np.arange(count) * ((length or 1.0) / intervals)
    span = float(at[-1] - at[0])
    if not loop:
        period = None
        shown = num_frames or round(at[-1] * fps) + 1
    else:
        period = (
            num_frames / fps if num_frames else span * count / (count - 1) if count > 1 else 1.0
        )
        shown = num_frames or max(1, round(period * fps))
        if period <= span:
            raise DyngsError(
                f"{file}: the loop takes {period:g} s, but its keyframes {span:g} s; make it longer"
            )
    if shown > _MAX_FRAMES:
        raise DyngsError(
            f"{file}: would be {shown} frames; at most {_MAX_FRAMES}: lower 'at', 'seconds' or 'fps'"
        )
    return replace(keys, seconds=at, period=period), shown


def _read_num_frames(document: dict[str, Any], fps: float, file: Path) -> int | None:
    """Return the number of frames by 'num_frames' or 'seconds'; None if neither is given."""
    if "num_frames" in document and "seconds" in document:
        raise DyngsError(
            f"{file}: 'num_frames' and 'seconds' both set the length of the video; give one of them"
        )
    if "seconds" in document:
        return max(1, round(_number(document, "seconds", str(file), low=1e-3, high=1e6) * fps))
    if "num_frames" not in document:
        return None
    number = _number(document, "num_frames", str(file), low=1, high=_MAX_FRAMES)
    if number != int(number):
        raise DyngsError(f"{file}: 'num_frames' is {number:g}; it must be a whole number")
    return int(number)


def _clamped(times: Sequence[float], where: str) -> tuple[tuple[float, ...], tuple[str, ...]]:
    """Return the times clamped to [0, 1], and a warning if any was outside."""
    if not all(math.isfinite(t) for t in times):
        raise DyngsError(f"{where}: scene times must be finite numbers in [0, 1]")
    outside = [t for t in times if not 0 <= t <= 1]
    clamped = tuple(min(max(float(t), 0.0), 1.0) for t in times)
    if not outside:
        return clamped, ()
    extremes = f"from {min(times):g} to {max(times):g}"
    return clamped, (
        f"{where}: {len(outside)} of {len(times)} scene times lie outside [0, 1] ({extremes}); clamped",
    )


def _read_pose(frame: dict[str, Any], where: str) -> np.ndarray:
    """Return the world-to-camera pose (4, 4) of a frame."""
    given = [key for key in ("cam_from_world", "transform_matrix") if key in frame]
    if len(given) != 1:
        raise DyngsError(f"{where} needs exactly one of 'cam_from_world' and 'transform_matrix'")
    try:
        matrix = flat_pose(np.array(frame[given[0]], np.float64))
    except (TypeError, ValueError, OverflowError):
        raise DyngsError(f"{where}: '{given[0]}' must be a 4x4 or 3x4 matrix of numbers") from None
    pose, _ = checked_pose(matrix, f"{where}: '{given[0]}'")
    return cam_from_opengl(pose) if given[0] == "transform_matrix" else pose


def _read_intrinsics(
    document: dict[str, Any], frame: dict[str, Any], size: tuple[int, int], where: str
) -> np.ndarray:
    """Return intrinsics (3, 3) in pixels from 'fl_x' [fl_y, cx, cy] or 'camera_angle_x'; keys of
    the frame first."""
    width, height = size
    focal_keys = {"fl_x", "fl_y", "camera_angle_x"}
    own_focal = not focal_keys.isdisjoint(frame)
    keys = {
        key: value for key, value in document.items() if not (own_focal and key in focal_keys)
    } | frame
    if "fl_x" in keys:
        focal_x = _number(keys, "fl_x", where, low=1e-3, high=1e9)
    elif "camera_angle_x" in keys:
        focal_x = (
            0.5
            * width
            / math.tan(0.5 * _number(keys, "camera_angle_x", where, low=1e-4, high=3.14))
        )
    else:
        raise DyngsError(
            f"{where} needs 'fl_x' or 'camera_angle_x' (in the frame or once for the whole file)"
        )
    focal_y = _number(keys, "fl_y", where, low=1e-3, high=1e9, default=focal_x)
    cx = _number(keys, "cx", where, low=-1e9, high=1e9, default=0.5 * width)
    cy = _number(keys, "cy", where, low=-1e9, high=1e9, default=0.5 * height)
    return np.array([[focal_x, 0, cx], [0, focal_y, cy], [0, 0, 1]])


def _number(
    keys: dict[str, Any],
    key: str,
    where: str,
    *,
    low: float,
    high: float,
    default: float | None = None,
) -> float:
    """Return the number at ``key``. Raises DyngsError unless it is in [low, high]."""
    value = keys.get(key, default)
    if isinstance(value, bool) or not isinstance(value, (int, float)) or not low <= value <= high:
        problem = "is missing" if value is None else f"is {printable(repr(value), 60)}"
        raise DyngsError(
            f"{where}: '{key}' {problem}; it must be a number from {low:g} to {high:g}"
        )
    return float(value)
