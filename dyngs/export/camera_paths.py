"""Camera paths for rendering: scene times, JSON files of dyngs and other programs, keyframes."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch

from dyngs.core.camera import Cameras
from dyngs.core.errors import DyngsError, format_one_line
from dyngs.data.geometry import from_opengl_pose, invert_rigid, pinhole_matrix, validate_pose
from dyngs.io.fields import (
    as_float_array,
    is_number,
    parse_numbers,
    read_json,
    require_at_most,
    require_key,
)

_MAX_FRAMES = 100_000  # Longer paths are assumed to be a typing mistake
AUTOMATIC_PATHS = ("orbit", "spiral", "along")  # Paths that are placed automatically


@dataclass(frozen=True)
class CameraPath:
    """F cameras in the order of the frames.

    Attributes:
        times: scene times in [0, 1], or None for a static scene.
        notes: remarks on the placement of the cameras and on changed input.
    """

    cameras: Cameras
    fps: float = 30.0
    times: tuple[float, ...] | None = None
    notes: tuple[str, ...] = ()

    def __len__(self) -> int:
        return len(self.cameras)


def clamp_times(times: Sequence[float]) -> tuple[tuple[float, ...], tuple[str, ...]]:
    """Return ``times`` clamped to [0, 1], and a note if any changed."""
    inside = tuple(np.clip(times, 0.0, 1.0).tolist())
    count = sum(a != b for a, b in zip(times, inside, strict=True))
    note = f"clamped {count} of {len(times)} times to [0, 1]"
    return inside, (note,) if count else ()


def with_times(path: CameraPath, times: Sequence[float]) -> CameraPath:
    """Return the path with other scene times, one per camera, clamped to [0, 1]."""
    if len(times) != len(path):
        raise DyngsError(
            f"the camera path has {len(path)} cameras but {len(times)} times; give one time per "
            "camera"
        )
    inside, notes = clamp_times(times)
    return replace(path, times=inside, notes=(*path.notes, *notes))


def pick_cameras(cameras: Cameras, rows: Sequence[int] | np.ndarray) -> Cameras:
    """Return the cameras at ``rows``."""
    index = torch.as_tensor(rows, device=cameras.intrinsics.device)
    return replace(
        cameras, cam_from_world=cameras.cam_from_world[index], intrinsics=cameras.intrinsics[index]
    )


def spread_rows(length: int, count: int) -> np.ndarray:
    """Return at most ``count`` indices below ``length``, evenly spaced, with the first and the
    last."""
    return np.unique(np.linspace(0, length - 1, count).round().astype(int))


def resize_cameras(cameras: Cameras, width: int, height: int) -> Cameras:
    """Return the cameras at another image size, with square pixels and the whole image visible."""
    scale = min(width / cameras.width, height / cameras.height)
    intrinsics = cameras.intrinsics.clone()
    intrinsics[:, :2] *= scale
    intrinsics[:, 0, 2] += (width - scale * cameras.width) / 2
    intrinsics[:, 1, 2] += (height - scale * cameras.height) / 2
    return replace(cameras, intrinsics=intrinsics, width=width, height=height)


def camera_path_file(path: str) -> Path | None:
    """Return the JSON file named by ``path``, or None for an automatic path: orbit, spiral,
    along."""
    if path in AUTOMATIC_PATHS:
        return None
    if not path.endswith(".json"):
        names = ", ".join(AUTOMATIC_PATHS)
        raise DyngsError(f"unknown camera path {path!r}; use {names}, or a .json file")
    return Path(path)


def parse_times(text: str) -> tuple[float, ...]:
    """Return COUNT evenly spaced times of ``START:STOP:COUNT``, including both ends.

    Raises:
        DyngsError: invalid text.
    """
    try:
        first, last, number = text.split(":")
        start, stop, count = float(first), float(last), int(number)
    except ValueError:
        start, stop, count = 0.0, 0.0, 0
    if not (math.isfinite(start) and math.isfinite(stop) and 1 <= count <= _MAX_FRAMES):
        raise DyngsError(
            f"{format_one_line(repr(text), 60)}: not a range of times; use START:STOP:COUNT, such as "
            "0:1:60"
        )
    return tuple(np.linspace(start, stop, count).tolist())


def read_path(
    file: Path, world_offset: np.ndarray | None = None, size: tuple[int, int] | None = None
) -> CameraPath:
    """Read a camera path from a JSON file (docs/reference/camera-paths.md).

    The file uses the coordinates of the capture. The returned cameras are float32 on the CPU, in
    the world shifted by ``world_offset``.

    Args:
        world_offset: (3,), see ``Capture.world_offset``.
        size: image size for files without one.

    Raises:
        DyngsError: names the file, the frame and the missing or wrong key.
    """
    document, notes = _as_document(read_json(file), file)
    if size is not None:
        document = {"w": size[0], "h": size[1]} | document
    (name, *others) = [key for key in ("frames", "keyframes") if key in document] or ["frames"]
    frames = document.get(name)
    if others or not isinstance(frames, list) or not frames:
        raise DyngsError(f"{file}: a camera path needs one non-empty list, 'frames' or 'keyframes'")
    require_at_most(file, len(frames), _MAX_FRAMES, "cameras")
    first = frames[0] if isinstance(frames[0], dict) else {}
    known = {key: value for key, value in first.items() if key in ("w", "h")} | document
    # nerfstudio calls the size w and h, in the file or in its frames.
    width = int(_number(known, "width", file, 1, 65536, known.get("w")))
    height = int(_number(known, "height", file, 1, 65536, known.get("h")))
    fps = _number(document, "fps", file, 1e-3, 1000, 30.0)
    poses = []
    matrices = []
    for i, frame in enumerate(frames):
        where = f"{file}: {name}[{i}]"
        pose = _read_pose(frame, where)
        if any(frame.get(key) != first.get(key) for key in ("w", "h")):
            raise DyngsError(f"{where}: image size differs from that of the first frame")
        if world_offset is not None:
            pose[:3, 3] += pose[:3, :3] @ world_offset
        poses.append(pose)
        matrices.append(_read_intrinsics(document, frame, (width, height), where))
    times = _numbers_of_all(frames, "time", 1e9, f"{file}: {name}")
    keys = Keyframes(np.stack(poses), np.stack(matrices), np.zeros(0), times)
    if name == "keyframes":
        keys, num_frames = _with_seconds(keys, document, fps, file)
        keys = interpolate_keyframes(keys, np.arange(num_frames) / fps)
    poses, matrices = (torch.from_numpy(x).float() for x in (keys.cam_from_world, keys.intrinsics))
    path = CameraPath(Cameras(poses, matrices, width, height), fps, notes=notes)
    return path if keys.times is None else with_times(path, keys.times.tolist())


def _as_document(found: Any, file: Path) -> tuple[dict[str, Any], tuple[str, ...]]:
    """Return the JSON of a path in our own layout, and notes.

    Also converts nerfstudio's camera_path.json and transforms.json, and 3DGS's cameras.json.
    """
    if isinstance(found, list):
        return {
            "frames": [_convert_3dgs_frame(x, f"{file}: [{i}]") for i, x in enumerate(found)]
        }, ()
    if not isinstance(found, dict):
        raise DyngsError(f"{file}: must be a JSON object; see docs/reference/camera-paths.md")
    kind = str(found.get("camera_type", found.get("camera_model")))
    panoramic = ("fisheye", "equirectangular", "spherical", "omni", "vr180")
    if any(name in kind.lower() for name in panoramic):
        raise DyngsError(f"{file}: cameras must be pinholes, not {format_one_line(kind, 40)}")
    if "camera_path" in found:
        return _convert_nerfstudio(found, file), (
            "the nerfstudio path is read in coordinates of the capture; nerfstudio may have used "
            "others "
            "(dataparser_transforms.json)",
        )
    is_distorted = any(found.get(key) for key in ("k1", "k2", "k3", "k4", "p1", "p2"))
    return found, ("lens distortion is ignored",) if is_distorted else ()


def _convert_nerfstudio(found: dict[str, Any], file: Path) -> dict[str, Any]:
    """Convert a nerfstudio camera_path.json, whose fields of view are vertical, in degrees."""
    height = _number(found, "render_height", file, 1, 65536)
    views = found["camera_path"]
    frames = []
    for i, view in enumerate(views if isinstance(views, list) else []):
        where = f"{file}: camera_path[{i}]"
        pose = require_key(where, view, "camera_to_world")
        half = math.radians(_number(view, "fov", where, 0.01, 179)) / 2
        frame = {"transform_matrix": pose, "fl_x": 0.5 * height / math.tan(half)}
        frames.append(frame | {"time": view["render_time"]} if "render_time" in view else frame)
    size = {"width": found.get("render_width"), "height": height}
    return {**size, "fps": found.get("fps", 30.0), "frames": frames}


def _convert_3dgs_frame(view: object, where: str) -> dict[str, Any]:
    """Convert an entry of a 3DGS cameras.json, which stores camera positions and rotations in the
    world."""
    pose = np.eye(4)
    pose[:3, :3] = parse_numbers(
        f"{where}: 'rotation'", require_key(where, view, "rotation"), (3, 3)
    )
    pose[:3, 3] = parse_numbers(f"{where}: 'position'", require_key(where, view, "position"), (3,))
    names = {"w": "width", "h": "height", "fl_x": "fx", "fl_y": "fy"}
    others = {key: require_key(where, view, name) for key, name in names.items()}
    return {"cam_from_world": invert_rigid(pose), **others}


def _read_pose(frame: object, where: str) -> np.ndarray:
    """Return the world-to-camera pose (4, 4) of a frame."""
    fields = frame if isinstance(frame, dict) else {}
    given = [key for key in ("cam_from_world", "transform_matrix") if key in fields]
    if len(given) != 1:
        raise DyngsError(f"{where} needs exactly one of 'cam_from_world' and 'transform_matrix'")
    matrix = as_float_array(fields[given[0]])
    if matrix is not None and matrix.shape in ((12,), (16,)):
        matrix = matrix.reshape(-1, 4)
    pose, _ = validate_pose(np.zeros(0) if matrix is None else matrix, f"{where}: '{given[0]}'")
    return from_opengl_pose(pose) if given[0] == "transform_matrix" else pose


def _read_intrinsics(
    document: dict[str, Any], frame: dict[str, Any], size: tuple[int, int], where: str
) -> np.ndarray:
    """Return intrinsics (3, 3) in pixels from 'fl_x' [fl_y, cx, cy] or 'camera_angle_x'.

    Keys of the frame override those of the document.
    """
    width, height = size
    focal_keys = {"fl_x", "fl_y", "camera_angle_x"}
    replaced = set() if focal_keys.isdisjoint(frame) else focal_keys
    keys = {key: value for key, value in document.items() if key not in replaced} | frame
    focal_x = None
    if "camera_angle_x" in keys:
        angle = _number(keys, "camera_angle_x", where, 1e-4, 3.14)
        focal_x = 0.5 * width / math.tan(0.5 * angle)
    focal_x = _number(keys, "fl_x", where, 1e-3, 1e9, focal_x)
    focal_y = _number(keys, "fl_y", where, 1e-3, 1e9, focal_x)
    cx = _number(keys, "cx", where, -1e9, 1e9, 0.5 * width)
    cy = _number(keys, "cy", where, -1e9, 1e9, 0.5 * height)
    return pinhole_matrix(focal_x, focal_y, cx, cy)


def _number(
    keys: dict[str, Any],
    key: str,
    where: object,
    low: float,
    high: float,
    default: float | None = None,
) -> float:
    """Return the number at ``key``. Raises DyngsError unless it is in [low, high]."""
    value = keys.get(key, default)
    if not is_number(value) or not low <= value <= high:
        problem = "is missing" if value is None else f"is {format_one_line(repr(value), 60)}"
        raise DyngsError(f"{where}: '{key}' {problem}; must be a number from {low:g} to {high:g}")
    return float(value)


def _numbers_of_all(
    frames: list[dict[str, Any]], key: str, most: float, where: str
) -> np.ndarray | None:
    """Return the numbers (F,) at ``key`` in each of ``frames``, or None if no frame has the key."""
    if not any(key in frame for frame in frames):
        return None
    return np.array([_number(x, key, f"{where}[{i}]", -most, most) for i, x in enumerate(frames)])


# Keyframes


@dataclass(frozen=True)
class Keyframes:
    """K cameras at given seconds of a video.

    Attributes:
        cam_from_world: (K, 4, 4) rigid transforms, float64, OpenCV axes.
        intrinsics: (K, 3, 3) in pixels, positive focal lengths.
        seconds: (K,) strictly increasing.
        times: (K,) scene times, or None for a static scene.
        period: seconds of a loop, longer than the span of the keyframes. None without a loop.
    """

    cam_from_world: np.ndarray
    intrinsics: np.ndarray
    seconds: np.ndarray
    times: np.ndarray | None = None
    period: float | None = None


def _with_seconds(
    keys: Keyframes, document: dict[str, Any], fps: float, file: Path
) -> tuple[Keyframes, int]:
    """Return keyframes with seconds and period, and the number of frames.

    They are derived from the keys 'at', 'num_frames', 'seconds' and 'loop'.
    """
    loops = document.get("loop") is True
    num_frames = None
    if "num_frames" in document:
        num_frames = int(_number(document, "num_frames", file, 1, _MAX_FRAMES))
    elif "seconds" in document:
        num_frames = max(1, round(_number(document, "seconds", file, 1e-3, 1e6) * fps))
    count = len(keys.cam_from_world)
    at = _numbers_of_all(document["keyframes"], "at", 1e6, f"{file}: keyframes")
    if at is None:
        intervals = count if loops else max(count - 1, 1)
        length = float(intervals) if num_frames is None else (num_frames - (not loops)) / fps
        at = np.arange(count) * ((length or 1.0) / intervals)
    span = float(at[-1] - at[0])
    period = None
    if loops:
        return_seconds = span / (count - 1) if count > 1 else 1.0
        period = num_frames / fps if num_frames else span + return_seconds
    if at[0] < 0 or (np.diff(at) <= 0).any() or (period is not None and period <= span):
        raise DyngsError(
            f"{file}: 'at' of keyframes must increase, and stay below the length of a loop"
        )
    if num_frames is None:
        num_frames = round(at[-1] * fps) + 1 if period is None else max(1, round(period * fps))
    require_at_most(file, num_frames, _MAX_FRAMES, "frames")
    return replace(keys, seconds=at, period=period), num_frames


def interpolate_keyframes(keys: Keyframes, seconds: np.ndarray) -> Keyframes:
    """Return camera and scene time at each of ``seconds``; exact at the keyframes.

    Rotations use slerp (Shoemake 1985). Centres follow a cubic Hermite curve with non-uniform
    Catmull-Rom tangents. Tangents are shortened next to (nearly) equal keyframes, so that a fixed
    camera stays fixed. Focal lengths are interpolated geometrically, principal point and scene time
    linearly.

    Outside the keyframes the camera stays at the first or last one, or a loop repeats.
    """
    from scipy.interpolate import CubicHermiteSpline
    from scipy.spatial.transform import Rotation, Slerp

    count = len(keys.seconds)
    period = 1.0 if count == 1 else keys.period
    order = np.arange(count) if period is None else np.arange(-1, count + 2)
    index = order % count
    knots = keys.seconds[index]
    first = keys.seconds[0]
    if period is None:
        t = np.clip(seconds, first, knots[-1])
    else:
        knots = knots + period * (order // count)
        t = first + (np.asarray(seconds) - first) % period
    pose = keys.cam_from_world[index]
    centers = -np.einsum("kji,kj->ki", pose[:, :3, :3], pose[:, :3, 3])
    eyes = CubicHermiteSpline(knots, centers, _tangents(knots, centers))(t)
    poses = np.tile(np.eye(4), (len(t), 1, 1))
    poses[:, :3, :3] = Slerp(knots, Rotation.from_matrix(pose[:, :3, :3]))(t).as_matrix()
    poses[:, :3, 3] = -np.einsum("fij,fj->fi", poses[:, :3, :3], eyes)
    intrinsics = np.tile(np.eye(3), (len(t), 1, 1))
    for axis in (0, 1):
        focal = np.log(keys.intrinsics[index, axis, axis])
        intrinsics[:, axis, axis] = np.exp(np.interp(t, knots, focal))
        intrinsics[:, axis, 2] = np.interp(t, knots, keys.intrinsics[index, axis, 2])
    times = None if keys.times is None else np.interp(t, knots, keys.times[index])
    return Keyframes(poses, intrinsics, np.asarray(seconds), times)


def _tangents(knots: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Return the velocities (K, 3) of the curve through points (K, 3) at K >= 2 knots.

    They are at most three times the slower speed of the two neighbouring intervals.
    """
    steps = np.diff(knots)[:, None]
    slopes = np.diff(points, axis=0) / steps
    tangents = np.empty_like(points)
    tangents[1:-1] = (slopes[:-1] * steps[1:] + slopes[1:] * steps[:-1]) / (steps[1:] + steps[:-1])
    speeds = np.linalg.norm(slopes, axis=1)
    tangents[1:-1] = _limit_speed(tangents[1:-1], np.minimum(speeds[:-1], speeds[1:]))
    inner = tangents[[1, -2]] if len(points) > 2 else slopes[[0, 0]]
    # At the ends, use the parabola with the inner tangent.
    tangents[[0, -1]] = _limit_speed(2 * slopes[[0, -1]] - inner, speeds[[0, -1]])
    return tangents


def _limit_speed(vectors: np.ndarray, speeds: np.ndarray) -> np.ndarray:
    length = np.maximum(np.linalg.norm(vectors, axis=1), 1e-300)
    return vectors * np.minimum(3.0 * speeds / length, 1.0)[:, None]
