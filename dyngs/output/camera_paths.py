"""Camera paths for rendering: orbits, spirals, and JSON files (docs/camera_paths.md)."""

from __future__ import annotations

import json
import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch

from dyngs.camera import Cameras
from dyngs.data.geometry.focus import focus_point, share_in_front
from dyngs.data.geometry.poses import cam_from_opengl, checked_pose
from dyngs.errors import DyngsError, printable, require_regular
from dyngs.files.write import write_text
from dyngs.output.keyframes import Keyframes, interpolate_keyframes

_MAX_FRAMES = 100_000
"""A longer path is taken for a typing mistake."""


@dataclass(frozen=True)
class CameraPath:
    """Cameras in the order of the frames.

    Attributes:
        cameras: F cameras.
        fps: frames per second.
        times: (F,) scene times in [0, 1], or None for a still scene.
        warnings: messages about changed input.
    """

    cameras: Cameras
    fps: float = 30.0
    times: tuple[float, ...] | None = None
    warnings: tuple[str, ...] = ()

    def __len__(self) -> int:
        return len(self.cameras)


def with_times(path: CameraPath, times: Sequence[float]) -> CameraPath:
    """Return the path with other scene times.

    Args:
        path: F cameras.
        times: F scene times; those outside [0, 1] are clamped, with a warning.

    Raises:
        DyngsError: another number of times than cameras, or a time that is not finite.
    """
    if len(times) != len(path):
        raise DyngsError(f"the camera path has {len(path)} cameras, but there are {len(times)} times; give as many")
    clamped, warnings = _clamped(times, "times")
    return replace(path, times=clamped, warnings=path.warnings + warnings)


def static_path(camera: Cameras, times: Sequence[float], fps: float = 30.0) -> CameraPath:
    """Return the path of one fixed camera at many scene times.

    Args:
        camera: one camera.
        times: F >= 1 scene times, as in ``with_times``.
        fps: frames per second.
    """
    if len(camera) != 1:
        raise ValueError(f"a static path needs one camera, got {len(camera)}")
    poses, intrinsics = (x.expand(len(times), *x.shape[1:]).clone() for x in (camera.cam_from_world, camera.intrinsics))
    return with_times(CameraPath(Cameras(poses, intrinsics, camera.width, camera.height), fps), times)


def parse_times(text: str) -> tuple[float, ...]:
    """Return COUNT evenly spaced times from ``START:STOP:COUNT``, both ends included; a single one is START.

    Raises:
        DyngsError: ``text`` is anything else.
    """
    wanted = "write START:STOP:COUNT, for instance 0:1:60 for 60 evenly spaced times"
    shown = printable(repr(text), 60)
    try:
        start, stop, count = (kind(part) for kind, part in zip((float, float, int), text.split(":"), strict=True))
    except ValueError:
        raise DyngsError(f"{shown} is no range of times; {wanted}") from None
    if not (math.isfinite(start) and math.isfinite(stop)):
        raise DyngsError(f"{shown}: times must be finite; {wanted}")
    if not 1 <= count <= _MAX_FRAMES:
        raise DyngsError(f"{shown}: the count must be from 1 to {_MAX_FRAMES}; {wanted}")
    return tuple(np.linspace(start, stop, int(count)).tolist())


def orbit_path(cameras: Cameras, num_frames: int, turns: float = 1.0) -> Cameras:
    """Return cameras on a level circle around the point that the given ``cameras`` look at.

    Radius, height and up direction are means over the given cameras; intrinsics are those of the first. A ring of
    cameras gives the ring itself; cameras that all face one way give a circle through their side of the scene.

    Args:
        cameras: V >= 1 cameras, usually those of training.
        num_frames: F; frame 0 is at the azimuth of the first camera.
        turns: number of full circles; negative: in the other direction.
    """
    poses = _world_from_cam(cameras)
    centers, up = poses[:, :3, 3], mean_up(cameras)
    center = look_at_point(cameras)
    offsets = centers - center
    heights = offsets @ up
    level = offsets - heights[:, None] * up
    radius = np.linalg.norm(level, axis=1).mean()
    first = level[np.argmax(np.linalg.norm(level, axis=1) > 1e-6)]
    axis_x = _unit(first) if np.linalg.norm(first) > 1e-6 else _perpendicular(up)
    radius = max(radius, 0.1 * float(np.linalg.norm(offsets, axis=1).mean()), 1e-6)
    return _circle(center + heights.mean() * up, center, up, axis_x * radius, _Frames(cameras, num_frames, turns))


