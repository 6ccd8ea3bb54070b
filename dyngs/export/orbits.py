"""Camera paths that are placed by the cameras of a capture or by points: orbit, spiral, along."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
import torch

from dyngs.core.camera import Cameras
from dyngs.core.errors import DyngsError
from dyngs.data.aim import (
    look_at,
    look_at_point,
    perpendicular,
    unit,
    up_direction,
    with_poses,
    world_from_cam,
)
from dyngs.data.geometry import fraction_in_front
from dyngs.export.camera_paths import CameraPath

_WIDEST_GAP = math.radians(100)
"""Nobody has seen the scene from a gap between cameras that is wider than this."""
_EVEN = 1.3
"""A gap of at most this many mean distances between neighbours belongs to a ring of few cameras."""
_NARROWEST_ARC = math.radians(10)
"""An orbit of a capture that was filmed from one place swings by this, or it would stand still."""
_MOST_CAMERAS = 500
"""Of more cameras so many are followed, evenly spread: the path is smoothed anyway."""
_SMOOTHED_CAMERAS = 2.0
"""Standard deviation of the smoothing, in mean distances between cameras that follow each other."""
_DETOUR = 2.0
"""Cameras are visited in the order of the capture if that is at most so much longer than a short
way through all of them."""


def orbit_path(
    cameras: Cameras, num_frames: int, up: np.ndarray | None = None
) -> tuple[CameraPath, bool]:
    """Return a path on a level circle around the point that V >= 1 ``cameras`` look at, and whether
    they stand all around it.

    ``up`` (3,) is the axis. Radius and height are means over the cameras; intrinsics, and the
    azimuth of frame 0, are those of the first. Cameras on an arc, with nobody behind: the path
    swings from its middle to one end, to the other, and back, at the radius and height of the
    cameras near. A note says so.
    """
    poses = world_from_cam(cameras)
    center = look_at_point(cameras)
    up = up_direction(cameras) if up is None else unit(np.asarray(up, np.float64))
    offsets = poses[:, :3, 3] - center
    heights = offsets @ up
    flat = offsets - heights[:, None] * up
    radii = np.linalg.norm(flat, axis=1)
    # Cameras straight above or below the point have no azimuth.
    beside = np.flatnonzero(radii > 1e-6 * np.linalg.norm(offsets, axis=1).max())
    axis_x = unit(flat[beside[0]]) if len(beside) else perpendicular(up)
    axis_y = np.cross(up, axis_x)
    angles = np.arctan2(flat @ axis_y, flat @ axis_x)
    middle, width = _arc(angles[beside]) if len(beside) else (0.0, None)
    turn = 2 * np.pi * np.arange(num_frames) / max(num_frames, 1)
    smallest = 0.1 * float(np.hypot(radii, heights).mean())
    notes = ()
    if width is None:
        azimuths = turn
        radii = np.full(num_frames, radii.mean())
        heights = np.full(num_frames, heights.mean())
    else:
        azimuths = 0.5 * max(width, _NARROWEST_ARC) * np.sin(turn)
        apart = azimuths[:, None] - ((angles - middle + np.pi) % (2 * np.pi) - np.pi)
        near = np.exp(-0.5 * (apart / max(width / 6, _NARROWEST_ARC)) ** 2)
        near /= near.sum(axis=1, keepdims=True)
        radii = near @ radii
        heights = near @ heights
        azimuths = azimuths + middle
        degrees = round(math.degrees(width))
        notes = (
            f"the capture was filmed from an arc of {degrees} degrees: the orbit swings along it and back",
        )
    if fraction_in_front(poses, center) < 0.5:
        notes = (
            "the cameras look outwards, an orbit shows little of that: --path along follows them",
        )
    arms = np.cos(azimuths)[:, None] * axis_x + np.sin(azimuths)[:, None] * axis_y
    eyes = center + heights[:, None] * up + np.maximum(radii, smallest)[:, None] * arms
    return CameraPath(_looking_at(cameras, eyes, center, up), notes=notes), width is None


def _arc(angles: np.ndarray) -> tuple[float, float | None]:
    """Return middle and width of the smallest arc that holds ``angles`` (V,), radians; no width:
    they go all around."""
    order = np.sort(angles)
    gaps = np.diff(np.append(order, order[0] + 2 * np.pi))
    widest = int(gaps.argmax())
    is_even = len(order) > 1 and gaps[widest] <= _EVEN * 2 * np.pi / len(order)
    if gaps[widest] <= _WIDEST_GAP or is_even:
        return 0.0, None
    width = 2 * np.pi - gaps[widest]
    return float(order[(widest + 1) % len(order)] + 0.5 * width), float(width)


def _looking_at(cameras: Cameras, eyes: np.ndarray, target: np.ndarray, up: np.ndarray) -> Cameras:
    return with_poses(cameras, np.stack([look_at(eye, target, up) for eye in eyes]))


def spiral_path(cameras: Cameras, num_frames: int, up: np.ndarray | None = None) -> Cameras:
    """Return cameras on a closed spiral in front of a scene seen from one side, as in LLFF.

    The spiral is centred on the mean of V >= 1 cameras, which roughly face one way, and as wide as
    the 90% quantile of their distances from it; all cameras look at the same point. It makes two
    circles, and moves by half its width along the viewing axis.
    """
    centers = world_from_cam(cameras)[:, :3, 3]
    target = look_at_point(cameras)
    up = up_direction(cameras) if up is None else up
    middle = centers.mean(axis=0)
    base = look_at(middle, target, up)[:3, :3]
    distance = np.linalg.norm(target - middle)
    radii = np.quantile(np.abs((centers - middle) @ base), 0.9, axis=0)
    radii = np.maximum(radii, 0.02 * distance)
    radii[2] = min(0.5 * radii.max(), 0.3 * distance)
    phase = 2 * np.pi * np.arange(num_frames) / max(num_frames, 1)
    local = np.stack([np.cos(2 * phase), -np.sin(2 * phase), np.sin(phase)], axis=-1)
    return _looking_at(cameras, middle + local * radii @ base.T, target, up)


def frame_orbit_for_points(
    means: np.ndarray,
    num_frames: int,
    size: tuple[int, int] = (960, 720),
    up: tuple[float, float, float] = (0, 0, 1),
    least: float = 0.0,
) -> Cameras:
    """Return an orbit around a set of points whose robust extent fills the image.

    The centre is the median. The extent is the sphere around it that holds 99% of the points (N, 3)
    within the 1st to 99th percentile of every axis, so that outliers have no effect; those that are
    not finite are ignored. It is ``least`` at least, such as the size of what the points stand for;
    1 where both are 0.

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
    extent = max(float(np.quantile(np.linalg.norm(points - center, axis=1), 0.99)), least) or 1.0
    width, height = size
    focal = 0.5 * max(width, height) / math.tan(math.radians(25.0))
    matrix = [[focal, 0, 0.5 * width], [0, focal, 0.5 * height], [0, 0, 1]]
    intrinsics = torch.tensor([matrix], dtype=torch.float32, device="cpu")
    template = Cameras(torch.eye(4, device="cpu")[None], intrinsics, width, height)
    distance = 0.85 * extent / math.sin(math.atan(0.5 * min(width, height) / focal))
    elevation = math.radians(20.0)
    axis_z = unit(np.asarray(up, np.float64))
    middle = center + distance * math.sin(elevation) * axis_z
    arm = distance * math.cos(elevation) * perpendicular(axis_z)
    turn = 2 * np.pi * np.arange(num_frames)[:, None] / max(num_frames, 1)
    eyes = middle + np.cos(turn) * arm + np.sin(turn) * np.cross(axis_z, arm)
    return _looking_at(template, eyes, center, axis_z)


