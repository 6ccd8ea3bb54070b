"""Automatic camera paths: orbit, spiral, and along the training cameras."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
import torch

from dyngs.core.camera import Cameras
from dyngs.core.errors import DyngsError
from dyngs.data.geometry import (
    cameras_at_poses,
    estimate_focus,
    fraction_in_front,
    look_at,
    perpendicular,
    pinhole_matrix,
    unit,
    up_direction,
    world_from_cam,
)
from dyngs.export.camera_paths import CameraPath, spread_rows


def orbit_path(
    cameras: Cameras, num_frames: int, up: np.ndarray | None = None
) -> tuple[CameraPath, bool]:
    """Return a level circle around the point that V >= 1 ``cameras`` look at, and whether they
    surround it.

    Radius and height are means over the cameras. Intrinsics and the azimuth of frame 0 are those of
    the first camera. If the cameras cover only an arc, the path swings along the arc and back, at
    the radius and height of nearby cameras, and has a note.

    Args:
        up: (3,) axis of the circle. None estimates it from the cameras.
    """
    poses = world_from_cam(cameras)
    center = estimate_focus(cameras)
    up = up_direction(cameras) if up is None else unit(np.asarray(up, np.float64))
    offsets = poses[:, :3, 3] - center
    heights = offsets @ up
    flat = offsets - heights[:, None] * up
    radii = np.linalg.norm(flat, axis=1)
    # Cameras straight above or below the point have no azimuth.
    beside = np.flatnonzero(radii > 1e-6 * np.linalg.norm(offsets, axis=1).max())
    axis_x = unit(flat[beside[0]]) if len(beside) else perpendicular(up)
    angles = np.arctan2(flat @ np.cross(up, axis_x), flat @ axis_x)
    middle, width = _arc(angles[beside]) if len(beside) else (0.0, None)
    azimuths = _full_circle(num_frames)
    smallest = 0.1 * float(np.hypot(radii, heights).mean())
    notes = ()
    if width is None:
        near = np.full((num_frames, len(poses)), 1 / len(poses))
    else:
        # Otherwise the camera would not move for a capture from a single position.
        narrowest = math.radians(10)
        swing = 0.5 * max(width, narrowest) * np.sin(azimuths)
        apart = swing[:, None] - ((angles - middle + np.pi) % (2 * np.pi) - np.pi)
        near = np.exp(-0.5 * (apart / max(width / 6, narrowest)) ** 2)
        near /= near.sum(axis=1, keepdims=True)
        azimuths = swing + middle
        degrees = round(math.degrees(width))
        notes = (f"cameras cover an arc of {degrees} degrees: the orbit swings along it and back",)
    if fraction_in_front(poses, center) < 0.5:
        notes = ("cameras look outwards: consider --path along instead of an orbit",)
    heights = near @ heights
    radii = np.maximum(near @ radii, smallest)
    made = cameras_on_circle(cameras, center, up, axis_x, azimuths, radii, heights)
    return CameraPath(made, notes=notes), width is None


def _arc(angles: np.ndarray) -> tuple[float, float | None]:
    """Return middle and width of the smallest arc containing ``angles`` (V,), in radians.

    The width is None if the angles cover the full circle.
    """
    order = np.sort(angles)
    gaps = np.diff(np.append(order, order[0] + 2 * np.pi))
    widest = int(gaps.argmax())
    # A full ring of few cameras has large but even gaps.
    is_even = len(order) > 1 and gaps[widest] <= 1.3 * 2 * np.pi / len(order)
    if gaps[widest] <= math.radians(100) or is_even:
        return 0.0, None
    width = 2 * np.pi - gaps[widest]
    return float(order[(widest + 1) % len(order)] + 0.5 * width), float(width)


def _full_circle(num_frames: int) -> np.ndarray:
    """Return the angles (F,) of a full circle in radians."""
    return 2 * np.pi * np.arange(num_frames) / max(num_frames, 1)


def cameras_on_circle(
    template: Cameras,
    center: np.ndarray,
    up: np.ndarray,
    axis_x: np.ndarray,
    azimuths: np.ndarray,
    radii: np.ndarray | float,
    heights: np.ndarray | float,
) -> Cameras:
    """Return cameras at cylindrical coordinates (F,) around ``center``, looking at it."""
    flat = np.stack([np.cos(azimuths), np.sin(azimuths)], axis=-1) @ [axis_x, np.cross(up, axis_x)]
    high = np.broadcast_to(heights, azimuths.shape)[:, None] * up
    wide = np.broadcast_to(radii, azimuths.shape)[:, None] * flat
    return _looking_at(template, center + high + wide, center, up)


def _looking_at(cameras: Cameras, eyes: np.ndarray, target: np.ndarray, up: np.ndarray) -> Cameras:
    return cameras_at_poses(cameras, np.stack([look_at(eye, target, up) for eye in eyes]))


def spiral_path(cameras: Cameras, num_frames: int, up: np.ndarray | None = None) -> Cameras:
    """Return cameras on a closed spiral in front of a scene captured from one side, as in LLFF.

    The spiral is centred on the mean of V >= 1 cameras. Its width is the 90% quantile of their
    distances from it. All cameras look at the same point. It has two circles and moves along the
    viewing axis by half its width.
    """
    centers = world_from_cam(cameras)[:, :3, 3]
    target = estimate_focus(cameras)
    up = up_direction(cameras) if up is None else up
    middle = centers.mean(axis=0)
    base = look_at(middle, target, up)[:3, :3]
    distance = np.linalg.norm(target - middle)
    radii = np.quantile(np.abs((centers - middle) @ base), 0.9, axis=0)
    radii = np.maximum(radii, 0.02 * distance)
    radii[2] = min(0.5 * radii.max(), 0.3 * distance)
    phase = _full_circle(num_frames)
    local = np.stack([np.cos(2 * phase), -np.sin(2 * phase), np.sin(phase)], axis=-1)
    return _looking_at(cameras, middle + local * radii @ base.T, target, up)


def frame_orbit_for_points(
    means: np.ndarray,
    num_frames: int,
    size: tuple[int, int] = (960, 720),
    up: tuple[float, float, float] = (0, 0, 1),
    least: float = 0.0,
) -> Cameras:
    """Return an orbit in which the robust extent of points fills the image.

    The centre is the median of the points (N, 3). The extent is the radius around it that contains
    99% of the points between the 1st and 99th percentile of every axis. Non-finite points are
    ignored.

    Args:
        least: lower bound of the extent, such as the size of a Gaussian. The extent is 1 if both
            are 0.

    Raises:
        DyngsError: no finite point.
    """
    points = np.asarray(means, np.float64).reshape(-1, 3)
    points = points[np.isfinite(points).all(axis=1)]
    if not len(points):
        raise DyngsError("cannot place an orbit: no points with finite coordinates")
    low, high = np.quantile(points, [0.01, 0.99], axis=0)
    inside = points[((points >= low) & (points <= high)).all(axis=1)]
    points = inside if len(inside) else points
    center = np.median(points, axis=0)
    extent = max(float(np.quantile(np.linalg.norm(points - center, axis=1), 0.99)), least) or 1.0
    width, height = size
    focal = 0.5 * max(width, height) / math.tan(math.radians(25.0))
    template = pinhole_camera(focal, width, height)
    distance = 0.85 * extent / math.sin(math.atan(0.5 * min(width, height) / focal))
    elevation = math.radians(20.0)
    axis_z = unit(np.asarray(up, np.float64))
    radius = distance * math.cos(elevation)
    height = distance * math.sin(elevation)
    arm = perpendicular(axis_z)
    return cameras_on_circle(
        template, center, axis_z, arm, _full_circle(num_frames), radius, height
    )


def pinhole_camera(focal: float, width: int, height: int) -> Cameras:
    """Return a camera at the origin whose principal point is in the middle of the image."""
    matrix = torch.from_numpy(pinhole_matrix(focal, focal, 0.5 * width, 0.5 * height)).float()
    return Cameras(torch.eye(4, device="cpu")[None], matrix[None], width, height)


def path_along(
    cameras: Cameras,
    num_frames: int,
    times: Sequence[float] | None = None,
    up: np.ndarray | None = None,
) -> CameraPath:
    """Return a smooth path along V >= 1 cameras, with intrinsics of the first.

    With distinct ``times`` (V,), the cameras are a clip of one moving camera, and the path plays
    the clip. Otherwise it visits every position once at constant speed, in the order of the capture
    if that is a short route, else from each camera to the nearest unvisited one. Positions and
    directions are smoothed with Gaussian weights.

    Args:
        up: (3,) up direction. None averages that of the cameras.
    """
    poses = world_from_cam(cameras)
    # The path is smoothed, so 500 cameras suffice.
    kept = spread_rows(len(poses), 500)
    poses = poses[kept]
    if times is not None and len(kept) > 1:
        seconds = np.asarray(times, np.float64)[kept]
        order = np.argsort(seconds)
        seconds = seconds[order]
        if (np.diff(seconds) > 0).all():
            steps = np.linspace(seconds[0], seconds[-1], num_frames)
            smooth = cameras_at_poses(cameras, _smooth_poses(poses[order], seconds, steps, up))
            return CameraPath(smooth, times=tuple(steps.tolist()))
    # Features whose distances approximate image differences: position, and viewing direction times
    # the distance to the scene.
    centers = poses[:, :3, 3]
    reach = float(np.linalg.norm(centers - estimate_focus(cameras), axis=1).mean())
    features = np.concatenate([centers, reach * poses[:, :3, 2]], axis=1)
    # Round to nine digits, so that equal poses stay equal in any unit of length.
    features = (features / (float(np.abs(features).max()) or 1.0)).round(9)
    _, first = np.unique(features, axis=0, return_index=True)
    first.sort()  # order of the capture
    visited = first[_visiting_order(features[first])]
    lengths = np.linalg.norm(np.diff(features[visited], axis=0), axis=1)
    way = np.concatenate([[0.0], np.cumsum(lengths)])
    smooth = _smooth_poses(poses[visited], way, np.linspace(0, way[-1], num_frames), up)
    return CameraPath(cameras_at_poses(cameras, smooth))


def _visiting_order(features: np.ndarray) -> np.ndarray:
    """Return an order (V,) in which to visit ``features`` (V, D).

    The given order is kept if it is at most twice as long as the nearest-neighbour route.
    """
    from scipy.spatial.distance import cdist  # slow import

    between = cdist(features, features)
    given = np.arange(len(features))
    left = given > 0
    short = given.copy()
    for i in given[1:]:
        short[i] = np.where(left, between[short[i - 1]], np.inf).argmin()
        left[short[i]] = False
    lengths = [between[order[:-1], order[1:]].sum() for order in (given, short)]
    return given if lengths[0] <= 2 * lengths[1] else short


def _smooth_poses(
    poses: np.ndarray, way: np.ndarray, steps: np.ndarray, up: np.ndarray | None
) -> np.ndarray:
    """Return poses (F, 4, 4) at positions ``steps`` (F,), averaged over poses (V, 4, 4) at ``way``
    (V,)."""
    # The standard deviation is twice the mean distance of consecutive cameras.
    spread = max(2.0 * (way[-1] - way[0]) / max(len(way) - 1, 1), 1e-12)
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
