"""The points that a scene begins with: those of the capture unless they are noise, else triangulated, else none."""

from __future__ import annotations

import warnings
from collections.abc import Sequence

import numpy as np

from dyngs.capture.triangulate import MIN_IMAGES, points_over_clip, triangulated_points, views_of_a_time_step
from dyngs.config import DataConfig
from dyngs.data.capture import Capture, PointCloud, View
from dyngs.data.geometry import camera_center, projected, times_seen
from dyngs.data.loader import ImageLoader
from dyngs.data.scene_space import outside_of_cube
from dyngs.data.times import evenly_spaced

AROUND_ORIGIN = ("blender", "body_json")
"""Formats whose scenes lie around the origin by convention."""


def checked_points(capture: Capture, options: DataConfig) -> tuple[Capture, str | None]:
    """Return the capture, without its points if they are noise, and a line on that; None where they were not checked.

    Only points of a file that is not known to belong to the cameras are checked, see ``Capture.points_file``.
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

    Points are triangulated where there are none: from the images of a time step that several cameras show, else from
    those of a moving camera over the full clip. Not where it is published custom to begin with random points: in the
    cube around the origin of Blender scenes that are still or show each time step from one side, if they lie there.

    Args:
        triangulate: images of one time step at most; 0: nothing is triangulated.
        half_extent: half the side of the cube.
    """
    capture, line = checked_points(capture, options)
    lines = [] if line is None else [line]
    if capture.points is not None:
        return capture, lines
    views = capture.splits["train"]
    is_by_custom = capture.format in AROUND_ORIGIN
    why = outside_of_cube(views, half_extent) if is_by_custom else None
    is_in_cube = is_by_custom and why is None
    if why is not None:
        lines.append(f"the scene does not lie around the origin, where Blender scenes do by custom: {why}")
    if triangulate == 0 or (is_in_cube and views[0].time is None):
        return capture, lines
    moment = views_of_a_time_step(views, triangulate)
    points: PointCloud | None = None
    if views[0].time is None or len({view.cam_from_world.tobytes() for view in moment}) >= MIN_IMAGES:
        points = triangulated_points(moment, options)
    elif not is_in_cube:
        points = points_over_clip(views, options)
        if points is not None:
            lines.append(f"{len(points.xyz):,} points were triangulated over the full clip")
    return capture.replace(points=points), lines


SAMPLE = 2000  # points that are looked at
LONGEST_SIDE = 240
"""Of the images that they are looked at in, px."""
GROUPS, GROUP = 3, 5  # groups of images from about the same time step, and images of each
MIN_SEEN = 0.1  # points of which a smaller fraction lies in any image do not belong to the cameras
COLOURS_FIT, PLACES_FIT = 0.85, 0.9  # points fit if their error is smaller than that of chance by this factor
_INNER = (2.0, 98.0)  # percentiles of the points between which random ones are drawn


def points_fault(points: PointCloud, views: Sequence[View], options: DataConfig) -> str | None:
    """Return why the points are noise, in a few words, or None where they fit the images.

    They fit where one of two tests is passed, over images from about the same time steps:

    - Their colours are nearer to the images' at their places than to those at the places of other points: the mean
      of the median difference over images is below ``COLOURS_FIT`` times that with colours and points shuffled.
    - Their places agree between images: the spread of the images' colours (and alpha) at a point, over the spread
      with the points shuffled in each image, is below ``PLACES_FIT`` times the same ratio of points drawn at random
      in the box of the points, among images of a time step or among all of them (neighbours may be too near each other
      to tell). Shuffling keeps the colours of each image, so a plain background does not count.
    """
    rng = np.random.default_rng(0)
    chosen = np.sort(rng.permutation(len(points.xyz))[:SAMPLE])
    xyz, rgb = points.xyz[chosen], points.rgb[chosen] / 255.0
    seen = times_seen(xyz, [views[i] for i in evenly_spaced(len(views), 300)]) > 0
    if seen.mean() < MIN_SEEN:
        return f"{seen.mean():.0%} of them are in any camera's view"
    groups = [[views[i] for i in group] for group in groups_of(views)]
    shown = [(view, _image(view, options)) for group in groups for view in group]
    colours = _colours_at(xyz, shown)
    if _colour_ratio(colours[..., :3], rgb, rng) < COLOURS_FIT:
        return None
    low, high = np.percentile(xyz, _INNER, axis=0)
    at_random = _colours_at(low + (high - low) * rng.random(xyz.shape), shown)
    for sizes in ([len(group) for group in groups], [len(shown)]):
        if _place_ratio(colours, sizes, rng) < PLACES_FIT * _place_ratio(at_random, sizes, rng):
            return None
    return "no better than random ones"