def spiral_path(cameras: Cameras, num_frames: int, turns: float = 2.0, zoom: float = 0.5) -> Cameras:
    """Return cameras on a closed spiral in front of a scene seen from one side, as in LLFF.

    The spiral is centred on the mean camera and as wide as the 90% quantile of the distances of the given cameras from
    it; all cameras look at the same point.

    Args:
        cameras: V >= 1 cameras, roughly facing one way.
        num_frames: F.
        turns: circles per loop.
        zoom: extent along the viewing axis, relative to the width of the spiral.
    """
    poses = _world_from_cam(cameras)
    centers, target, up = poses[:, :3, 3], look_at_point(cameras), mean_up(cameras)
    middle = centers.mean(axis=0)
    base = look_at(middle, target, up)
    radii = np.quantile(np.abs((centers - middle) @ base[:3, :3]), 0.9, axis=0)
    distance = np.linalg.norm(target - middle)
    radii = np.maximum(radii, 0.02 * distance)
    radii[2] = min(zoom * radii.max(), 0.3 * distance)
    phase = 2 * np.pi * np.arange(num_frames) / max(num_frames, 1)
    local = np.stack([np.cos(turns * phase), -np.sin(turns * phase), np.sin(phase)], axis=-1) * radii
    eyes = middle + local @ base[:3, :3].T
    return _with_poses(cameras, np.stack([look_at(eye, target, up) for eye in eyes]))


def frame_orbit_for_points(
    means: np.ndarray, num_frames: int, size: tuple[int, int] = (960, 720), up: tuple[float, float, float] = (0, 0, 1)
) -> Cameras:
    """Return an orbit around a set of points whose robust extent fills the picture.

    The centre is the median. The extent is the sphere around it that holds 99% of the points within the 1st to 99th
    percentile of every axis, so that outliers have no effect.

    Args:
        means: (N, 3) points in world units; non-finite ones are ignored.
        num_frames: F.
        size: width and height in pixels.
        up: up direction of the world; (0, -1, 0) for many COLMAP captures.

    Raises:
        DyngsError: no finite point, or a zero up direction.
    """
    points = np.asarray(means, np.float64).reshape(-1, 3)
    points = points[np.isfinite(points).all(axis=1)]
    if not len(points):
        raise DyngsError("cannot place an orbit: there are no points with finite coordinates")
    if not np.linalg.norm(up) > 0:
        raise DyngsError(f"cannot place an orbit: the up direction {up} has no length")
    low, high = np.quantile(points, [0.01, 0.99], axis=0)
    inside = points[((points >= low) & (points <= high)).all(axis=1)]
    points = inside if len(inside) else points
    center = np.median(points, axis=0)
    extent = max(float(np.quantile(np.linalg.norm(points - center, axis=1), 0.99)), 1e-3)
    width, height = size
    half_fov = math.radians(25.0)
    focal = 0.5 * max(width, height) / math.tan(half_fov)
    narrow = math.atan(0.5 * min(width, height) / focal)
    matrix = [[focal, 0, 0.5 * width], [0, focal, 0.5 * height], [0, 0, 1]]
    intrinsics = torch.tensor(matrix, dtype=torch.float32, device="cpu")
    distance = 0.85 * extent / math.sin(narrow)
    axis_z = _unit(np.asarray(up, np.float64))
    elevation = math.radians(20.0)
    template = Cameras(torch.eye(4, device="cpu")[None], intrinsics[None], width, height)
    eye_height = center + distance * math.sin(elevation) * axis_z
    arm = distance * math.cos(elevation) * _perpendicular(axis_z)
    return _circle(eye_height, center, axis_z, arm, _Frames(template, num_frames, 1.0))


def look_at_point(cameras: Cameras) -> np.ndarray:
    """Return the point (3,) float64 nearest to all optical axes in the least-squares sense, in front of the cameras.

    (Nearly) parallel axes do not determine it: then it lies in front of the mean camera, at three times the spread of
    the cameras (1 if they coincide).
    """
    poses = _world_from_cam(cameras)
    centers, axes = poses[:, :3, 3], poses[:, :3, 2]
    middle = centers.mean(axis=0)
    spread = float(np.linalg.norm(centers - middle, axis=1).mean())
    point = focus_point(poses)
    if point is not None and share_in_front(poses, point) > 0.5:
        return point
    mean_axis = axes.mean(axis=0)
    forward = _unit(mean_axis) if np.linalg.norm(mean_axis) > 1e-6 else axes[0]
    return middle + 3.0 * (spread if spread > 1e-9 else 1.0) * forward


