"""Camera paths for rendering: their scene times, JSON files (docs/camera_paths.md) of dyngs and of
other programs, and the interpolation of keyframes."""

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
from dyngs.io.fields import first_few, is_number, numbers_of, read_json, require_at_most
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


def with_times(path: CameraPath, times: Sequence[float], where: str = "times") -> CameraPath:
    """Return the path with other scene times, as many as cameras; those outside [0, 1] are clamped,
    with a warning."""
    if len(times) != len(path):
        raise DyngsError(
            f"the camera path has {len(path)} cameras, but there are {len(times)} times; give as many"
        )
    if not all(map(math.isfinite, times)):
        raise DyngsError(f"{where}: scene times must be finite numbers in [0, 1]")
    clamped = tuple(min(max(float(time), 0.0), 1.0) for time in times)
    outside = sum(not 0 <= time <= 1 for time in times)
    warnings = path.warnings
    if outside:
        extremes = f"from {min(times):g} to {max(times):g}"
        warnings = (
            *warnings,
            f"{where}: {outside} of {len(times)} scene times lie outside [0, 1] ({extremes}); clamped",
        )
    return replace(path, times=clamped, warnings=warnings)


def pick_cameras(cameras: Cameras, rows: Sequence[int] | np.ndarray) -> Cameras:
    """Return the cameras at ``rows``."""
    index = torch.as_tensor(rows, device=cameras.intrinsics.device)
    return replace(
        cameras, cam_from_world=cameras.cam_from_world[index], intrinsics=cameras.intrinsics[index]
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
        first, last, number = text.split(":")
        start, stop, count = float(first), float(last), int(number)
    except ValueError:
        raise DyngsError(f"{shown} is no range of times; {wanted}") from None
    if not (math.isfinite(start) and math.isfinite(stop)):
        raise DyngsError(f"{shown}: times must be finite; {wanted}")
    if not 1 <= count <= _MAX_FRAMES:
        raise DyngsError(f"{shown}: the count must be from 1 to {_MAX_FRAMES}; {wanted}")
    return tuple(np.linspace(start, stop, count).tolist())


def write_path(file: Path, path: CameraPath, world_offset: np.ndarray | None = None) -> None:
    """Write a path as JSON in the format of ``read_path``, atomically; ``world_offset`` as
    there."""
    cameras = path.cameras
    frames = []
    for i, matrix in enumerate(cameras.intrinsics.tolist()):
        pose = cameras.cam_from_world[i].detach().cpu().double().numpy()
        pose = pose if world_offset is None else world_pose(pose, world_offset)
        (fl_x, _, cx), (_, fl_y, cy), _ = matrix
        frame = {"cam_from_world": pose.tolist(), "fl_x": fl_x, "fl_y": fl_y, "cx": cx, "cy": cy}
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
    document, notes = _as_document(read_json(file), file)
    if size is not None:
        document = {"width": size[0], "height": size[1]} | document
    (name, *others) = [key for key in ("frames", "keyframes") if key in document] or ["frames"]
    frames = document.get(name)
    if others or not isinstance(frames, list) or not frames:
        raise DyngsError(
            f"{file}: a camera path needs one non-empty list, 'frames' or 'keyframes'; see docs"
        )
    require_at_most(file, len(frames), _MAX_FRAMES, "cameras")
    width = int(_number(document, "width", file, 1, 65536))
    height = int(_number(document, "height", file, 1, 65536))
    fps = _number(document, "fps", file, 1e-3, 1000, 30.0)
    poses = []
    matrices = []
    for i, frame in enumerate(frames):
        where = f"{file}: {name}[{i}]"
        if not isinstance(frame, dict):
            raise DyngsError(
                f"{where} must be an object with 'cam_from_world' or 'transform_matrix'"
            )
        pose = _read_pose(frame, where)
        if world_offset is not None:
            pose[:3, 3] += pose[:3, :3] @ world_offset
        poses.append(pose)
        matrices.append(_read_intrinsics(document, frame, (width, height), where))
    times = _numbers_of_all(frames, "time", (-1e9, 1e9), f"{file}: {name}")
    keys = Keyframes(np.stack(poses), np.stack(matrices), np.zeros(0), times)
    if name == "keyframes":
        keys, num_frames = _with_seconds(keys, document, fps, file)
        keys = interpolate_keyframes(keys, np.arange(num_frames) / fps)
    poses, matrices = (torch.from_numpy(x).float() for x in (keys.cam_from_world, keys.intrinsics))
    path = CameraPath(Cameras(poses, matrices, width, height), fps, notes=notes)
    return path if keys.times is None else with_times(path, keys.times.tolist(), str(file))


def _read_pose(frame: dict[str, Any], where: str) -> np.ndarray:
    """Return the world-to-camera pose (4, 4) of a frame; 12 or 16 numbers may stand in a row, of
    which 16 may come column by column."""
    given = [key for key in ("cam_from_world", "transform_matrix") if key in frame]
    if len(given) != 1:
        raise DyngsError(f"{where} needs exactly one of 'cam_from_world' and 'transform_matrix'")
    try:
        matrix = np.array(frame[given[0]], np.float64)
    except (TypeError, ValueError, OverflowError):
        raise DyngsError(f"{where}: '{given[0]}' must be a 4x4 or 3x4 matrix of numbers") from None
    if matrix.shape in ((12,), (16,)):
        matrix = matrix.reshape(-1, 4)
        if len(matrix) == 4 and matrix[3, :3].any() and not matrix[:3, 3].any():
            matrix = matrix.T
    pose, _ = checked_pose(matrix, f"{where}: '{given[0]}'")
    return cam_from_opengl(pose) if given[0] == "transform_matrix" else pose


def _read_intrinsics(
    document: dict[str, Any], frame: dict[str, Any], size: tuple[int, int], where: str
) -> np.ndarray:
    """Return intrinsics (3, 3) in pixels from 'fl_x' [fl_y, cx, cy] or 'camera_angle_x'; keys of
    the frame first."""
    width, height = size
    focal_keys = {"fl_x", "fl_y", "camera_angle_x"}
    replaced = set() if focal_keys.isdisjoint(frame) else focal_keys
    keys = {key: value for key, value in document.items() if key not in replaced} | frame
    if "fl_x" in keys:
        focal_x = _number(keys, "fl_x", where, 1e-3, 1e9)
    elif "camera_angle_x" in keys:
        angle = _number(keys, "camera_angle_x", where, 1e-4, 3.14)
        focal_x = 0.5 * width / math.tan(0.5 * angle)
    else:
        raise DyngsError(
            f"{where} needs 'fl_x' or 'camera_angle_x' (in the frame or once for the whole file)"
        )
    focal_y = _number(keys, "fl_y", where, 1e-3, 1e9, focal_x)
    cx = _number(keys, "cx", where, -1e9, 1e9, 0.5 * width)
    cy = _number(keys, "cy", where, -1e9, 1e9, 0.5 * height)
    return np.array([[focal_x, 0, cx], [0, focal_y, cy], [0, 0, 1]])


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
        problem = "is missing" if value is None else f"is {printable(repr(value), 60)}"
        raise DyngsError(
            f"{where}: '{key}' {problem}; it must be a number from {low:g} to {high:g}"
        )
    return float(value)


def _numbers_of_all(
    frames: list[dict[str, Any]], key: str, limits: tuple[float, float], where: str
) -> np.ndarray | None:
    """Return the numbers (F,) at ``key`` in each of ``frames``; None if none has it."""
    without = [i for i, frame in enumerate(frames) if key not in frame]
    if len(without) == len(frames):
        return None
    if without:
        raise DyngsError(
            f"{where}[{without[0]}] has no '{key}', others have; give it to all or to none"
        )
    return np.array([_number(x, key, f"{where}[{i}]", *limits) for i, x in enumerate(frames)])


# Keyframes: cameras that the path passes through.


@dataclass(frozen=True)
class Keyframes:
    """K cameras at given seconds of a video.

    Attributes:
        cam_from_world: (K, 4, 4) rigid transforms, float64, OpenCV axes.
        intrinsics: (K, 3, 3) in pixels, positive focal lengths.
        seconds: (K,) strictly increasing.
        times: (K,) scene times, or None for a static scene.
        period: seconds after which a loop is back at the first keyframe, more than the keyframes
            span; None: no loop.
    """

    cam_from_world: np.ndarray
    intrinsics: np.ndarray
    seconds: np.ndarray
    times: np.ndarray | None = None
    period: float | None = None


def _with_seconds(
    keys: Keyframes, document: dict[str, Any], fps: float, file: Path
) -> tuple[Keyframes, int]:
    """Return keyframes with seconds and period, and the number of frames, by 'at', 'num_frames',
    'seconds', 'loop'."""
    loop = document.get("loop", False)
    if not isinstance(loop, bool):
        raise DyngsError(f"{file}: 'loop' is {loop!r}; it must be true or false")
    num_frames = None
    if "num_frames" in document and "seconds" in document:
        raise DyngsError(
            f"{file}: 'num_frames' and 'seconds' both set the length of the video; give one of them"
        )
    if "seconds" in document:
        num_frames = max(1, round(_number(document, "seconds", file, 1e-3, 1e6) * fps))
    elif "num_frames" in document:
        number = _number(document, "num_frames", file, 1, _MAX_FRAMES)
        num_frames = int(number)
        if number != num_frames:
            raise DyngsError(f"{file}: 'num_frames' is {number:g}; it must be a whole number")
    count = len(keys.cam_from_world)
    at = _numbers_of_all(document["keyframes"], "at", (0, 1e6), f"{file}: keyframes")
    if at is None:
        intervals = count if loop else max(count - 1, 1)
        length = float(intervals) if num_frames is None else (num_frames - (not loop)) / fps
        at = np.arange(count) * ((length or 1.0) / intervals)
    elif (np.diff(at) <= 0).any():
        i = int(np.argmax(np.diff(at) <= 0)) + 1
        raise DyngsError(
            f"{file}: keyframes[{i}] is 'at' {at[i]:g} s, not after the one before; put them in order"
        )
    span = float(at[-1] - at[0])
    period = None
    if loop:
        way_back = span / (count - 1) if count > 1 else 1.0
        period = num_frames / fps if num_frames else span + way_back
        if period <= span:
            raise DyngsError(
                f"{file}: the loop takes {period:g} s, but its keyframes {span:g} s; make it longer"
            )
    if num_frames is None:
        num_frames = round(at[-1] * fps) + 1 if period is None else max(1, round(period * fps))
    if num_frames > _MAX_FRAMES:
        raise DyngsError(
            f"{file}: would be {num_frames} frames; at most {_MAX_FRAMES}: lower 'at', 'seconds' or 'fps'"
        )
    return replace(keys, seconds=at, period=period), num_frames


def interpolate_keyframes(keys: Keyframes, seconds: np.ndarray) -> Keyframes:
    """Return camera and scene time at each of ``seconds``; exact at the keyframes.

    Rotations are interpolated the shorter way by slerp (Shoemake 1985). Centres follow a cubic
    Hermite curve with Catmull-Rom tangents for non-uniform knots, with continuous velocity; a
    tangent is shortened where the camera (nearly) rests on one side of a keyframe, so that equal
    keyframes give a fixed camera. Focal lengths are interpolated geometrically, the principal point
    and the scene time linearly.

    Before the first and after the last of K >= 1 keyframes the camera rests, a loop repeats.
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
    made = np.tile(np.eye(4), (len(t), 1, 1))
    made[:, :3, :3] = Slerp(knots, Rotation.from_matrix(pose[:, :3, :3]))(t).as_matrix()
    made[:, :3, 3] = -np.einsum("fij,fj->fi", made[:, :3, :3], eyes)
    intrinsics = np.tile(np.eye(3), (len(t), 1, 1))
    for axis in (0, 1):
        focal = np.log(keys.intrinsics[index, axis, axis])
        intrinsics[:, axis, axis] = np.exp(np.interp(t, knots, focal))
        intrinsics[:, axis, 2] = np.interp(t, knots, keys.intrinsics[index, axis, 2])
    times = None if keys.times is None else np.interp(t, knots, keys.times[index])
    return Keyframes(made, intrinsics, np.asarray(seconds), times)


def _tangents(knots: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Return the velocities (K, 3) of the curve through points (K, 3) at K >= 2 knots: at most
    three times as fast as the slower of the two neighbouring intervals."""
    steps = np.diff(knots)[:, None]
    slopes = np.diff(points, axis=0) / steps
    tangents = np.empty_like(points)
    tangents[1:-1] = (slopes[:-1] * steps[1:] + slopes[1:] * steps[:-1]) / (steps[1:] + steps[:-1])
    speeds = np.linalg.norm(slopes, axis=1)
    tangents[1:-1] = _shortened(tangents[1:-1], np.minimum(speeds[:-1], speeds[1:]))
    inner = tangents[[1, -2]] if len(points) > 2 else slopes[[0, 0]]
    # The ends are those of the parabola with the inner tangent.
    tangents[[0, -1]] = _shortened(2 * slopes[[0, -1]] - inner, speeds[[0, -1]])
    return tangents


def _shortened(vectors: np.ndarray, speeds: np.ndarray) -> np.ndarray:
    length = np.maximum(np.linalg.norm(vectors, axis=1), 1e-300)
    return vectors * np.minimum(3.0 * speeds / length, 1.0)[:, None]


# Paths of other programs, rewritten as documents of our own.


def _as_document(found: object, file: Path) -> tuple[dict[str, Any], tuple[str, ...]]:
    """Return what the JSON of a camera path holds as a document with 'width', 'height' and
    'frames', and notes: of nerfstudio's ``camera_path.json`` and ``transforms.json``, and of the
    ``cameras.json`` of 3DGS.

    What is no path of another program stays as it is. Raises DyngsError: a path that cannot be
    read.
    """
    if isinstance(found, list):
        return _of_3dgs(_listed(found, file), file), ()
    if not isinstance(found, dict):
        raise DyngsError(f"{file}: a camera path is a JSON object; see docs/camera_paths.md")
    kind = found.get("camera_type", found.get("camera_model"))
    panoramic = ("fisheye", "equirectangular", "spherical", "omni", "vr180")
    if isinstance(kind, str) and any(name in kind.lower() for name in panoramic):
        raise DyngsError(
            f"{file}: its cameras are {printable(kind, 40)}; cameras of a path are pinholes"
        )
    if "camera_path" in found:
        note = (
            "nerfstudio's path is taken to be in the coordinates of the capture; its viewer has others if it turned, "
            "shifted or scaled the capture (dataparser_transforms.json)"
        )
        return _of_nerfstudio(found, _listed(found["camera_path"], file), file), (note,)
    if "path" in found and "frames" not in found:
        raise DyngsError(
            f"{file}: a path of instant-ngp is in coordinates of its own, which the file does not state; export the "
            "cameras as transforms.json"
        )
    frames = found.get("frames")
    frames = frames if isinstance(frames, list) else []
    sizes = [(x["w"], x.get("h")) for x in frames if isinstance(x, dict) and "w" in x]
    if any(size != sizes[0] for size in sizes):
        raise DyngsError(f"{file}: its images differ in size; all images of a path have one size")
    width, height = sizes[0] if sizes else (found.get("w"), found.get("h"))
    size = {"width": width, "height": height} if width is not None else {}
    bent = [key for key in ("k1", "k2", "k3", "k4", "p1", "p2") if found.get(key)]
    note = f"the lens distortion ({first_few(bent)}) is left out: cameras of a path are pinholes"
    return size | found, (note,) if bent else ()


def _of_nerfstudio(
    found: dict[str, Any], views: list[dict[str, Any]], file: Path
) -> dict[str, Any]:
    """Return the document of a camera_path.json; its fields of view are vertical, in degrees."""
    height = _number(found, "render_height", file, 1, 65536)
    frames = []
    for i, view in enumerate(views):
        where = f"{file}: camera_path[{i}]"
        degrees = _number({"fov": found.get("default_fov")} | view, "fov", where, 0.01, 179)
        frame = {
            "transform_matrix": view.get("camera_to_world"),
            "fl_x": 0.5 * height / math.tan(math.radians(degrees) / 2),
        }
        frames.append(frame | {"time": view["render_time"]} if "render_time" in view else frame)
    size = {"width": found.get("render_width"), "height": height}
    return {**size, "fps": found.get("fps", 30.0), "frames": frames}


def _of_3dgs(views: list[dict[str, Any]], file: Path) -> dict[str, Any]:
    """Return the document of a cameras.json; its positions and rotations are those of cameras in
    the world."""
    size = {key: views[0].get(key) for key in ("width", "height")}
    frames = []
    for i, view in enumerate(views):
        where = f"{file}: [{i}]"
        if any(view.get(key) != value for key, value in size.items()):
            raise DyngsError(
                f"{where}: has another size than the first camera; all images of a path have one size"
            )
        pose = np.eye(4)
        pose[:3, :3] = numbers_of(f"{where}: 'rotation'", view.get("rotation"), (3, 3)).T
        eye = numbers_of(f"{where}: 'position'", view.get("position"), (3,))
        pose[:3, 3] = -pose[:3, :3] @ eye
        focal = {"fl_x": view.get("fx"), "fl_y": view.get("fy")}
        frames.append({"cam_from_world": pose.tolist()} | focal)
    return {**size, "frames": frames}


def _listed(views: object, file: Path) -> list[dict[str, Any]]:
    is_list = isinstance(views, list) and views and all(isinstance(view, dict) for view in views)
    if not is_list:
        raise DyngsError(
            f"{file}: a camera path needs a list of cameras, each an object; export it again"
        )
    return views  # type: ignore[return-value]
