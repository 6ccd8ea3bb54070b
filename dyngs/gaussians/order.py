"""The order in which files hold Gaussians: neighbours in space are neighbours there, and predict each other."""

from __future__ import annotations

import numpy as np

MORTON_BITS = 20  # Bits per coordinate; 60 in all
INNER, OUTLYING = 0.01, 64.0
"""Quantile and multiple of the box: points farther out than so many of its sides count as its edge."""


def morton_order(points: np.ndarray) -> np.ndarray:
    """Return (N,) indices of ``points`` (N, 3) along a Z-order curve through their box (Morton 1966); ties by index."""
    if not len(points):
        return np.zeros(0, dtype=np.int64)
    places = points.astype(np.float64)
    inner_low, inner_high = np.quantile(places, (INNER, 1 - INNER), axis=0, method="nearest")
    reach = OUTLYING * float((inner_high - inner_low).max())
    if reach > 0:
        places = places.clip(inner_low - reach, inner_high + reach)
    low = places.min(0)
    side = max(float((places.max(0) - low).max()), np.finfo(np.float64).tiny)
    cells = ((places - low) / side * (2**MORTON_BITS - 1)).astype(np.uint64)
    code = np.zeros(len(points), dtype=np.uint64)
    for bit in range(MORTON_BITS):
        for axis in range(3):
            code |= (cells[:, axis] >> np.uint64(bit) & np.uint64(1)) << np.uint64(3 * bit + axis)
    return np.argsort(code, kind="stable")


def storage_order(means: np.ndarray, rows: np.ndarray) -> np.ndarray:
    """Return (N,) indices of ``means`` (N, 3): moving ones (``rows``, (M,)), then the others, both in Morton order."""
    still = np.ones(len(means), dtype=bool)
    still[rows] = False
    rest = np.flatnonzero(still)
    return np.concatenate([rows[morton_order(means[rows])], rest[morton_order(means[rest])]]).astype(np.int64)
