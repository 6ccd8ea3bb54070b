"""Recentre a scene that lies far from its origin, in float64, before anything is rounded to float32."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from dyngs.data.body_frames import moved
from dyngs.data.capture import Capture, PointCloud, View, all_views
from dyngs.data.geometry.poses import camera_center

MAX_DISTANCE = 1e5
MAX_DISTANCE_PER_SPREAD = 1e4
HARMLESS_DISTANCE = 1e3
"""Nearer scenes are not moved, however small the spread of their cameras (that of one static camera is 0)."""


def recenter(capture: Capture) -> Capture:
    """Return the capture with its median camera at the origin if that is far away, else the capture itself.

    Far: the median camera centre is more than 1e5 units from the origin, or more than 1e4 times the cameras' spread
    (median distance from that centre). What is subtracted is added to ``world_offset``.
    """
    centers = np.array([camera_center(view.cam_from_world) for view in all_views(capture.splits)])
    median = np.median(centers, axis=0)
    spread = float(np.median(np.linalg.norm(centers - median, axis=1)))
    distance = float(np.linalg.norm(median))
    too_far = distance > MAX_DISTANCE or distance > max(MAX_DISTANCE_PER_SPREAD * spread, HARMLESS_DISTANCE)
    return shifted(capture, median) if too_far else capture


def shifted(capture: Capture, offset: np.ndarray) -> Capture:
    """Return the capture with ``offset`` (3,) subtracted from all positions and added to ``world_offset``."""
    splits = {name: tuple(_shifted_view(view, offset) for view in views) for name, views in capture.splits.items()}
    points = capture.points and PointCloud(capture.points.xyz - offset, capture.points.rgb)
    body = capture.body and {name: moved(body, offset) for name, body in capture.body.items()}
    return replace(capture, splits=splits, points=points, body=body, world_offset=capture.world_offset + offset)


def _shifted_view(view: View, offset: np.ndarray) -> View:
    pose = view.cam_from_world.copy()
    # Through the centre: R @ offset + t would first round both terms at the size of the offset.
    pose[:3, 3] = -pose[:3, :3] @ (camera_center(pose) - offset)
    return replace(view, cam_from_world=pose)
