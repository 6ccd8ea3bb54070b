"""The points that a scene begins with: those of the capture if they are real, else triangulated ones, else none."""

from __future__ import annotations

from dyngs.capture.point_check import points_fault
from dyngs.capture.triangulate import MIN_IMAGES, points_over_clip, triangulated_points, views_of_a_moment
from dyngs.config import DataConfig
from dyngs.data.capture import Capture, PointCloud
from dyngs.data.geometry.frusta import outside_of_cube

AROUND_ORIGIN = ("blender", "body_json")
"""Formats whose scenes lie around the origin by convention."""


def checked_points(capture: Capture, options: DataConfig) -> tuple[Capture, str | None]:
    """Return the capture, without its points if they are noise, and a line on that; None where they were not checked.

    Only points of a file that is not known to belong to the cameras are checked, see ``Capture.points_file``.

    Raises:
        DyngsError: images that cannot be read.
    """
    if capture.points is None or capture.points_file is None:
        return capture, None
    fault = points_fault(capture.points, capture.splits["train"], options)
    what = f"{capture.points_file.name}: {len(capture.points.xyz):,} points"
    if fault is None:
        return capture, f"{what}, which the first Gaussians are made from"
    return capture.replace(points=None, points_file=None), f"{what}, not used: {fault}"


def with_first_points(
    capture: Capture, options: DataConfig, triangulate: int, half_extent: float
) -> tuple[Capture, list[str]]:
    """Return the capture with the points that a scene begins with, None for random ones, and lines on the choice.

    Points are triangulated where there are none: from the images of a moment that several cameras show, else from
    those of a moving camera over the whole clip. Not where it is published custom to begin with random points: in the
    cube around the origin of Blender scenes that are still or show each moment from one side, if they lie there.

    Args:
        capture: of a scene.
        options: of the capture.
        triangulate: images of one moment at most; 0: nothing is triangulated.
        half_extent: half the side of the cube.

    Raises:
        DyngsError: images that cannot be read.
    """
    capture, line = checked_points(capture, options)
    lines = [] if line is None else [line]
    if capture.points is not None:
        return capture, lines
    views = capture.splits["train"]
    is_in_cube = False
    if capture.format in AROUND_ORIGIN:
        why = outside_of_cube(views, half_extent)
        is_in_cube = why is None
        if why is not None:
            lines.append(f"the scene does not lie around the origin, where Blender scenes do by custom: {why}")
    if triangulate == 0 or (is_in_cube and views[0].time is None):
        return capture, lines
    moment = views_of_a_moment(views, triangulate)
    points: PointCloud | None = None
    if views[0].time is None or len({view.cam_from_world.tobytes() for view in moment}) >= MIN_IMAGES:
        points = triangulated_points(moment, options)
    elif not is_in_cube:
        points = points_over_clip(views, options)
        if points is not None:
            lines.append(f"{len(points.xyz):,} points were triangulated over the whole clip")
    return capture.replace(points=points), lines
