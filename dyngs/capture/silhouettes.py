"""First points of an object before no background: random ones that all its silhouettes contain (the
visual hull)."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from dyngs.capture.looks import colours_at, small_image
from dyngs.config import DataConfig
from dyngs.data.capture import PointCloud, View
from dyngs.data.times import evenly_spaced

SILHOUETTES = 40
"""Images, evenly spaced, whose silhouettes are looked at."""
INSIDE = 0.5  # alpha from which a pixel belongs to the silhouette
# fraction of the silhouettes that may lack a point: of a pixel, or wrong themselves
MISTAKEN = 0.05
ENOUGH, DRAWS = 1000, 10
"""Points until which further ones are drawn, and how often at most. On lego 2,000 did as well as
5,000 or 20,000, whose runs ended with a quarter, and four fifths, more Gaussians."""
MOST = 0.5  # fraction of the points inside above which the silhouettes say nothing


def points_in_silhouettes(
    views: Sequence[View], options: DataConfig, num_random: int, half_side: float
) -> PointCloud | None:
    """Return random points of the cube around the origin that lie in the silhouettes, in the
    images' median colours.

    ``num_random`` are drawn, and as many again where few of them lie inside; ``half_side`` is half
    the side of the cube. None where images have no silhouettes, where those hold no points, or
    most.
    """
    shown = [
        (views[i], small_image(views[i], options)) for i in evenly_spaced(len(views), SILHOUETTES)
    ]
    if all(bool((image[..., 3] >= INSIDE).all()) for _, image in shown):
        return None
    rng = np.random.default_rng(0)
    xyz = np.zeros((0, 3))
    rgb = np.zeros((0, 3), np.uint8)
    for drawn in range(1, DRAWS + 1):
        points = half_side * (2 * rng.random((num_random, 3)) - 1)
        colours = colours_at(points, shown)
        outside = (colours[..., 3] < INSIDE).sum(axis=0)  # NaN, out of the image, is not below
        inside = (outside <= MISTAKEN * len(shown)) & ~np.isnan(colours[..., 3]).all(axis=0)
        if inside.sum() > MOST * len(points):
            return None
        median = np.nanmedian(colours[:, inside, :3], axis=0) if inside.any() else np.zeros((0, 3))
        xyz = np.concatenate([xyz, points[inside]])
        rgb = np.concatenate([rgb, np.rint(255 * median).astype(np.uint8)])
        if len(xyz) >= min(ENOUGH, num_random) or (drawn == 1 and not len(xyz)):
            break
    return PointCloud(xyz[:num_random], rgb[:num_random]) if len(xyz) else None
