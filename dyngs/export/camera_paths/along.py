"""Camera paths along the way that a capture was filmed."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from dyngs.core.camera import Cameras
from dyngs.data.aim import look_at_point, unit, with_poses, world_from_cam
from dyngs.export.camera_paths.path import CameraPath

_SMOOTHED_CAMERAS = 2.0
"""Standard deviation of the smoothing, in mean distances between cameras that follow each other."""
_DETOUR = 2.0
"""Cameras in the order of the capture are taken for a walk if that is at most so much longer than
the shortest way."""
_ROUNDS = 30
"""At most so many passes of 2-opt."""
_MOST_CAMERAS = 500
"""Of more cameras so many are followed, evenly spread: they are smoothed anyway."""


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
    times = times and [times[i] for i in kept]
    if times is not None and len(set(times)) == len(times) and len(times) > 1:
        order = np.argsort(np.asarray(times, np.float64))
        way = np.asarray(times, np.float64)[order]
        steps = np.linspace(way[0], way[-1], num_frames)
        found = CameraPath(with_poses(cameras, _smoothed(poses[order], way, steps, up)))
        return CameraPath(found.cameras, times=tuple(steps.tolist()))
    features = _features(poses, look_at_point(cameras))
    features, first = np.unique(_rounded(features), axis=0, return_index=True)
    given = np.argsort(first)  # np.unique sorts; back to the order of the capture
    order = _walk(features[given])
    visited = poses[first[given][order]]
    lengths = np.linalg.norm(np.diff(features[given][order], axis=0), axis=1)
    way = np.concatenate([[0.0], np.cumsum(lengths)])
    return CameraPath(
        with_poses(cameras, _smoothed(visited, way, np.linspace(0, way[-1], num_frames), up))
    )


def _features(poses: np.ndarray, target: np.ndarray) -> np.ndarray:
    """Return (V, 6) numbers of poses (V, 4, 4) whose distances are those between the images, in
    world units.

    Place, and viewing direction times the distance of the ``target`` (3,) that they look at.
    """
    centers = poses[:, :3, 3]
    reach = float(np.linalg.norm(centers - target, axis=1).mean())
    return np.concatenate([centers, reach * poses[:, :3, 2]], axis=1)


def _rounded(features: np.ndarray) -> np.ndarray:
    """Return ``features`` (V, D) to nine digits of the largest, so that equal poses are equal in
    any unit of length."""
    step = 1e-9 * (float(np.abs(features).max()) or 1.0)
    return step * (features / step).round()


def _walk(features: np.ndarray) -> np.ndarray:
    """Return the order (V,) in which to visit ``features`` (V, D): as they are if that is a walk,
    else a short way."""
    from scipy.spatial.distance import cdist  # late: importing it takes a tenth of a second

    between = cdist(features, features)
    given = np.arange(len(features))
    short = _short_way(between)
    return given if _length(between, given) <= _DETOUR * _length(between, short) else short


def _length(between: np.ndarray, order: np.ndarray) -> float:
    return float(between[order[:-1], order[1:]].sum())


def _short_way(between: np.ndarray) -> np.ndarray:
    """Return a short open way from 0 through all points, by their distances (V, V): the nearest
    next, then 2-opt."""
    left = np.ones(len(between), bool)
    order = [0]
    for _ in range(len(between) - 1):
        left[order[-1]] = False
        order.append(int(np.where(left, between[order[-1]], np.inf).argmin()))
    way = np.array(order)
    for _ in range(_ROUNDS):
        if not _untangled(way, between):
            break
    return way


def _untangled(way: np.ndarray, between: np.ndarray) -> bool:
    """Turn round each stretch of ``way`` (V,), in place, where that makes it shorter; return
    whether any was."""
    changed = False
    for i in range(len(way) - 2):
        # from each possible end to its next
        stays = np.append(between[way[i + 1 : -1], way[i + 2 :]], 0.0)
        turned = between[way[i], way[i + 1 :]] + np.append(between[way[i + 1], way[i + 2 :]], 0.0)
        gain = between[way[i], way[i + 1]] + stays - turned
        best = int(gain.argmax())
        if gain[best] > 1e-9 * between.max():
            way[i + 1 : i + 2 + best] = way[i + 1 : i + 2 + best][::-1].copy()
            changed = True
    return changed


def _smoothed(
    poses: np.ndarray, way: np.ndarray, steps: np.ndarray, up: np.ndarray | None
) -> np.ndarray:
    """Return poses (F, 4, 4) at ``steps`` (F,) of the way: means of poses (V, 4, 4) at ``way`` (V,)
    near them."""
    spread = max(_SMOOTHED_CAMERAS * (way[-1] - way[0]) / max(len(way) - 1, 1), 1e-12)
    distance = ((steps[:, None] - way) / spread) ** 2
    near = np.exp(-0.5 * (distance - distance.min(axis=1, keepdims=True)))
    near /= near.sum(axis=1, keepdims=True)
    made = np.tile(np.eye(4), (len(steps), 1, 1))
    made[:, :3, 3] = near @ poses[:, :3, 3]
    forward = unit(near @ poses[:, :3, 2])
    upward = near @ -poses[:, :3, 1] if up is None else np.broadcast_to(up, forward.shape)
    right = unit(np.cross(forward, upward))
    made[:, :3, 0], made[:, :3, 1], made[:, :3, 2] = right, np.cross(forward, right), forward
    return made
