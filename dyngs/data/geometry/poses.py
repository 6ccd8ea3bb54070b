"""Camera poses: checks, repair of rounding errors, conversion between OpenGL and OpenCV axes."""

from __future__ import annotations

import numpy as np

from dyngs.data.capture import View
from dyngs.errors import DyngsError

OPENGL_FROM_OPENCV = np.diag([1.0, -1.0, -1.0, 1.0])
LARGEST = 1e12
"""Largest entry of a pose: beyond it float64 is too coarse to recentre the scene."""
ROTATION_TOLERANCE = 1e-3
"""Largest entry of ``R^T R - I`` that is taken for rounding and repaired."""


def checked_pose(matrix: np.ndarray, where: str) -> tuple[np.ndarray, float]:
    """Return the rigid (4, 4) float64 transform nearest to ``matrix``, and its deviation from rigid.

    Args:
        matrix: (4, 4) or (3, 4), either direction and any axis convention.
        where: file and frame, for messages.

    Returns:
        The pose, its rotation re-orthonormalised, and the largest entry of ``|R^T R - I|`` before that.

    Raises:
        DyngsError: not finite, not a pose, mirrored, scaled, or further than ``ROTATION_TOLERANCE`` from a rotation.
    """
    if matrix.shape not in ((4, 4), (3, 4)):
        raise DyngsError(f"{where}: the pose must be a 4x4 matrix, got shape {matrix.shape}; export it again")
    if not np.isfinite(matrix).all():
        raise DyngsError(f"{where}: the pose holds NaN or infinite numbers; remove or repair this frame")
    if np.abs(matrix).max() > LARGEST:
        raise DyngsError(f"{where}: the pose holds numbers beyond {LARGEST:g}; use another unit or repair this frame")
    if len(matrix) == 4 and np.abs(matrix[3] - (0, 0, 0, 1)).max() > 1e-6:
        raise DyngsError(f"{where}: the last row of the pose must be 0 0 0 1; is the matrix transposed?")
    rotation = matrix[:3, :3].astype(np.float64)
    determinant = np.linalg.det(rotation)
    error = float(np.abs(rotation.T @ rotation - np.eye(3)).max())
    if error > ROTATION_TOLERANCE or determinant <= 0:
        raise DyngsError(f"{where}: {_rotation_fault(rotation, determinant, error)}")
    u, _, vt = np.linalg.svd(rotation)
    pose = np.eye(4)
    pose[:3, :3] = u @ vt
    pose[:3, 3] = matrix[:3, 3]
    return pose, error


def matrix_fault(matrix: np.ndarray, where: str) -> str | None:
    """Return one line, beginning with ``where``, on why ``matrix`` is no rigid pose; None where it is."""
    try:
        checked_pose(matrix, where)
    except DyngsError as error:
        return str(error)
    return None


def pose_fault(view: View) -> str | None:
    """Return one line on why the view's pose is not rigid, None where it is."""
    return matrix_fault(view.cam_from_world, f"'{view.name}'")


def cam_from_opengl(world_from_cam: np.ndarray) -> np.ndarray:
    """Return the OpenCV ``cam_from_world`` of a rigid (4, 4) OpenGL camera-to-world pose: y up, z backward."""
    return inverse_rigid(world_from_cam @ OPENGL_FROM_OPENCV)


def opengl_from_cam(cam_from_world: np.ndarray) -> np.ndarray:
    """Return the (4, 4) OpenGL camera-to-world pose of a rigid OpenCV ``cam_from_world``."""
    return inverse_rigid(cam_from_world) @ OPENGL_FROM_OPENCV


def inverse_rigid(pose: np.ndarray) -> np.ndarray:
    """Return the (4, 4) inverse of a rigid transform."""
    inverse = np.eye(4)
    inverse[:3, :3] = pose[:3, :3].T
    inverse[:3, 3] = -pose[:3, :3].T @ pose[:3, 3]
    return inverse


def camera_center(cam_from_world: np.ndarray) -> np.ndarray:
    """Return the (3,) position of the camera in the world."""
    return -cam_from_world[:3, :3].T @ cam_from_world[:3, 3]


def repair_warning(errors: dict[str, float]) -> list[str]:
    """Return one line about the rotations that were not orthonormal, none if all were.

    Args:
        errors: origin of each pose to its deviation as ``checked_pose`` returned it.
    """
    off = {where: error for where, error in errors.items() if error > 1e-5}
    if not off:
        return []
    worst = max(off, key=lambda where: off[where])
    return [f"{len(off)} rotations were not orthonormal and were repaired, the worst by {off[worst]:.1e} ({worst})"]


def _rotation_fault(rotation: np.ndarray, determinant: float, error: float) -> str:
    if determinant < 0:
        return "the pose is mirrored (its determinant is negative); flip one axis when exporting"
    if determinant > 0:
        scale = determinant ** (1 / 3)
        unit = rotation / scale
        if np.abs(unit.T @ unit - np.eye(3)).max() <= ROTATION_TOLERANCE:
            return f"the rotation is scaled by {scale:.6g}; scale the camera positions only and export again"
    return f"the pose is not a rotation (R^T R differs from the identity by {error:.2g}); export it again"
