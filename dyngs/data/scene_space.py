"""Where a scene lies: the space that its cameras see, and moving it to the origin if that is far away."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from dyngs.data.body_frames import moved
from dyngs.data.capture import Capture, PointCloud, View, all_views, each_view
from dyngs.data.geometry import camera_center, focus_point, fraction_in_front, inverse_rigid, times_seen
from dyngs.data.times import evenly_spaced

NEAR_PER_FOCUS = 0.25  # nearest depth, in distances from the cameras to what they look at
FAR_PER_BASELINE = 38.0
"""Farthest depth, in the largest distance between cameras: from there it is seen under 1.5 degrees, COLMAP's least."""
MIN_VIEWS = 3
"""Images that see a random point, where there are as many."""
COUNTED_VIEWS = 60  # views, evenly spaced, in which points are counted
MIN_CUBE_SEEN = 0.5  # fraction of a cube that two cameras must see for the scene to lie in it


def depth_bounds(views: Sequence[View]) -> tuple[float, float]:
    """Return the nearest and the farthest depth, in world units, at which the cameras can tell depth.

    The nearest is ``NEAR_PER_FOCUS`` times the median distance of the cameras to the point that they look at; where the
    axes are parallel or part, times the largest distance between cameras. The farthest is ``FAR_PER_BASELINE`` times
    that distance, and at least twice the distance to the point. With all cameras at one place nothing can be told, and
    the bounds are those of cameras a unit apart.
    """
    poses = np.stack([inverse_rigid(view.cam_from_world) for view in views])
    centers = poses[:, :3, 3]
    baseline = 2 * float(np.linalg.norm(centers - centers.mean(axis=0), axis=1).max())
    baseline = baseline if baseline > 1e-6 else 1.0
    focus = focus_point(poses)
    distance = baseline
    if focus is not None and fraction_in_front(poses, focus) > 0.5:
        distance = float(np.median(np.linalg.norm(centers - focus, axis=1)))
    return NEAR_PER_FOCUS * distance, max(FAR_PER_BASELINE * baseline, 2 * distance)


def points_in_frusta(views: Sequence[View], unit: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return candidates (P, 3) for random points, and in how many of up to ``COUNTED_VIEWS`` views each lies.

    Each lies anywhere in the image of a random view; its inverse depth is uniform between ``depth_bounds``. ``unit``
    (P, 4) float64, uniform in [0, 1), says the view, the position across and down, the depth.
    """
    near, far = depth_bounds(views)
    depth = 1 / (1 / far + unit[:, 3] * (1 / near - 1 / far))
    chosen = np.minimum((unit[:, 0] * len(views)).astype(int), len(views) - 1)
    points = np.empty((len(unit), 3))
    for i in np.unique(chosen):
        rows, view = chosen == i, views[i]
        pixels = unit[rows, 1:3] * (view.width, view.height)
        rays = np.column_stack([pixels, np.ones(len(pixels))]) @ np.linalg.inv(view.intrinsics).T
        rotation = view.cam_from_world[:3, :3]
        points[rows] = (rays * depth[rows, None]) @ rotation + camera_center(view.cam_from_world)
    return points, times_seen(points, [views[i] for i in evenly_spaced(len(views), COUNTED_VIEWS)])


def outside_of_cube(views: Sequence[View], half_extent: float) -> str | None:
    """Return why the scene cannot lie in the cube around the origin, in a few words; None where it may.

    It does not where the point that the cameras look at is outside, or where two cameras (one, if there is one) see
    less than ``MIN_CUBE_SEEN`` of the cube. Half its side is ``half_extent``.
    """
    poses = np.stack([inverse_rigid(view.cam_from_world) for view in views])
    focus = focus_point(poses)
    if focus is not None and fraction_in_front(poses, focus) > 0.5 and np.abs(focus).max() > half_extent:
        return f"the cameras look at ({', '.join(f'{x:.3g}' for x in focus)})"
    steps = (np.arange(8) + 0.5) / 4 - 1
    grid = half_extent * np.stack(np.meshgrid(steps, steps, steps, indexing="ij"), axis=-1).reshape(-1, 3)
    seen = (times_seen(grid, views) >= min(2, len(views))).mean()
    if seen < MIN_CUBE_SEEN:
        return f"the cameras see {seen:.0%} of the cube of half side {half_extent:g} around it"
    return None


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

    def moved_view(view: View) -> View:
        pose = view.cam_from_world.copy()
        # Through the centre: R @ offset + t would first round both terms at the size of the offset.
        pose[:3, 3] = -pose[:3, :3] @ (camera_center(pose) - offset)
        return replace(view, cam_from_world=pose)

    splits = each_view(capture.splits, moved_view)
    points = capture.points and PointCloud(capture.points.xyz - offset, capture.points.rgb)
    body = capture.body and {name: moved(body, offset) for name, body in capture.body.items()}
    return replace(capture, splits=splits, points=points, body=body, world_offset=capture.world_offset + offset)