def mean_up(cameras: Cameras) -> np.ndarray:
    """Return the mean up direction (minus y) of the cameras, (3,); that of the first camera if they cancel."""
    ups = -_world_from_cam(cameras)[:, :3, 1]
    total = ups.mean(axis=0)
    return _unit(total) if np.linalg.norm(total) > 1e-3 else ups[0]


def look_at(eye: np.ndarray, target: np.ndarray, up: np.ndarray) -> np.ndarray:
    """Return the OpenCV camera-to-world pose (4, 4) at ``eye``, z towards ``target``, y away from ``up``."""
    forward = target - eye
    forward = _unit(forward) if np.linalg.norm(forward) > 1e-12 else _perpendicular(up)
    right = np.cross(forward, up)
    right = _unit(right) if np.linalg.norm(right) > 1e-6 * np.linalg.norm(up) else _perpendicular(forward)
    pose = np.eye(4)
    pose[:3, 0], pose[:3, 1], pose[:3, 2], pose[:3, 3] = right, np.cross(forward, right), forward, eye
    return pose


def write_path(file: Path, path: CameraPath, world_offset: np.ndarray | None = None) -> None:
    """Write a path as JSON in the format of ``read_path``, atomically; ``world_offset`` as there."""
    cameras = path.cameras
    poses = _rebased(cameras.cam_from_world.detach().cpu().double().numpy(), world_offset, sign=-1.0)
    frames = []
    for i in range(len(cameras)):
        k = cameras.intrinsics[i].tolist()
        frame: dict[str, Any] = {"cam_from_world": poses[i].tolist()}
        frame |= {"fl_x": k[0][0], "fl_y": k[1][1], "cx": k[0][2], "cy": k[1][2]}
        if path.times is not None:
            frame["time"] = path.times[i]
        frames.append(frame)
    document = {"width": cameras.width, "height": cameras.height, "fps": path.fps, "frames": frames}
    write_text(file, json.dumps(document, indent=1) + "\n")


def read_path(file: Path, world_offset: np.ndarray | None = None) -> CameraPath:
    """Read a camera path from a JSON file; cameras are float32 on the CPU.

    Args:
        file: see docs/camera_paths.md.
        world_offset: (3,) ``Capture.world_offset``: the file is in the coordinates of the capture, the returned cameras
            are in the rebased world.

    Raises:
        DyngsError: names the file, the frame and the key that is missing or wrong.
    """
    require_regular(file)
    try:
        document = json.loads(file.read_text(encoding="utf-8"))
    except OSError as error:
        raise DyngsError(f"cannot read the camera path {file}: {error.strerror or error}") from error
    except (ValueError, RecursionError) as error:
        raise DyngsError(f"{file} is not a JSON file ({error}); see docs/camera_paths.md for the format") from error
    if not isinstance(document, dict):
        raise DyngsError(f"{file}: a camera path is a JSON object with a list 'frames'; see docs/camera_paths.md")
    given = [name for name in ("frames", "keyframes") if name in document]
    if len(given) != 1 or not isinstance(document[given[0]], list) or not document[given[0]]:
        raise DyngsError(f"{file}: a camera path needs one non-empty list, 'frames' or 'keyframes'; see docs")
    width, height = (int(_number(document, key, str(file), low=1, high=65536)) for key in ("width", "height"))
    fps = _number(document, "fps", str(file), low=1e-3, high=1000, default=30.0)
    poses, intrinsics, times = _read_cameras(document, given[0], (width, height), file)
    poses = _rebased(poses, world_offset, sign=1.0)
    if given[0] == "keyframes":
        keys, num_frames = _read_keyframes(document, Keyframes(poses, intrinsics, np.zeros(0), times), fps, file)
        made = interpolate_keyframes(keys, np.arange(num_frames) / fps)
        poses, intrinsics, times = made.cam_from_world, made.intrinsics, made.times
    cameras = Cameras(torch.from_numpy(poses).float(), torch.from_numpy(intrinsics).float(), width, height)
    path = CameraPath(cameras, fps)
    if times is None:
        return path
    clamped, warnings = _clamped(times.tolist(), str(file))
    return replace(path, times=clamped, warnings=warnings)


