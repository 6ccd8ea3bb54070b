"""Points projected into views, in fractions of the image: which views see which points."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from dyngs.data.capture import View

NEAREST = 1e-9
"""Points nearer to a camera's plane than this, in world units, or behind it are not seen."""


def projected(points: np.ndarray, view: View) -> tuple[np.ndarray, np.ndarray]:
    """Return the places of points in an image: (P, 2) in [0, 1] across and down, and (P,) whether they lie in it.

    As a pinhole camera sees them; places of points that are not in the image mean nothing.

    Args:
        points: (P, 3) float64 in the world of the view.
        view: its camera; only pose, intrinsics and size count.
    """
    local = points @ view.cam_from_world[:3, :3].T + view.cam_from_world[:3, 3]
    in_front = local[:, 2] > NEAREST
    k, depth = view.intrinsics, np.where(in_front, local[:, 2], 1.0)
    across = (k[0, 0] * local[:, 0] / depth + k[0, 2]) / view.width
    down = (k[1, 1] * local[:, 1] / depth + k[1, 2]) / view.height
    places = np.stack([across, down], axis=1)
    return places, in_front & (places >= 0).all(axis=1) & (places < 1).all(axis=1)


def times_seen(points: np.ndarray, views: Sequence[View]) -> np.ndarray:
    """Return (P,) int64: in how many of the views each of the points (P, 3) lies."""
    counts = np.zeros(len(points), np.int64)
    for view in views:
        counts += projected(points, view)[1]
    return counts
