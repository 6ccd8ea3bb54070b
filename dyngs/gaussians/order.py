"""The order of Gaussians in memory and in files: neighbours in space are neighbours there, and
predict each other."""

from __future__ import annotations

import numpy as np

MORTON_BITS = 20  # Bits per coordinate; 60 in all
INNER, OUTLYING = 0.01, 64.0
"""Quantile and multiple of the box: points farther out than so many of its sides count as its
edge."""
SPREADING = (
    (32, 0x001F00000000FFFF),
    (16, 0x001F0000FF0000FF),
    (8, 0x100F00F00F00F00F),
    (4, 0x10C30C30C30C30C3),
    (2, 0x1249249249249249),
)
"""Shifts and masks that put two zeros before every bit of a number of up to 21 bits."""


def morton_order(points: np.ndarray) -> np.ndarray:
    """Return (N,) indices of ``points`` (N, 3) along a Z-order curve through their box (Morton
    1966); ties by index."""
    if not len(points):
        return np.zeros(0, dtype=np.int64)
    places = points.astype(np.float64)
    inner_low, inner_high = np.quantile(places, (INNER, 1 - INNER), axis=0, method="nearest")
    reach = OUTLYING * float((inner_high - inner_low).max())
    if reach > 0:
        places = places.clip(inner_low - reach, inner_high + reach)
    low = places.min(0)
    side = max(float((places.max(0) - low).max()), np.finfo(np.float64).tiny)
    bits = ((places - low) / side * (2**MORTON_BITS - 1)).astype(np.uint64)
    for shift, mask in SPREADING:
        bits = (bits | bits << np.uint64(shift)) & np.uint64(mask)
    code = bits[:, 0] | bits[:, 1] << np.uint64(1) | bits[:, 2] << np.uint64(2)
    return np.argsort(code, kind="stable")


def storage_order(means: np.ndarray, rows: np.ndarray) -> np.ndarray:
    """Return (N,) indices of ``means`` (N, 3): moving ones (``rows``, (M,)), then the others, both
    in Morton order."""
    still = np.ones(len(means), dtype=bool)
    still[rows] = False
    rest = np.flatnonzero(still)
    return np.concatenate(
        [rows[morton_order(means[rows])], rest[morton_order(means[rest])]]
    ).astype(np.int64)
