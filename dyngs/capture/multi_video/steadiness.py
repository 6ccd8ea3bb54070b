"""Whether the camera of a video stands still, from small images: how far the image as a whole is displaced."""

from __future__ import annotations

import numpy as np
from scipy.ndimage import map_coordinates

from dyngs.data.times import evenly_spaced

STANDS = 0.002
"""A camera stands if its image is never displaced by more than this fraction of its longer side."""
SAMPLES = 16  # images that are compared with the typical one
_ITERATIONS = 16
_TOLD, _FLAT = 0.4, 1.0
"""Pixels that are looked at: this fraction of them, where the image changes most, by so many grey levels per pixel."""
_SCALES = (40.0, 20.0, 10.0, 5.0, 3.0)  # grey levels of the Cauchy weights in the first rounds, and in the later ones
_MOST_PIXELS = 0.5  # fraction of those pixels that must fit the displacement: so much stands
_FITS = 12.0  # grey levels within which they fit


def displaced_by(grey: np.ndarray) -> float:
    """Return how far the images (F, H, W) uint8 of a video are displaced against their median; see ``STANDS``.

    In fractions of the longer side; infinite where they have too little in common to tell. An affine displacement and
    a change of brightness are fitted to what most pixels show (iterated least squares with Cauchy weights), so that
    what moves before a fixed camera does not count. A camera that jumps far leaves no sharp median, and does not fit.
    """
    if len(grey) < 2:
        return 0.0
    chosen = [grey[i].astype(np.float64) for i in evenly_spaced(len(grey), SAMPLES)]
    typical = np.median(chosen, axis=0)
    if float(np.hypot(*np.gradient(typical)).max(initial=0.0)) < 2.0:  # nothing could tell a displacement
        return 0.0
    moved = [displacement(typical, image) for image in chosen]
    # A single image may be spoiled, by a flash or a hand before the lens.
    return float(np.quantile(moved, 0.95, method="lower"))


def displacement(one: np.ndarray, other: np.ndarray) -> float:
    """Return the largest displacement of a corner between two images (H, W), in fractions of the longer side.

    Infinite where fewer than half of the pixels that tell fit it.
    """
    height, width = one.shape
    rows, columns = np.mgrid[0:height, 0:width]
    x, y = (columns - width / 2) / max(width, height), (rows - height / 2) / max(width, height)
    slope = np.hypot(*np.gradient(one))
    told = slope >= max(float(np.quantile(slope, 1 - _TOLD)), _FLAT)  # even areas fit any displacement
    if not told.any():
        return np.inf
    parameters, residual = np.zeros(6), np.zeros(0)
    for round_number in range(_ITERATIONS):
        flow_x, flow_y = _flow(parameters, x, y)
        moved, is_inside = _sampled(other, columns + flow_x, rows + flow_y)
        used = is_inside & told
        if used.sum() < told.sum() / 4:
            return np.inf
        gradient_y, gradient_x = np.gradient(moved)
        along = (gradient_x, gradient_x * x, gradient_x * y, gradient_y, gradient_y * x, gradient_y * y, 1 + 0 * x)
        terms = np.stack([term[used] for term in along])
        residual = (one - moved)[used]
        residual = residual - np.median(residual)
        scale = max(1.4826 * float(np.median(np.abs(residual))), _SCALES[min(round_number, len(_SCALES) - 1)])
        weights = 1 / (1 + (residual / scale) ** 2)
        step = np.linalg.solve((terms * weights) @ terms.T + 1e-3 * np.eye(7), (terms * weights) @ residual)
        parameters += step[:6]
        if round_number >= len(_SCALES) and np.abs(step[:6]).max() < 1e-3:
            break
    if float((np.abs(residual) < _FITS).mean()) < _MOST_PIXELS:
        return np.inf
    at_x, at_y = (
        np.array(corners) * size / max(width, height)
        for corners, size in (((-0.5, 0.5, -0.5, 0.5), width), ((-0.5, -0.5, 0.5, 0.5), height))
    )
    flow_x, flow_y = _flow(parameters, at_x, at_y)
    return float(np.hypot(flow_x, flow_y).max() / max(width, height))


def _flow(parameters: np.ndarray, x: np.ndarray, y: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    a = parameters
    return a[0] + a[1] * x + a[2] * y, a[3] + a[4] * x + a[5] * y


def _sampled(image: np.ndarray, x: np.ndarray, y: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the image at places in px, bilinear, and which of them lie inside."""
    height, width = image.shape
    is_inside = (x >= 0) & (x <= width - 1) & (y >= 0) & (y <= height - 1)
    return map_coordinates(image, [y, x], order=1, mode="nearest"), is_inside