@dataclass(frozen=True)
class _Frames:
    """Intrinsics of a circle of cameras, number of frames and of turns."""

    cameras: Cameras
    num_frames: int
    turns: float


def _circle(hub: np.ndarray, target: np.ndarray, up: np.ndarray, arm: np.ndarray, frames: _Frames) -> Cameras:
    """Return cameras around ``hub`` that look at ``target``, the first one at ``hub + arm``."""
    angles = 2 * np.pi * frames.turns * np.arange(frames.num_frames) / max(frames.num_frames, 1)
    eyes = hub + np.cos(angles)[:, None] * arm + np.sin(angles)[:, None] * np.cross(up, arm)
    return _with_poses(frames.cameras, np.stack([look_at(eye, target, up) for eye in eyes]))


def _with_poses(cameras: Cameras, world_from_cam: np.ndarray) -> Cameras:
    """Return cameras at new poses with intrinsics, dtype and device of the first of ``cameras``."""
    cam_from_world = torch.from_numpy(np.linalg.inv(world_from_cam)).to(cameras.cam_from_world)
    intrinsics = cameras.intrinsics[:1].expand(len(cam_from_world), 3, 3).clone()
    return Cameras(cam_from_world, intrinsics, cameras.width, cameras.height)


def _world_from_cam(cameras: Cameras) -> np.ndarray:
    """Return camera-to-world poses (V, 4, 4), float64."""
    if not len(cameras):
        raise ValueError("a camera path is placed by at least one camera")
    return np.linalg.inv(cameras.cam_from_world.detach().cpu().double().numpy())


def _rebased(cam_from_world: np.ndarray, world_offset: np.ndarray | None, sign: float) -> np.ndarray:
    """Return poses (F, 4, 4) for a world shifted by minus (sign 1) or plus (sign -1) the offset."""
    moved = cam_from_world.copy()
    if world_offset is not None:
        moved[:, :3, 3] += sign * moved[:, :3, :3] @ world_offset
    return moved


def _read_cameras(
    document: dict[str, Any], name: str, size: tuple[int, int], file: Path
) -> tuple[np.ndarray, np.ndarray, np.ndarray | None]:
    """Return world-to-camera poses (F, 4, 4), intrinsics (F, 3, 3) and times (F,), if any, of the list ``name``."""
    poses, matrices = [], []
    for i, frame in enumerate(document[name]):
        where = f"{file}: {name}[{i}]"
        if not isinstance(frame, dict):
            raise DyngsError(f"{where} must be an object with 'cam_from_world' or 'transform_matrix'")
        poses.append(_read_pose(frame, where))
        matrices.append(_read_intrinsics(document, frame, size, where))
    times = _numbers_of_all(document, name, "time", (-1e9, 1e9), file)
    return np.stack(poses), np.stack(matrices), times


def _numbers_of_all(
    document: dict[str, Any], name: str, key: str, limits: tuple[float, float], file: Path
) -> np.ndarray | None:
    """Return the numbers (F,) at ``key`` in each object of the list ``name``; None if none has it."""
    frames = document[name]
    without = [i for i, frame in enumerate(frames) if key not in frame]
    if without and len(without) < len(frames):
        raise DyngsError(f"{file}: {name}[{without[0]}] has no '{key}', others have; give it to all or to none")
    low, high = limits
    found = [
        _number(frame, key, f"{file}: {name}[{i}]", low=low, high=high) for i, frame in enumerate(frames) if not without
    ]
    return np.array(found) if found else None


