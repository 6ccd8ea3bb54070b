"""Distances of points to the surfaces of the synthetic room."""

from __future__ import annotations

import numpy as np

from dyngs.data.capture import View
from dyngs.data.synthetic.captures import scene_at


def distances_to_surface(points: np.ndarray, views: list[View], time: float) -> np.ndarray:
    """Along the rays of the camera that sees each point best."""
    best = np.full(len(points), np.inf)
    for view in views:
        center = -view.cam_from_world[:3, :3].T @ view.cam_from_world[:3, 3]
        offset = points - center
        far = np.linalg.norm(offset, axis=1)
        origins = np.tile(center.astype(np.float32), (len(points), 1))
        rays = (offset / far[:, None]).astype(np.float32)
        hits = np.min(
            [thing.intersect(origins, rays) for thing in scene_at("room", time).primitives], axis=0
        )
        best = np.minimum(best, np.abs(hits - far))
    return best
