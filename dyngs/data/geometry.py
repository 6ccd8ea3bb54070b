"""Camera geometry: pose validation, axis conventions, intrinsics, projection, focus point,
look-at."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch

from dyngs.core.camera import Cameras
from dyngs.core.errors import DyngsError
from dyngs.data.capture import View

OPENGL_FROM_OPENCV = np.diag([1.0, -1.0, -1.0, 1.0])
LARGEST = 1e12
"""Largest pose entry: beyond it float64 is too coarse to recentre the scene."""
ROTATION_TOLERANCE = 1e-3
"""Largest entry of ``R^T R - I`` that counts as rounding and is repaired."""


def validate_pose(matrix: np.ndarray, where: str) -> tuple[np.ndarray, float]:
    """Return the rigid (4, 4) float64 transform nearest to ``matrix``, (4, 4) or (3, 4), and its
    error.

    The error is the largest entry of ``|R^T R - I|``. Works for any axis convention. Raises
    DyngsError if the matrix is not finite, mirrored, scaled, or farther than
    ``ROTATION_TOLERANCE`` from a rotation.
    """
    if matrix.shape not in ((4, 4), (3, 4)):
        raise DyngsError(
            f"{where}: the pose must be a 4x4 matrix, got shape {matrix.shape}; export it again"
        )
    if not np.abs(matrix).max() <= LARGEST:
        raise DyngsError(
            f"{where}: the pose contains NaN or values above {LARGEST:g}; remove or repair this "
            "frame"
        )
    if len(matrix) == 4 and np.abs(matrix[3] - (0, 0, 0, 1)).max() > 1e-6:
        raise DyngsError(
            f"{where}: the last row of the pose must be 0 0 0 1; is the matrix transposed?"
        )
    rotation = matrix[:3, :3].astype(np.float64)
    determinant = np.linalg.det(rotation)
    error = float(np.abs(rotation.T @ rotation - np.eye(3)).max())
    if error > ROTATION_TOLERANCE or determinant <= 0:
        fault = "mirrored; flip one axis when exporting" if determinant < 0 else "not a rotation"
        raise DyngsError(
            f"{where}: the pose is {fault} (its determinant is {determinant:.3g}, R^T R differs "
            f"from the identity by {error:.2g}; scale positions only)"
        )
    u, _, vt = np.linalg.svd(rotation)
    pose = np.eye(4)
    pose[:3, :3] = u @ vt
    pose[:3, 3] = matrix[:3, 3]
    return pose, error


def from_opengl_pose(world_from_cam: np.ndarray) -> np.ndarray:
    """Return the OpenCV ``cam_from_world`` of an OpenGL camera-to-world pose (4, 4): y up, z
    backward."""
    return invert_rigid(world_from_cam @ OPENGL_FROM_OPENCV)


def to_opengl_pose(cam_from_world: np.ndarray) -> np.ndarray:
    """Return the (4, 4) OpenGL camera-to-world pose of a rigid OpenCV ``cam_from_world``."""
    return invert_rigid(cam_from_world) @ OPENGL_FROM_OPENCV


def invert_rigid(pose: np.ndarray) -> np.ndarray:
    """Return the (4, 4) inverse of a rigid transform."""
    inverse = np.eye(4)
    inverse[:3, :3] = pose[:3, :3].T
    inverse[:3, 3] = -pose[:3, :3].T @ pose[:3, 3]
    return inverse


def camera_center(cam_from_world: np.ndarray) -> np.ndarray:
    """Return the (3,) position of the camera in the world."""
    return -cam_from_world[:3, :3].T @ cam_from_world[:3, 3]


def repair_warning(errors: dict[str, float]) -> list[str]:
    """Return a warning on rotations that were repaired, given ``validate_pose`` errors by
    location."""
    off = {where: error for where, error in errors.items() if error > 1e-5}
    if not off:
        return []
    worst = max(off, key=lambda where: off[where])
    return [
        f"{len(off)} rotations were not orthonormal and have been repaired, largest error "
        f"{off[worst]:.1e} ({worst})"
    ]


MAX_SIDE = 2**20
"""Largest plausible side of an image in pixels."""
FOCAL_RANGE = (1e-4, 1e6)
"""Plausible focal lengths in longer sides of the image: fields of view from 0.00006 to 179.99
degrees."""


def pinhole_matrix(fx: float, fy: float, cx: float, cy: float) -> np.ndarray:
    """Return the (3, 3) float64 camera matrix in pixels."""
    return np.array([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]])


def scaled_intrinsics(intrinsics: np.ndarray, scale_x: float, scale_y: float) -> np.ndarray:
    """Return the (3, 3) matrix for a scaled image; exact, as pixel centres are at (0.5, 0.5)."""
    return np.diag([scale_x, scale_y, 1.0]) @ intrinsics


def match_intrinsics_to_image(
    intrinsics: np.ndarray, described: tuple[int, int], stored: tuple[int, int] | None, where: str
) -> tuple[np.ndarray, tuple[int, int], bool]:
    """Rescale intrinsics to the stored image; return them, its (width, height), and whether they
    changed.

    Args:
        described: image size that the intrinsics are for.
        stored: size of the file, None if it could not be opened.

    Raises DyngsError on another aspect ratio, or an implausible focal length or principal point.
    """
    _check_plausible(intrinsics, described, where)
    if stored is None or stored == described:
        return intrinsics, described, False
    scale_x = stored[0] / described[0]
    scale_y = stored[1] / described[1]
    # Each side of a shrunk image was rounded to whole pixels: half a pixel either way is the same
    # aspect.
    slack = max(0.5 / stored[0], 0.5 / stored[1]) + 1e-9
    if abs(scale_x / scale_y - 1) > 2 * slack:
        rotated = " (rotated by its EXIF tag?)" if stored == described[::-1] else ""
        raise DyngsError(
            f"{where}: the image is {stored[0]}x{stored[1]} but its intrinsics are for "
            f"{described[0]}x{described[1]}{rotated}; correct the size and focal length or "
            "restore the original image"
        )
    return scaled_intrinsics(intrinsics, scale_x, scale_y), stored, True


def _check_plausible(intrinsics: np.ndarray, described: tuple[int, int], where: str) -> None:
    side = max(described)
    low = FOCAL_RANGE[0] * side
    high = FOCAL_RANGE[1] * side
    fx, fy, *center = (float(intrinsics[i, j]) for i, j in ((0, 0), (1, 1), (0, 2), (1, 2)))
    if not (low <= fx <= high and low <= fy <= high and all(abs(x) <= high for x in center)):
        raise DyngsError(
            f"{where}: the focal length ({fx:g}, {fy:g}) px or the principal point "
            f"({center[0]:g}, {center[1]:g}) px is implausible for an image of "
            f"{described[0]}x{described[1]}; correct it, or the field of view"
        )


def rescale_warning(where: list[str]) -> list[str]:
    """Return a warning on images whose intrinsics were rescaled, none for an empty list."""
    if not where:
        return []
    return [
        f"{len(where)} images differ in size from their intrinsics, which were rescaled; first "
        f"{where[0]}"
    ]


NEAREST = 1e-9
"""Points nearer to the camera plane than this, in world units, or behind it are not visible."""


def project_points(points: np.ndarray, view: View) -> tuple[np.ndarray, np.ndarray]:
    """Project points (P, 3) with the pinhole camera of a view.

    Returns (P, 2) positions in [0, 1] across and down, and (P,) bool whether they are in the
    image; other positions are undefined.
    """
    local = points @ view.cam_from_world[:3, :3].T + view.cam_from_world[:3, 3]
    in_front = local[:, 2] > NEAREST
    k = view.intrinsics
    depth = np.where(in_front, local[:, 2], 1.0)
    across = (k[0, 0] * local[:, 0] / depth + k[0, 2]) / view.width
    down = (k[1, 1] * local[:, 1] / depth + k[1, 2]) / view.height
    positions = np.stack([across, down], axis=1)
    return positions, in_front & (positions >= 0).all(axis=1) & (positions < 1).all(axis=1)


def count_visible_views(points: np.ndarray, views: Sequence[View]) -> np.ndarray:
    """Return (P,) int64 in how many of the views each of the points (P, 3) is visible."""
    counts = np.zeros(len(points), np.int64)
    for view in views:
        counts += project_points(points, view)[1]
    return counts


def focus_point(world_from_cam: np.ndarray) -> np.ndarray | None:
    """Return the (3,) point nearest to all optical axes (least squares), None for nearly parallel
    axes.

    ``world_from_cam``: (V, 4, 4) rigid OpenCV poses. The point may lie behind cameras, see
    ``fraction_in_front``.
    """
    centers = world_from_cam[:, :3, 3]
    axes = world_from_cam[:, :3, 2]
    middle = centers.mean(axis=0)
    projectors = np.eye(3) - axes[:, :, None] * axes[:, None, :]
    normal_matrix = projectors.mean(axis=0)
    if np.linalg.eigvalsh(normal_matrix)[0] <= 1e-4:
        return None
    right_side = np.einsum("vij,vj->i", projectors, centers - middle) / len(centers)
    return middle + np.linalg.solve(normal_matrix, right_side)


def fraction_in_front(world_from_cam: np.ndarray, point: np.ndarray) -> float:
    """Return the fraction of the cameras (V, 4, 4) that have ``point`` (3,) in front of them."""
    depth = np.einsum("vi,vi->v", point - world_from_cam[:, :3, 3], world_from_cam[:, :3, 2])
    return float((depth > 0).mean())


def estimate_focus(cameras: Cameras) -> np.ndarray:
    """Return the point (3,) float64 in front of the cameras that is nearest to their optical axes.

    For nearly parallel axes it lies in front of the mean camera, at three times the spread of the
    cameras (1 if they coincide).
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
    """Estimate the up direction (3,) of the scene from its cameras.

    Level cameras that look around have their right axes in one plane, whatever their tilt; up is
    its normal. Otherwise it is the mean of the cameras' own up directions.
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
    """Return the OpenCV camera-to-world pose (4, 4) at ``eye``: z towards ``target``, y away from
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


def cameras_at_poses(cameras: Cameras, poses: np.ndarray) -> Cameras:
    """Return cameras at camera-to-world ``poses`` (F, 4, 4) with the intrinsics, dtype and device
    of the first camera."""
    cam_from_world = torch.from_numpy(np.linalg.inv(poses)).to(cameras.cam_from_world)
    intrinsics = cameras.intrinsics[:1].expand(len(cam_from_world), 3, 3).clone()
    return Cameras(cam_from_world, intrinsics, cameras.width, cameras.height)


def world_from_cam(cameras: Cameras) -> np.ndarray:
    """Return the camera-to-world poses (V, 4, 4), float64."""
    if not len(cameras):
        raise ValueError("a camera path needs at least one camera")
    return np.linalg.inv(cameras.cam_from_world.detach().cpu().double().numpy())


def unit(a: np.ndarray) -> np.ndarray:
    """Normalise nonzero vectors (..., 3)."""
    return a / np.linalg.norm(a, axis=-1, keepdims=True)


def perpendicular(a: np.ndarray) -> np.ndarray:
    """Return a unit vector perpendicular to ``a`` (3,)."""
    return unit(np.cross(a, np.eye(3)[np.abs(a).argmin()]))