def _read_keyframes(document: dict[str, Any], keys: Keyframes, fps: float, file: Path) -> tuple[Keyframes, int]:
    """Return keyframes with seconds and period, and the number of frames, by 'at', 'num_frames', 'seconds', 'loop'."""
    loop, count = document.get("loop", False), len(keys.cam_from_world)
    if not isinstance(loop, bool):
        raise DyngsError(f"{file}: 'loop' is {loop!r}; it must be true or false")
    at = _numbers_of_all(document, "keyframes", "at", (0, 1e6), file)
    if at is not None and (np.diff(at) <= 0).any():
        i = int(np.argmax(np.diff(at) <= 0)) + 1
        raise DyngsError(f"{file}: keyframes[{i}] is 'at' {at[i]:g} s, not after the one before; put them in order")
    num_frames = _read_num_frames(document, fps, file)
    if at is None:
        intervals = count if loop else max(count - 1, 1)
        length = float(intervals) if num_frames is None else (num_frames - (not loop)) / fps
        at = np.arange(count) * ((length or 1.0) / intervals)
    span = float(at[-1] - at[0])
    if not loop:
        period, shown = None, num_frames or round(at[-1] * fps) + 1
    else:
        period = num_frames / fps if num_frames else span * count / (count - 1) if count > 1 else 1.0
        shown = num_frames or max(1, round(period * fps))
        if period <= span:
            raise DyngsError(f"{file}: the loop takes {period:g} s, but its keyframes {span:g} s; make it longer")
    if shown > _MAX_FRAMES:
        raise DyngsError(f"{file}: would be {shown} frames; at most {_MAX_FRAMES}: lower 'at', 'seconds' or 'fps'")
    return replace(keys, seconds=at, period=period), shown


def _read_num_frames(document: dict[str, Any], fps: float, file: Path) -> int | None:
    """Return the number of frames by 'num_frames' or 'seconds'; None if neither is given."""
    if "num_frames" in document and "seconds" in document:
        raise DyngsError(f"{file}: 'num_frames' and 'seconds' both set the length of the video; give one of them")
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
    return clamped, (f"{where}: {len(outside)} of {len(times)} scene times lie outside [0, 1] ({extremes}); clamped",)


def _read_pose(frame: dict[str, Any], where: str) -> np.ndarray:
    """Return the world-to-camera pose (4, 4) of a frame.

    Raises:
        DyngsError: it is missing or not rigid.
    """
    given = [key for key in ("cam_from_world", "transform_matrix") if key in frame]
    if len(given) != 1:
        raise DyngsError(f"{where} needs exactly one of 'cam_from_world' and 'transform_matrix'")
    try:
        matrix = np.array(frame[given[0]], np.float64)
    except (TypeError, ValueError):
        raise DyngsError(f"{where}: '{given[0]}' must be a 4x4 or 3x4 matrix of numbers") from None
    pose, _ = checked_pose(matrix, f"{where}: '{given[0]}'")
    return cam_from_opengl(pose) if given[0] == "transform_matrix" else pose


def _read_intrinsics(document: dict[str, Any], frame: dict[str, Any], size: tuple[int, int], where: str) -> np.ndarray:
    """Return intrinsics (3, 3) in pixels from 'fl_x' [fl_y, cx, cy] or 'camera_angle_x'; keys of the frame first."""
    width, height = size
    focal_keys = {"fl_x", "fl_y", "camera_angle_x"}
    own_focal = not focal_keys.isdisjoint(frame)
    keys = {key: value for key, value in document.items() if not (own_focal and key in focal_keys)} | frame
    if "fl_x" in keys:
        focal_x = _number(keys, "fl_x", where, low=1e-3, high=1e9)
    elif "camera_angle_x" in keys:
        focal_x = 0.5 * width / math.tan(0.5 * _number(keys, "camera_angle_x", where, low=1e-4, high=3.14))
    else:
        raise DyngsError(f"{where} needs 'fl_x' or 'camera_angle_x' (in the frame or once for the whole file)")
    focal_y = _number(keys, "fl_y", where, low=1e-3, high=1e9, default=focal_x)
    cx = _number(keys, "cx", where, low=-1e9, high=1e9, default=0.5 * width)
    cy = _number(keys, "cy", where, low=-1e9, high=1e9, default=0.5 * height)
    return np.array([[focal_x, 0, cx], [0, focal_y, cy], [0, 0, 1]])


def _number(
    keys: dict[str, Any], key: str, where: str, *, low: float, high: float, default: float | None = None
) -> float:
    """Return the number at ``key``. Raises DyngsError unless it is in [low, high]."""
    value = keys.get(key, default)
    if isinstance(value, bool) or not isinstance(value, (int, float)) or not low <= value <= high:
        problem = "is missing" if value is None else f"is {printable(repr(value), 60)}"
        raise DyngsError(f"{where}: '{key}' {problem}; it must be a number from {low:g} to {high:g}")
    return float(value)


def _unit(a: np.ndarray) -> np.ndarray:
    return a / np.linalg.norm(a)


def _perpendicular(a: np.ndarray) -> np.ndarray:
    """Return a unit vector perpendicular to ``a``."""
    other = np.eye(3)[np.abs(a).argmin()]
    return _unit(np.cross(a, other))
