"""Motion seen by two cameras that stand, sorted by the planes through both: what moves lies in one plane for both.

All planes that contain both cameras' centres cut both images in lines, which show the same part of the world. So the
amount of motion on them, over time, is nearly the same signal for both cameras, once their clocks agree (the motion
barcodes of epipolar lines, Ben-Artzi et al. 2016).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from dyngs.capture.multi_video.films import SmallImages
from dyngs.capture.multi_video.lags import Correlation, correlate

BINS = 48
"""Planes between the lowest and the highest one that both cameras see."""
_NOISE = 6.0
"""Differences below so many times the typical one are noise."""
_LEAST_CHANGE = 8.0
"""Grey levels below which a difference is noise anyway."""
_MIN_BASELINE = 1e-6


@dataclass(frozen=True)
class Watcher:
    """A camera that stands, with the motion that it sees.

    Attributes:
        center: (3,) in the world.
        rays: (P, 3) unit vectors in the world, of the P pixels of the small images, row by row.
        motion: (F, P) grey levels of change against what stands.
        seconds: (F,) of its own clock.
    """

    center: np.ndarray
    rays: np.ndarray
    motion: np.ndarray
    seconds: np.ndarray


def motion_of(images: SmallImages) -> np.ndarray:
    """Return (F, P) uint8: how much each pixel differs from the median of the clip, less what noise explains."""
    grey = images.grey
    every = max(len(grey) // 60, 1)
    typical = np.median(grey[::every], axis=0)
    motion = np.empty((len(grey), grey[0].size), np.uint8)
    for number, image in enumerate(grey):
        change = image - typical
        change = np.abs(change - np.median(change)).ravel()
        motion[number] = np.clip(change - max(_NOISE * float(np.median(change)), _LEAST_CHANGE), 0, 255)
    return motion


def even_rate(values: np.ndarray, seconds: np.ndarray, rate: float) -> np.ndarray:
    """Return (T, B) values at even times from 0 on, linear between those of (F,) ``seconds``."""
    times = np.arange(int(np.floor(seconds[-1] * rate + 1e-6)) + 1) / rate
    after = np.clip(np.searchsorted(seconds, times), 1, max(len(seconds) - 1, 1))
    before = after - 1
    if len(seconds) < 2:
        return values[:1].astype(np.float64)
    fraction = np.clip((times - seconds[before]) / np.maximum(seconds[after] - seconds[before], 1e-9), 0, 1)[:, None]
    return values[before] * (1 - fraction) + values[after] * fraction


def correlated_motion(a: Watcher, b: Watcher, rate: float, blur: float) -> Correlation | None:
    """Return how alike the motion of two cameras is at every shift; None where they share no planes.

    Args:
        a, b: cameras that stand.
        rate: samples per second of the shifts.
        blur: standard deviation in samples by which motion is blurred in time: what moves by more than its size from
            frame to frame is not alike otherwise.
    """
    bins = _bins_of(a, b)
    if bins is None:
        return None
    signals = [
        _blurred(even_rate(_binned(watcher.motion, own), watcher.seconds, rate), blur)
        for watcher, own in zip((a, b), bins, strict=True)
    ]
    return correlate(signals[0], signals[1])


def correlations(
    watchers: Sequence[Watcher], rate: float, most: int, blur: float
) -> dict[tuple[int, int], Correlation]:
    """Return the correlation of each camera with at most ``most`` others, those that look at it most alike.

    Args:
        watchers: cameras that stand.
        rate: samples per second of the shifts.
        most: others per camera.
        blur: in time, see ``correlated_motion``.
    """
    axes = np.stack([watcher.rays.mean(axis=0) for watcher in watchers])
    axes /= np.maximum(np.linalg.norm(axes, axis=1, keepdims=True), 1e-9)
    pairs = set()
    for i, likeness in enumerate(axes @ axes.T):
        nearest = [int(j) for j in np.argsort(-likeness, kind="stable") if j != i][:most]
        pairs |= {(min(i, j), max(i, j)) for j in nearest}
    found = {pair: correlated_motion(watchers[pair[0]], watchers[pair[1]], rate, blur) for pair in sorted(pairs)}
    return {pair: value for pair, value in found.items() if value is not None}


def _bins_of(a: Watcher, b: Watcher) -> tuple[np.ndarray, np.ndarray] | None:
    """Return for both cameras the plane of each pixel, -1 for planes that the other one does not see."""
    axis = b.center - a.center
    length = float(np.linalg.norm(axis))
    if length < _MIN_BASELINE:
        return None
    axis = axis / length
    middle = a.rays.mean(axis=0) + b.rays.mean(axis=0)
    ahead = middle - axis * (middle @ axis)
    if np.linalg.norm(ahead) < 1e-3:
        return None
    ahead /= np.linalg.norm(ahead)
    aside = np.cross(axis, ahead)
    angles = [np.arctan2(watcher.rays @ aside, watcher.rays @ ahead) for watcher in (a, b)]
    low = max(float(np.quantile(angle, 0.01)) for angle in angles)
    high = min(float(np.quantile(angle, 0.99)) for angle in angles)
    if high - low < 1e-3:
        return None
    placed = [np.floor((angle - low) / (high - low) * BINS).astype(int) for angle in angles]
    first, second = (np.where((place >= 0) & (place < BINS), place, -1) for place in placed)
    return first, second


def _blurred(values: np.ndarray, blur: float) -> np.ndarray:
    """Return (T, B) values blurred in time by a Gaussian, ``blur`` samples wide."""
    if blur == 0:
        return values
    reach = int(np.ceil(3 * blur))
    kernel = np.exp(-0.5 * (np.arange(-reach, reach + 1) / blur) ** 2)
    padded = np.pad(values, ((reach, reach), (0, 0)), mode="edge")
    windows = (padded[i : i + len(values)] * weight for i, weight in enumerate(kernel / kernel.sum()))
    return sum(windows, np.zeros(values.shape))


def _binned(motion: np.ndarray, bins: np.ndarray) -> np.ndarray:
    """Return (F, BINS) mean motion of the pixels of each plane."""
    which = np.zeros((len(bins), BINS), np.float32)
    kept = np.flatnonzero(bins >= 0)
    which[kept, bins[kept]] = 1.0
    which /= np.maximum(which.sum(axis=0), 1.0)
    sums = [motion[start : start + 256].astype(np.float32) @ which for start in range(0, len(motion), 256)]
    return np.concatenate(sums)