def path_along(
    cameras: Cameras,
    num_frames: int,
    times: Sequence[float] | None = None,
    up: np.ndarray | None = None,
) -> CameraPath:
    """Return a smooth path along V >= 1 cameras, with intrinsics of the first.

    With ``times`` (V,) that all differ, which is a clip of one moving camera, the path plays the
    clip from the first time to the last. Otherwise it visits every position once, at even speed: in
    the order of the capture if that is a walk, else by a short way from the first camera on.
    Positions, viewing directions and up directions (without ``up``) are means over the cameras near
    on the way, with Gaussian weights.
    """
    poses = world_from_cam(cameras)
    kept = np.linspace(0, len(poses) - 1, min(len(poses), _MOST_CAMERAS)).round().astype(int)
    poses = poses[kept]
    if times is not None and len(kept) > 1:
        seconds = np.asarray(times, np.float64)[kept]
        order = np.argsort(seconds)
        seconds = seconds[order]
        if (np.diff(seconds) > 0).all():
            steps = np.linspace(seconds[0], seconds[-1], num_frames)
            smooth = with_poses(cameras, _smoothed(poses[order], seconds, steps, up))
            return CameraPath(smooth, times=tuple(steps.tolist()))
    # Distances of these six numbers are those between the images: place, and viewing direction
    # times the distance of what is looked at.
    centers = poses[:, :3, 3]
    reach = float(np.linalg.norm(centers - look_at_point(cameras), axis=1).mean())
    features = np.concatenate([centers, reach * poses[:, :3, 2]], axis=1)
    # Nine digits of the largest, so that equal poses are equal in any unit of length.
    step = 1e-9 * (float(np.abs(features).max()) or 1.0)
    features = step * (features / step).round()
    _, first = np.unique(features, axis=0, return_index=True)
    first.sort()  # back to the order of the capture
    visited = first[_walk(features[first])]
    lengths = np.linalg.norm(np.diff(features[visited], axis=0), axis=1)
    way = np.concatenate([[0.0], np.cumsum(lengths)])
    smooth = _smoothed(poses[visited], way, np.linspace(0, way[-1], num_frames), up)
    return CameraPath(with_poses(cameras, smooth))


