"""Colours of small versions of the images at points in space."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from dyngs.config import DataConfig
from dyngs.data.capture import View
from dyngs.data.geometry import projected
from dyngs.data.loader import ImageLoader

LOOK_SIDE = 240
"""Longest side of the images that points are looked at in, px."""


def small_image(view: View, options: DataConfig) -> np.ndarray:
    """Return the small image of a view, (H, W, 4): colours on white, and alpha."""
    small = options.model_copy(
        update={"downscale": 1.0, "longest_side": LOOK_SIDE, "cache_mb": 0.0}
    )
    image = ImageLoader([view], small)[0]
    rgb = image.composite(image.rgb_premultiplied.new_ones(3)).numpy()
    alpha = np.ones(rgb.shape[:2], rgb.dtype) if image.alpha is None else image.alpha.numpy()
    return np.concatenate([rgb, alpha[..., None]], axis=2)


def colours_at(xyz: np.ndarray, shown: Sequence[tuple[View, np.ndarray]]) -> np.ndarray:
    """Return (V, P, 4) colours and alpha of the images at the points, NaN where they lie
    outside."""
    found = np.full((len(shown), len(xyz), 4), np.nan)
    for i, (view, image) in enumerate(shown):
        positions, inside = projected(xyz, view)
        size = np.array(image.shape[1::-1])
        column, row = np.minimum((positions[inside] * size).astype(int), size - 1).T
        found[i, inside] = image[row, column]
    return found