def groups_of(views: Sequence[View]) -> list[list[int]]:
    """Return indices of ``GROUPS`` groups of up to ``GROUP`` views: from about the same time step each.

    Views without times are of one time step; then the groups are of cameras near each other.
    """
    size = min(GROUP, len(views))
    if any(view.time is None for view in views):
        centers = np.array([camera_center(view.cam_from_world) for view in views])
        anchors = evenly_spaced(len(views), GROUPS)
        return [list(np.argsort(np.linalg.norm(centers - centers[i], axis=1), kind="stable")[:size]) for i in anchors]
    order = sorted(range(len(views)), key=lambda i: (views[i].time or 0.0, i))
    count = min(GROUPS, len(order) // size)
    starts = [(len(order) - size) * k // max(count - 1, 1) for k in range(count)]
    return [order[start : start + size] for start in starts]


def _image(view: View, options: DataConfig) -> np.ndarray:
    """Return the small image of a view, (H, W, 4): colours on white, and alpha."""
    small = options.model_copy(update={"downscale": 1.0, "longest_side": LONGEST_SIDE, "cache_mb": 0.0})
    image = ImageLoader([view], small)[0]
    rgb = image.composite(image.rgb_premultiplied.new_ones(3)).numpy()
    alpha = np.ones(rgb.shape[:2], rgb.dtype) if image.alpha is None else image.alpha.numpy()
    return np.concatenate([rgb, alpha[..., None]], axis=2)


def _colours_at(xyz: np.ndarray, shown: Sequence[tuple[View, np.ndarray]]) -> np.ndarray:
    """Return (V, P, 4) colours and alpha of the images at the points, NaN where they lie outside."""
    found = np.full((len(shown), len(xyz), 4), np.nan)
    for i, (view, image) in enumerate(shown):
        positions, inside = projected(xyz, view)
        size = np.array(image.shape[1::-1])
        column, row = np.minimum((positions[inside] * size).astype(int), size - 1).T
        found[i, inside] = image[row, column]
    return found


def _colour_ratio(colours: np.ndarray, rgb: np.ndarray, rng: np.random.Generator) -> float:
    """Return the median error over images of the points' ``rgb`` (P, 3), over that of shuffled points.

    ``colours`` (V, P, 3) of the images are NaN outside; 1 for points of one colour.
    """
    seen = ~np.isnan(colours[..., 0]).all(axis=0)
    colours, rgb = colours[:, seen], rgb[seen]
    if not len(rgb) or np.ptp(rgb, axis=0).max() == 0:
        return 1.0
    own, other = (
        np.nanmedian(np.abs(colours - x).mean(axis=2), axis=0).mean() for x in (rgb, rgb[rng.permutation(len(rgb))])
    )
    return float(own / max(other, 1e-9))


def _place_ratio(colours: np.ndarray, sizes: Sequence[int], rng: np.random.Generator) -> float:
    """Return the spread of colours between the images of a group, over that with points shuffled in each image.

    ``colours`` (V, P, 4) of the images, group by group of these ``sizes``, are NaN outside.
    """
    own = shuffled = 0.0
    for block in np.split(colours, np.cumsum(sizes)[:-1]):
        mixed = block.copy()
        for row in mixed:
            inside = np.flatnonzero(~np.isnan(row[:, 0]))
            row[inside] = row[rng.permutation(inside)]
        several = (~np.isnan(block[..., 0])).sum(axis=0) > 1
        own += _spread(block[:, several])
        shuffled += _spread(mixed[:, several])
    return own / shuffled if shuffled > 0 else 1.0


def _spread(colours: np.ndarray) -> float:
    """Return the sum over points of the mean absolute deviation from the median over images; (V, P, 4) with NaN."""
    if not colours.shape[1]:
        return 0.0
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", RuntimeWarning)  # points that were shuffled into no image
        deviation = np.abs(colours - np.nanmedian(colours, axis=0)).mean(axis=2)
        return float(np.nansum(np.nanmean(deviation, axis=0)))