def _walk(features: np.ndarray) -> np.ndarray:
    """Return the order (V,) in which to visit ``features`` (V, D): as they are if that is a walk,
    else a short open way from the first, by the nearest next and 2-opt."""
    from scipy.spatial.distance import cdist  # late: importing it takes a tenth of a second

    between = cdist(features, features)
    given = np.arange(len(features))
    left = given > 0
    short = given.copy()
    for i in given[1:]:
        short[i] = np.where(left, between[short[i - 1]], np.inf).argmin()
        left[short[i]] = False
    for _ in range(30):
        if not _untangle(short, between):
            break
    lengths = [between[order[:-1], order[1:]].sum() for order in (given, short)]
    return given if lengths[0] <= _DETOUR * lengths[1] else short


def _untangle(way: np.ndarray, between: np.ndarray) -> bool:
    """Reverse each stretch of ``way`` (V,), in place, where that makes it shorter; return whether
    any was."""
    has_changed = False
    for i in range(len(way) - 2):
        # from each possible end of a stretch that begins at i + 1 to its next
        stays = np.append(between[way[i + 1 : -1], way[i + 2 :]], 0.0)
        turned = between[way[i], way[i + 1 :]] + np.append(between[way[i + 1], way[i + 2 :]], 0.0)
        gain = between[way[i], way[i + 1]] + stays - turned
        best = int(gain.argmax())
        if gain[best] > 1e-9 * between.max():
            way[i + 1 : i + 2 + best] = way[i + 1 : i + 2 + best][::-1].copy()
            has_changed = True
    return has_changed


def _smoothed(
    poses: np.ndarray, way: np.ndarray, steps: np.ndarray, up: np.ndarray | None
) -> np.ndarray:
    """Return poses (F, 4, 4) at ``steps`` (F,) of the way: means of poses (V, 4, 4) at ``way`` (V,)
    near them."""
    spread = max(_SMOOTHED_CAMERAS * (way[-1] - way[0]) / max(len(way) - 1, 1), 1e-12)
    distance = ((steps[:, None] - way) / spread) ** 2
    near = np.exp(-0.5 * (distance - distance.min(axis=1, keepdims=True)))
    near /= near.sum(axis=1, keepdims=True)
    forward = unit(near @ poses[:, :3, 2])
    upward = near @ -poses[:, :3, 1] if up is None else np.broadcast_to(up, forward.shape)
    right = unit(np.cross(forward, upward))
    made = np.tile(np.eye(4), (len(steps), 1, 1))
    columns = [right, np.cross(forward, right), forward, near @ poses[:, :3, 3]]
    made[:, :3] = np.stack(columns, axis=-1)
    return made
