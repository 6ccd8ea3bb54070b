"""Focus point of a set of cameras: the point that they look at."""

from __future__ import annotations

import numpy as np


def focus_point(world_from_cam: np.ndarray) -> np.ndarray | None:
    """Return the (3,) point nearest to all optical axes (least squares), None where the axes are nearly parallel.

    It may lie behind the cameras; see ``share_in_front``.

    Args:
        world_from_cam: (V, 4, 4) rigid OpenCV poses.
    """
    centers, axes = world_from_cam[:, :3, 3], world_from_cam[:, :3, 2]
    middle = centers.mean(axis=0)
    projectors = np.eye(3) - axes[:, :, None] * axes[:, None, :]
    normal_matrix = projectors.mean(axis=0)
    if np.linalg.eigvalsh(normal_matrix)[0] <= 1e-4:
        return None
    right_side = np.einsum("vij,vj->i", projectors, centers - middle) / len(centers)
    return middle + np.linalg.solve(normal_matrix, right_side)


def fraction_in_front(world_from_cam: np.ndarray, point: np.ndarray) -> float:
    """Return the share in [0, 1] of the cameras (V, 4, 4) that have ``point`` (3,) in front of them."""
    depth = np.einsum("vi,vi->v", point - world_from_cam[:, :3, 3], world_from_cam[:, :3, 2])
    return float((depth > 0).mean())
