"""Scene space: depth bounds, the volume that cameras see, and normalisation of scene
coordinates."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from dyngs.core.section import Length
from dyngs.data.body_frames import transform_body
from dyngs.data.capture import Capture, PointCloud, View, all_views, map_views
from dyngs.data.geometry import (
    camera_center,
    count_visible_views,
    focus_point,
    fraction_in_front,
    invert_rigid,
)
from dyngs.data.times import evenly_spaced

NEAR_PER_FOCUS = 0.25  # nearest depth, in distances from the cameras to what they look at
FAR_PER_BASELINE = 38.0
"""Farthest depth, in the largest distance between cameras: a triangulation angle of 1.5 degrees,
COLMAP's minimum."""
MIN_VIEWS = 3
"""Views that must see a random point, if there are as many."""
COUNTED_VIEWS = 60  # views, evenly spaced, in which points are counted
# 3DGS: 1.3 units in NeRF-synthetic scenes, whose cameras have an extent of 5.2
CUBE_PER_EXTENT = 0.25
MIN_CUBE_SEEN = 0.5  # fraction of a cube that two cameras must see for the scene to lie in it


def depth_bounds(views: Sequence[View]) -> tuple[float, float]:
    """Return the nearest and farthest depth, in world units, that the cameras can resolve.

    The nearest is ``NEAR_PER_FOCUS`` times the median distance of the cameras to their focus
    point, or times the largest distance between cameras if there is none. The farthest is
    ``FAR_PER_BASELINE`` times the largest distance between cameras, and at least twice the
    distance to the focus. Cameras at one position are treated as a unit apart.
    """
    poses = np.stack([invert_rigid(view.cam_from_world) for view in views])
    centers = poses[:, :3, 3]
    baseline = 2 * camera_extent(centers) / EXTENT_MARGIN or 1.0
    focus = focus_point(poses)
    distance = baseline
    if focus is not None and fraction_in_front(poses, focus) > 0.5:
        distance = float(np.median(np.linalg.norm(centers - focus, axis=1)))
    return NEAR_PER_FOCUS * distance, max(FAR_PER_BASELINE * baseline, 2 * distance)


