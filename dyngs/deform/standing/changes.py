"""Changes in the pictures of a camera that stands still: where a picture differs from the median of all.

Local letters: T pictures of one camera.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from dyngs.camera import Cameras
from dyngs.data.loader import Picture

LONGEST_SIDE, PICTURES = 200, 2000
"""Pixels; larger pictures are shrunk: silhouettes need no more, and noise averages out. Of more pictures than that,
each is smaller, so that all of them together take as much memory."""
SMALLEST_CHANGE = 0.05
"""Least difference in a channel, of 1, that counts as a change."""
NOISE_MULTIPLE = 5.0
"""Differences below so many standard deviations of the noise, as estimated from the median, are no change."""
SURE = 2.0
"""A change must reach this multiple of its threshold somewhere, as in hysteresis thresholding (Canny 1986)."""
FEWEST_PIXELS = 6
DARKEST_SHADOW = 0.35
SHADOW_TINT = 0.14
"""A shadow leaves at least that share of the light and changes no channel by more than this share beyond the others."""
_MAD_TO_STD = 1.4826
_DARK = 0.03
"""Added to colours before they are divided."""


@dataclass(frozen=True)
class Footage:
    """Pictures of one camera that stands still, and what changes in them.

    Attributes:
        camera: (V = 1) of the pictures' size.
        times: T, ascending.
        pictures: (T, H, W, 3) uint8.
        changed: (T, H, W) bool: shows something that is elsewhere, or not there, at most other times.
        counted: (T, H, W) bool; False where the picture is masked out.
        median: (H, W, 3) uint8, what is still.
    """

    camera: Cameras
    times: tuple[float, ...]
    pictures: np.ndarray
    changed: np.ndarray
    counted: np.ndarray
    median: np.ndarray


def footage_of(pictures: Iterable[Picture], background: Tensor, total: int = 1) -> Footage:
    """Return the footage of one camera that stands still, on the CPU.

    Args:
        pictures: in order of time.
        background: (3,) colour behind them.
        total: number of pictures of all cameras.
    """
    longest = LONGEST_SIDE * min(1.0, (PICTURES / max(total, 1)) ** 0.5)
    shown, counted, times = [], [], []
    camera: Cameras | None = None
    for picture in pictures:
        small = picture.shrunk(math.ceil(max(picture.cameras.width, picture.cameras.height) / longest))
        rgb = small.composite(background).clamp(0, 1)
        shown.append((255 * rgb).round().to(torch.uint8).cpu().numpy())
        counted.append(np.ones(rgb.shape[:2], bool) if small.mask is None else small.mask.cpu().numpy() > 0.5)
        times.append(small.time or 0.0)
        camera = small.cameras.to(device="cpu")
    if camera is None:
        raise ValueError("no pictures")
    stack, valid = np.stack(shown), np.stack(counted)
    median = np.median(stack, axis=0).astype(np.uint8)
    return Footage(camera, tuple(times), stack, changes(stack) & valid, valid, median)


def median_picture(pictures: Sequence[Tensor]) -> Tensor:
    """Return the median (H, W, 3) over ``pictures`` of a camera in place: what is still, as it is."""
    return torch.stack(list(pictures)).median(0).values


def changes(pictures: np.ndarray) -> np.ndarray:
    """Return (T, H, W) bool: where ``pictures`` (T, H, W, 3), uint8, differ from their median, shadows left out.

    The threshold of a pixel is the largest of ``SMALLEST_CHANGE`` and a multiple of the noise, that of all pixels and
    its own; both are estimated by the median absolute deviation, which what moves does not affect. Of what lies above,
    connected parts without a pixel far above, and specks, are dropped; holes, as shadows leave them, are filled.
    """
    from scipy import ndimage

    values = pictures.astype(np.float32) / 255
    median = np.median(values, axis=0).astype(np.float32)
    apart = np.abs(values - median).max(-1)
    own = _MAD_TO_STD * np.median(apart, axis=0)
    threshold = np.maximum(SMALLEST_CHANGE, NOISE_MULTIPLE * np.maximum(own, _MAD_TO_STD * float(np.median(apart))))
    found = np.zeros(apart.shape, bool)
    for i, (difference, picture) in enumerate(zip(apart, values, strict=True)):
        differs = (difference > threshold) & ~_shadows(picture, median)
        differs = ndimage.binary_closing(np.pad(differs, 2), iterations=1)[2:-2, 2:-2]
        found[i] = _without_specks(np.asarray(ndimage.binary_fill_holes(differs)), difference / threshold)
    return found


def _without_specks(differs: np.ndarray, certainty: np.ndarray) -> np.ndarray:
    """Return ``differs`` (H, W) without small parts, and those in which ``certainty`` is below ``SURE`` all over."""
    from skimage.measure import label

    labels: np.ndarray = np.asarray(label(differs, connectivity=1))
    sizes = np.bincount(labels.ravel())
    peaks = np.zeros(len(sizes))
    np.maximum.at(peaks, labels.ravel(), certainty.ravel())
    kept = (sizes >= FEWEST_PIXELS) & (peaks > SURE)
    kept[0] = False
    return kept[labels]


def _shadows(picture: np.ndarray, median: np.ndarray) -> np.ndarray:
    """Return (H, W) bool: as the ``median`` but darker, all channels alike (after Horprasert et al. 1999)."""
    left = (picture + _DARK) / (median + _DARK)
    tint = left.max(-1) - left.min(-1)
    return (left.max(-1) < 1) & (left.min(-1) > DARKEST_SHADOW) & (tint < SHADOW_TINT)
