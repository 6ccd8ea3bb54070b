"""Cameras of the viewer: from the pose of a browser's camera and back, and the nearest camera of a capture."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
import torch

from dyngs.camera import Cameras

_NEAREST_TURN = 0.5
"""Distance, relative to the size of the scene, that weighs as much as a radian between viewing directions."""
_NEAREST_TIME = 2.0
"""Distance, relative to the size of the scene, that weighs as much as the whole span of times."""
MAX_FOV = math.radians(160)


def camera_at(
    wxyz: Sequence[float] | np.ndarray, position: Sequence[float] | np.ndarray, fov: float, size: tuple[int, int]
) -> Cameras:
    """Return one camera with its principal point in the middle.

    Args:
        wxyz: world from camera, OpenCV axes.
        position: (3,) centre in the world.
        fov: vertical field of view, rad.
        size: width and height, px.
    """
    from scipy.spatial.transform import Rotation

    w, x, y, z = (float(value) for value in wxyz)
    rotation = Rotation.from_quat([x, y, z, w]).as_matrix().T
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = rotation, -rotation @ np.asarray(position, np.float64)
    width, height = size
    focal = 0.5 * height / math.tan(0.5 * min(max(fov, 1e-3), MAX_FOV))
    matrix = np.array([[focal, 0, 0.5 * width], [0, focal, 0.5 * height], [0, 0, 1]])
    return Cameras(torch.from_numpy(pose).float()[None], torch.from_numpy(matrix).float()[None], width, height)


def pose_of(camera: Cameras) -> tuple[np.ndarray, np.ndarray]:
    """Return the rotation (4,) wxyz, world from camera, and the centre (3,) of one camera, float64."""
    from scipy.spatial.transform import Rotation

    world_from_cam = np.linalg.inv(camera.cam_from_world[0].double().cpu().numpy())
    x, y, z, w = Rotation.from_matrix(world_from_cam[:3, :3]).as_quat()
    return np.array([w, x, y, z]), world_from_cam[:3, 3]


def fitting_fov(camera: Cameras, aspect: float) -> float:
    """Return the vertical field of view, rad, at which a window shows the whole image of one camera.

    Args:
        camera: one camera.
        aspect: width over height of the window.
    """
    focal_x, focal_y = float(camera.intrinsics[0, 0, 0]), float(camera.intrinsics[0, 1, 1])
    half = max(0.5 * camera.height / focal_y, 0.5 * camera.width / focal_x / aspect)
    return min(2 * math.atan(half), MAX_FOV)


def look_point(camera: Cameras, center: np.ndarray, extent: float) -> np.ndarray:
    """Return the point (3,) on the axis of one camera to orbit around: as far away as ``center`` (3,) is deep."""
    world_from_cam = np.linalg.inv(camera.cam_from_world[0].double().cpu().numpy())
    eye, forward = world_from_cam[:3, 3], world_from_cam[:3, 2]
    return eye + max(float((center - eye) @ forward), 0.1 * extent, 1e-3) * forward


def nearest_camera(
    camera: Cameras, time: float | None, poses: np.ndarray, times: Sequence[float | None], extent: float
) -> int:
    """Return the index of the pose that is nearest to one camera in place, viewing direction and time.

    Args:
        camera: one camera.
        time: in [0, 1]; None: times do not count.
        poses: (V, 4, 4) world to camera.
        times: (V,) of the poses.
        extent: of the scene, world units.
    """
    own = camera.cam_from_world[0].double().cpu().numpy()
    centers = -np.einsum("vji,vj->vi", poses[:, :3, :3], poses[:, :3, 3])
    apart = np.linalg.norm(centers + own[:3, :3].T @ own[:3, 3], axis=1) / max(extent, 1e-9)
    turned = np.arccos(np.clip(poses[:, 2, :3] @ own[2, :3], -1, 1))
    cost = apart + _NEAREST_TURN * turned
    if time is not None:
        cost = cost + _NEAREST_TIME * np.array([0.0 if t is None else abs(t - time) for t in times])
    return int(cost.argmin())
