"""Where a set of cameras looks, which way is up for it, and cameras that look at a point."""

from __future__ import annotations

import numpy as np
import torch

from dyngs.core.camera import Cameras
from dyngs.data.geometry import focus_point, fraction_in_front


def look_at_point(cameras: Cameras) -> np.ndarray:
    """Return the point (3,) float64 nearest to all optical axes in the least-squares sense, in
    front of the cameras.

    (Nearly) parallel axes do not determine it: then it lies in front of the mean camera, at three
    times the spread of the cameras (1 if they coincide).
    """
    poses = world_from_cam(cameras)
    centers = poses[:, :3, 3]
    axes = poses[:, :3, 2]
    point = focus_point(poses)
    if point is not None and fraction_in_front(poses, point) > 0.5:
        return point
    middle = centers.mean(axis=0)
    spread = float(np.linalg.norm(centers - middle, axis=1).mean())
    if spread <= 1e-6 * float(np.abs(centers).max()):  # rounding of float32 poses
        spread = 1.0
    mean_axis = axes.mean(axis=0)
    return middle + 3.0 * spread * unit(mean_axis if np.linalg.norm(mean_axis) > 1e-6 else axes[0])


def up_direction(cameras: Cameras) -> np.ndarray:
    """Return the direction (3,) that is up for the cameras.

    Cameras that look around, and are held level, have right axes in one plane: up is its normal,
    whichever way they are tilted. Where that plane is not determined, or they are not held level,
    it is the mean of their own up directions.
    """
    poses = world_from_cam(cameras)
    ups = -poses[:, :3, 1]
    mean = ups.mean(axis=0)
    mean = unit(mean) if np.linalg.norm(mean) > 1e-3 else ups[0]
    rights = poses[:, :3, 0]
    values, vectors = np.linalg.eigh(rights.T @ rights / len(rights))
    normal = vectors[:, 0] * (1.0 if vectors[:, 0] @ mean >= 0 else -1.0)
    # The right axes turn by about 15 degrees in all, and lie within 11.5 degrees of the plane.
    is_determined = values[1] > max(0.005, 4 * values[0]) and values[0] < 0.2**2
    return normal if is_determined and normal @ mean > 0.3 else mean


def look_at(eye: np.ndarray, target: np.ndarray, up: np.ndarray) -> np.ndarray:
    """Return the OpenCV camera-to-world pose (4, 4) at ``eye``, z towards ``target``, y away from
    ``up``."""
    forward = target - eye
    has_length = np.linalg.norm(forward) > 1e-12 * np.linalg.norm(eye)
    forward = unit(forward) if has_length else perpendicular(up)
    right = np.cross(forward, up)
    has_length = np.linalg.norm(right) > 1e-6 * np.linalg.norm(up)
    right = unit(right) if has_length else perpendicular(forward)
    pose = np.eye(4)
    pose[:3] = np.stack([right, np.cross(forward, right), forward, eye], axis=1)
    return pose


def with_poses(cameras: Cameras, poses: np.ndarray) -> Cameras:
    """Return cameras at camera-to-world ``poses`` (F, 4, 4), with intrinsics, dtype and device of
    the first camera."""
    cam_from_world = torch.from_numpy(np.linalg.inv(poses)).to(cameras.cam_from_world)
    intrinsics = cameras.intrinsics[:1].expand(len(cam_from_world), 3, 3).clone()
    return Cameras(cam_from_world, intrinsics, cameras.width, cameras.height)


def world_from_cam(cameras: Cameras) -> np.ndarray:
    """Return camera-to-world poses (V, 4, 4), float64."""
    if not len(cameras):
        raise ValueError("a camera path is placed by at least one camera")
    return np.linalg.inv(cameras.cam_from_world.detach().cpu().double().numpy())


def unit(a: np.ndarray) -> np.ndarray:
    """Return vectors (..., 3) that are not zero at length 1."""
    return a / np.linalg.norm(a, axis=-1, keepdims=True)


def perpendicular(a: np.ndarray) -> np.ndarray:
    """Return a unit vector perpendicular to ``a`` (3,)."""
    return unit(np.cross(a, np.eye(3)[np.abs(a).argmin()]))
