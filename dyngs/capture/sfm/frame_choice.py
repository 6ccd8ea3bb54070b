"""Camera motion in videos: selection of frames for structure from motion, and detection of fixed
cameras."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np

from dyngs.data.times import evenly_spaced

MIN_CAMERA_MOTION = 0.003
"""Smallest motion since the first frame of a moving camera, in image widths."""
_WIDTH = 96
_TILES = 6
_TEXTURE = 1.0
_NOISE = 2e-4
_FASTEST = 4.0
_EVEN = 0.25
_BLURRED = 0.4


@dataclass(frozen=True)
class FrameMeasures:
    """Measures (F,) of each frame of a video.

    Attributes:
        sharpness: variance of the Laplacian of the brightness.
        motion: of most of the image since the frame before, as a fraction of its width; ``most``:
            of what moves most.
        away: motion of most of the image since the first frame: noise does not add up in it.
    """

    sharpness: np.ndarray
    motion: np.ndarray
    most: np.ndarray
    away: np.ndarray

    def __len__(self) -> int:
        return len(self.sharpness)


def measure_frames(frames: Iterable[np.ndarray]) -> FrameMeasures:
    """Measure all frames, (H, W, 3) uint8; three small images are held in memory."""
    sharpness = []
    motions = []
    away = []
    first = before = None
    for rgb in frames:
        small = small_brightness(rgb)
        first = small if first is None else first
        sharpness.append(sharpness_of(rgb))
        motions.append((0.0, 0.0) if before is None else motion_between(before, small))
        away.append(motion_between(first, small)[0])
        before = small
    motion, most = np.array(motions).reshape(-1, 2).T
    return FrameMeasures(np.array(sharpness), motion, most, np.array(away))


def choose_frames(measures: FrameMeasures, wanted: int) -> tuple[list[int], list[int]]:
    """Return at most ``wanted`` frame numbers, ascending, and those of them that are blurred.

    Frames are the sharpest in each of as many windows of equal motion. The motion of a frame is
    limited to ``_FASTEST`` times the median, with a small constant so that moving objects before a
    resting camera are covered. Repeated frames are skipped.
    """
    count = len(measures)
    still = measures.most <= _NOISE
    still[:1] = False
    kept = np.flatnonzero(~still)
    motion = measures.motion[kept]
    moving = motion[motion > _NOISE]
    typical = float(np.median(moving)) if len(moving) else 1.0
    steps = np.minimum(motion / typical, _FASTEST) * (1 - _EVEN) + _EVEN
    ends = np.cumsum(steps)
    windows = min(wanted, len(kept))
    places = (
        np.minimum((ends - steps / 2) / max(ends[-1], 1e-12) * windows, windows - 1)
        if count
        else ends
    )
    numbers = []
    for window in range(windows):
        members = kept[np.floor(places).astype(int) == window]
        if len(members):
            numbers.append(int(members[measures.sharpness[members].argmax()]))
    sharp = measures.sharpness[numbers]
    limit = _BLURRED * float(np.median(sharp)) if numbers else 0.0
    return numbers, [number for number, x in zip(numbers, sharp, strict=True) if x < limit]


def sharpness_of(rgb: np.ndarray) -> float:
    """Return the variance of the Laplacian of the brightness: higher is sharper."""
    grey = rgb[..., 1].astype(np.float32)
    laplacian = (
        4 * grey[1:-1, 1:-1] - grey[:-2, 1:-1] - grey[2:, 1:-1] - grey[1:-1, :-2] - grey[1:-1, 2:]
    )
    return float(laplacian.var()) if laplacian.size else 0.0


def small_brightness(rgb: np.ndarray) -> np.ndarray:
    """Return the brightness (h, w) float32 with about ``_WIDTH`` columns: means of whole blocks of
    pixels."""
    grey = rgb[..., 1]
    block = max(grey.shape[1] // _WIDTH, 1)
    rows = max(grey.shape[0] // block, 1)
    columns = max(grey.shape[1] // block, 1)
    cut = grey[: rows * block, : columns * block].astype(np.float32)
    return cut.reshape(rows, min(block, len(cut)), columns, -1).mean((1, 3))


def motion_between(before: np.ndarray, after: np.ndarray) -> tuple[float, float]:
    """Return how far an image has moved, as a fraction of its width: median and maximum over tiles
    with texture.

    Of a small motion it is the length of the part along the gradients (the normal flow), which does
    not need to know the direction; a motion by more than a pixel of the small images is
    underestimated. The mean brightness does not matter.
    """
    if min(before.shape) < 3:
        return 0.0, 0.0
    change = np.abs((after - after.mean()) - (before - before.mean()))[1:-1, 1:-1]
    middle = (before + after) / 2
    across = (middle[1:-1, 2:] - middle[1:-1, :-2]) / 2
    down = (middle[2:, 1:-1] - middle[:-2, 1:-1]) / 2
    slope = np.hypot(across, down)
    found = []
    for rows in np.array_split(np.arange(slope.shape[0]), min(_TILES, slope.shape[0])):
        for columns in np.array_split(np.arange(slope.shape[1]), min(_TILES, slope.shape[1])):
            tile = np.ix_(rows, columns)
            steep = float(slope[tile].mean())
            if steep > _TEXTURE:
                found.append(float(change[tile].mean()) / steep)
    if not found:
        return 0.0, 0.0
    return float(np.median(found)) / before.shape[1], max(found) / before.shape[1]


FIXED_CAMERA_LIMIT = 0.002
"""Largest image displacement of a fixed camera, in longer sides."""
SAMPLES = 16  # images that are compared with the median one


def camera_displacement(small: np.ndarray) -> float:
    """Return how far the small images (F, h, w) of a video are displaced from their median, in
    longer sides.

    It is the lower quartile of the optical flow at the pixels with the largest gradients, so that
    objects moving before a fixed camera do not count.
    """
    from skimage.registration import optical_flow_ilk

    chosen = small[evenly_spaced(len(small), SAMPLES)].astype(np.float32)
    typical = np.asarray(np.median(chosen, axis=0))
    # brightness may change
    chosen -= np.median(chosen - typical, axis=(1, 2), keepdims=True)
    if len(small) < 2 or min(typical.shape) < 2:
        return 0.0
    down, across = np.gradient(typical)
    slope = np.hypot(down, across)
    if slope.max() < 2.0:
        return 0.0  # nothing could show a displacement
    shows = slope >= max(float(np.quantile(slope, 0.6)), 1.0)
    side = max(typical.shape)
    moved = []
    for image in chosen:
        flow = np.linalg.norm(optical_flow_ilk(typical, image, radius=side // 13), axis=0)
        moved.append(float(np.quantile(flow[shows], 0.25)) / side)
    # A single image may be spoiled, by a flash or a hand before the lens.
    return float(np.quantile(moved, 0.95, method="lower"))
