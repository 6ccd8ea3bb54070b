"""Cameras of the viewer: from the pose of a browser's camera and back, and the nearest camera of a
capture."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
import torch

from dyngs.core.camera import Cameras
from dyngs.data.aim import world_from_cam

_NEAREST_TURN, _NEAREST_TIME = 0.5, 2.0
"""Distances, relative to the size of the scene, that weigh as much as a radian between viewing
directions, and as much as the full span of times."""
MAX_FOV = math.radians(160)


def camera_at(
    wxyz: Sequence[float] | np.ndarray,
    position: Sequence[float] | np.ndarray,
    fov: float,
    size: tuple[int, int],
) -> Cameras:
    """Return one camera of ``size``, px, at ``position``; ``wxyz``: world from camera; ``fov``:
    vertical, rad."""
    from scipy.spatial.transform import Rotation

    w, x, y, z = (float(value) for value in wxyz)
    rotation = Rotation.from_quat([x, y, z, w]).as_matrix().T
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = rotation, -rotation @ np.asarray(position, np.float64)
    width, height = size
    focal = 0.5 * height / math.tan(0.5 * min(max(fov, 1e-3), MAX_FOV))
    matrix = np.array([[focal, 0, 0.5 * width], [0, focal, 0.5 * height], [0, 0, 1]])
    return Cameras(
        torch.from_numpy(pose).float()[None], torch.from_numpy(matrix).float()[None], width, height
    )


def pose_of(camera: Cameras) -> tuple[np.ndarray, np.ndarray]:
    """Return the rotation (4,) wxyz, world from camera, and the centre (3,) of one camera,
    float64."""
    from scipy.spatial.transform import Rotation

    (pose,) = world_from_cam(camera)
    x, y, z, w = Rotation.from_matrix(pose[:3, :3]).as_quat()
    return np.array([w, x, y, z]), pose[:3, 3]


def fitting_fov(camera: Cameras, aspect: float) -> float:
    """Return the vertical field of view, rad, at which a window of an ``aspect`` shows the full
    image of one camera."""
    focal_x = float(camera.intrinsics[0, 0, 0])
    focal_y = float(camera.intrinsics[0, 1, 1])
    half = max(0.5 * camera.height / focal_y, 0.5 * camera.width / focal_x / aspect)
    return min(2 * math.atan(half), MAX_FOV)


def look_point(camera: Cameras, center: np.ndarray, extent: float) -> np.ndarray:
    """Return the point (3,) on the axis of one camera to orbit around: as far away as ``center``
    (3,) is deep."""
    (pose,) = world_from_cam(camera)
    eye = pose[:3, 3]
    forward = pose[:3, 2]
    return eye + max(float((center - eye) @ forward), 0.1 * extent) * forward


def nearest_camera(
    camera: Cameras,
    time: float | None,
    poses: np.ndarray,
    times: Sequence[float | None],
    extent: float,
) -> int:
    """Return which of ``poses`` (V, 4, 4), world to camera, is nearest in position, viewing
    direction and time.

    ``time`` None: ``times`` (V,) do not count. ``extent`` of the scene: world units.
    """
    own = camera.cam_from_world[0].double().cpu().numpy()
    apart = np.linalg.norm(centers_of(poses) + own[:3, :3].T @ own[:3, 3], axis=1) / max(
        extent, 1e-9
    )
    angles = np.arccos(np.clip(poses[:, 2, :3] @ own[2, :3], -1, 1))
    cost = apart + _NEAREST_TURN * angles
    if time is not None:
        cost = cost + _NEAREST_TIME * np.array([0.0 if t is None else abs(t - time) for t in times])
    return int(cost.argmin())


def centers_of(poses: np.ndarray) -> np.ndarray:
    """Return the centres (V, 3) of world-to-camera poses (V, 4, 4)."""
    return -np.einsum("vji,vj->vi", poses[:, :3, :3], poses[:, :3, 3])


def fov_of(camera: Cameras) -> float:
    """Return the vertical field of view of one camera, rad."""
    return 2 * float(np.arctan(0.5 * camera.height / float(camera.intrinsics[0, 1, 1])))


def in_window(camera: Cameras, size: tuple[int, int]) -> Cameras:
    """Return one camera as a window of ``size`` shows it: the same pose and vertical field of
    view."""
    wxyz, position = pose_of(camera)
    return camera_at(wxyz, position, fov_of(camera), size)