def sample_points_in_frusta(
    views: Sequence[View], unit: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return random points (P, 3) in the view frusta, and the number of views that see each.

    Each point lies in a random pixel of a random view; its inverse depth is uniform between
    ``depth_bounds``. ``unit`` (P, 4) in [0, 1) selects the view, the position across and down, and
    the depth. Visibility is counted in up to ``COUNTED_VIEWS`` views.
    """
    near, far = depth_bounds(views)
    depth = 1 / (1 / far + unit[:, 3] * (1 / near - 1 / far))
    chosen = np.minimum((unit[:, 0] * len(views)).astype(int), len(views) - 1)
    points = np.empty((len(unit), 3))
    for i in np.unique(chosen):
        rows = chosen == i
        view = views[i]
        pixels = unit[rows, 1:3] * (view.width, view.height)
        rays = np.column_stack([pixels, np.ones(len(pixels))]) @ np.linalg.inv(view.intrinsics).T
        rotation = view.cam_from_world[:3, :3]
        points[rows] = (rays * depth[rows, None]) @ rotation + camera_center(view.cam_from_world)
    return points, count_visible_views(
        points, [views[i] for i in evenly_spaced(len(views), COUNTED_VIEWS)]
    )


def cube_half_side(half_extent: Length, views: Sequence[View], world_scale: float) -> float:
    """Return half the side, in scene units, of the cube that ``init.half_extent`` specifies."""
    if half_extent != "auto":
        return half_extent / world_scale
    return CUBE_PER_EXTENT * (camera_extent(camera_centers(views)) or TYPICAL_EXTENT)


def cube_mismatch_reason(views: Sequence[View], half_extent: float) -> str | None:
    """Return why the scene cannot lie in the cube around the origin, None if it may.

    It does not if the focus point of the cameras is outside, or if two cameras (one, if there is
    only one) see less than ``MIN_CUBE_SEEN`` of the cube.
    """
    poses = np.stack([invert_rigid(view.cam_from_world) for view in views])
    focus = focus_point(poses)
    if (
        focus is not None
        and fraction_in_front(poses, focus) > 0.5
        and np.abs(focus).max() > half_extent
    ):
        return f"the cameras look at ({', '.join(f'{x:.3g}' for x in focus)})"
    steps = (np.arange(8) + 0.5) / 4 - 1
    grid = half_extent * np.stack(np.meshgrid(steps, steps, steps, indexing="ij"), axis=-1).reshape(
        -1, 3
    )
    seen = (count_visible_views(grid, views) >= min(2, len(views))).mean()
    if seen < MIN_CUBE_SEEN:
        return f"the cameras see {seen:.0%} of the cube of half side {half_extent:g} around it"
    return None


EXTENT_MARGIN = 1.1
SMALLEST_EXTENT = 3.25
"""Smallest extent of a normalised scene; the largest is twice that. NeRF-synthetic scenes (5.2)
and many COLMAP models are within this range and keep their unit."""
TYPICAL_EXTENT = 4.6  # Middle of that range
MAX_DISTANCE = 100.0
"""Distance from the origin, in extents, beyond which a scene is recentred: float32 then has an
error of 0.01 px at a focal length of 1,000 px."""
DEPTH_PER_EXTENT = 20.0  # Median depth of the points, in extents, beyond which the depth decides
ROUNDING = 1e-8  # Relative error of a position written with eight digits
# Extent of the cameras, in median depths of the points, below which it does not set the unit
NEGLIGIBLE = 1e-3


def camera_centers(views: Sequence[View]) -> np.ndarray:
    """Return the camera positions (V, 3) in the world."""
    return np.array([camera_center(view.cam_from_world) for view in views])


def scene_extent(views: Sequence[View]) -> float:
    """Return ``camera_extent`` of the ``views``; 1 if all cameras share one position.

    Learning rates and size thresholds are relative to it.
    """
    return camera_extent(camera_centers(views)) or 1.0


def camera_extent(centers: np.ndarray) -> float:
    """Return 1.1 x the largest distance of a camera centre (V, 3) from their mean; 0 if it is
    rounding."""
    offsets = centers - centers.mean(axis=0)
    largest = float(np.linalg.norm(offsets, axis=1).max())
    return EXTENT_MARGIN * largest if largest > ROUNDING * float(np.abs(centers).max()) else 0.0


def normalise_capture(capture: Capture) -> Capture:
    """Return the capture in scene coordinates: near the origin and in a unit that suits
    thresholds.

    The unit is the power of two of the files' unit in which the extent of all cameras is at least
    ``SMALLEST_EXTENT`` and less than twice that; for a person it is about a metre. Scaling by a
    power of two is exact. If the median camera is farther than ``MAX_DISTANCE`` extents from the
    origin, the focus point of the cameras becomes the origin, or the median camera if they have
    none. See ``Capture.world_scale`` and ``Capture.world_offset``.
    """
    poses = np.array([invert_rigid(view.cam_from_world) for view in all_views(capture.splits)])
    centers = poses[:, :3, 3]
    median = np.median(centers, axis=0)
    length = _length(capture, centers)
    distance = float(np.linalg.norm(median))
    if distance > MAX_DISTANCE * (length or distance):
        focus = focus_point(poses)
        origin = median
        if (
            focus is not None
            and fraction_in_front(poses, focus) > 0.5
            and np.linalg.norm(focus - median) < length
        ):
            origin = focus
        capture = change_coordinates(
            capture, capture.world_scale, origin * capture.world_scale + capture.world_offset
        )
    if not length:
        return capture
    scale = 2.0 ** math.floor(math.log2(length / SMALLEST_EXTENT))
    return change_coordinates(capture, scale * capture.world_scale, capture.world_offset)


def _length(capture: Capture, centers: np.ndarray) -> float:
    """Return the length that is scaled to ``SMALLEST_EXTENT`` or up to twice that; 0 if
    undetermined.

    ``centers`` (V, 3) of all cameras.
    """
    if capture.body is not None:
        return TYPICAL_EXTENT * float(np.median(capture.body["train"].scale))
    extent = camera_extent(centers)
    if capture.points is None:
        return extent
    median_point = np.median(capture.points.xyz, axis=0)
    depth = float(np.median(np.linalg.norm(centers - median_point, axis=1)))
    return depth if extent < NEGLIGIBLE * depth else max(extent, depth / DEPTH_PER_EXTENT)


def change_coordinates(
    capture: Capture, scale: float, offset: Sequence[float] | np.ndarray
) -> Capture:
    """Return the capture in scene coordinates with this ``world_scale`` and ``world_offset``
    (3,)."""
    offset = np.asarray(offset, np.float64)
    if scale == capture.world_scale and (offset == capture.world_offset).all():
        return capture
    # A point x is ``factor * (x - shift)`` in the other coordinates.
    factor = capture.world_scale / scale
    shift = (offset - capture.world_offset) / capture.world_scale

    def moved_view(view: View) -> View:
        pose = view.cam_from_world.copy()
        # Through the centre: R @ shift + t would first round both terms at the size of the shift.
        center = camera_center(pose) - shift if shift.any() else None
        translation = pose[:3, 3] if center is None else -pose[:3, :3] @ center
        pose[:3, 3] = factor * translation
        return replace(view, cam_from_world=pose, depth_scale=factor * view.depth_scale)

    points = capture.points and PointCloud(
        factor * (capture.points.xyz - shift), capture.points.rgb
    )
    body = capture.body and {
        name: transform_body(x, shift, factor) for name, x in capture.body.items()
    }
    return replace(
        capture,
        splits=map_views(capture.splits, moved_view),
        points=points,
        body=body,
        world_scale=scale,
        world_offset=offset,
    )
