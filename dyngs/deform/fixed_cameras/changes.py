"""Changes in the images of a camera that stands still: where an image differs from the median of
all.

Local letters: T images of one camera.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from dyngs.core.camera import Cameras
from dyngs.data.loader import Image

LONGEST_SIDE, IMAGES = 200, 2000
"""Pixels; larger images are shrunk: silhouettes need no more, and noise averages out. Of more
images than that, each is smaller, so that all of them together take as much memory."""
SMALLEST_CHANGE = 0.05  # Least difference in a channel, of 1, that counts as a change
NOISE_MULTIPLE = 5.0
"""Differences below so many standard deviations of the noise, as estimated from the median, are no
change."""
# A change must reach this multiple of its threshold somewhere, as in hysteresis thresholding (Canny
# 1986)
SURE = 2.0
FEWEST_PIXELS = 6
DARKEST_SHADOW = 0.35
SHADOW_TINT = 0.14
"""A shadow leaves at least that fraction of the light and changes no channel by more than this
share beyond the others."""
_MAD_TO_STD = 1.4826
_DARK = 0.03  # Added to colours before they are divided


@dataclass(frozen=True)
class Footage:
    """Images of one camera that stands still, and what changes in them."""

    camera: Cameras  # (V = 1) of the images' size
    times: tuple[float, ...]  # T, ascending
    images: np.ndarray  # (T, H, W, 3) uint8
    # (T, H, W) bool: shows something that is elsewhere, or not there, at most other times
    changed: np.ndarray
    counted: np.ndarray  # (T, H, W) bool; False where the image is masked out
    median: np.ndarray  # (H, W, 3) uint8, what is still


def footage_of(images: Iterable[Image], background: Tensor, total: int = 1) -> Footage:
    """Return the frames of one camera that stands still, on the CPU."""
    longest = LONGEST_SIDE * min(1.0, (IMAGES / max(total, 1)) ** 0.5)
    shown = []
    counted = []
    times = []
    camera: Cameras | None = None
    for image in images:
        small = image.shrunk(math.ceil(max(image.cameras.width, image.cameras.height) / longest))
        rgb = small.composite(background).clamp(0, 1)
        shown.append((255 * rgb).round().to(torch.uint8).cpu().numpy())
        counted.append(
            np.ones(rgb.shape[:2], bool) if small.mask is None else small.mask.cpu().numpy() > 0.5
        )
        times.append(small.time or 0.0)
        camera = small.cameras.to(device="cpu")
    if camera is None:
        raise ValueError("no images")
    stack = np.stack(shown)
    valid = np.stack(counted)
    median = np.median(stack, axis=0).astype(np.uint8)
    return Footage(camera, tuple(times), stack, changes(stack) & valid, valid, median)


def median_image(images: Sequence[Tensor]) -> Tensor:
    """Return the median (H, W, 3) over ``images`` of a camera in place: what is still, as it is."""
    return torch.stack(list(images)).median(0).values


def changes(images: np.ndarray) -> np.ndarray:
    """Return (T, H, W) bool: where ``images`` (T, H, W, 3), uint8, differ from their median,
    shadows left out.

    The threshold of a pixel is the largest of ``SMALLEST_CHANGE`` and a multiple of the noise, that
    of all pixels and its own; both are estimated by the median absolute deviation, which what moves
    does not affect. Of what lies above, connected parts without a pixel far above, and specks, are
    dropped; holes, as shadows leave them, are filled.
    """
    from scipy import ndimage

    values = images.astype(np.float32) / 255
    median = np.median(values, axis=0).astype(np.float32)
    apart = np.abs(values - median).max(-1)
    own = _MAD_TO_STD * np.median(apart, axis=0)
    threshold = np.maximum(
        SMALLEST_CHANGE, NOISE_MULTIPLE * np.maximum(own, _MAD_TO_STD * float(np.median(apart)))
    )
    found = np.zeros(apart.shape, bool)
    for i, (difference, image) in enumerate(zip(apart, values, strict=True)):
        differs = (difference > threshold) & ~shadows(image, median)
        differs = ndimage.binary_closing(np.pad(differs, 2), iterations=1)[2:-2, 2:-2]
        found[i] = _without_specks(
            np.asarray(ndimage.binary_fill_holes(differs)), difference / threshold
        )
    return found


def _without_specks(differs: np.ndarray, certainty: np.ndarray) -> np.ndarray:
    """Return ``differs`` (H, W) without small parts, and those in which ``certainty`` is below
    ``SURE`` all over."""
    from skimage.measure import label

    labels: np.ndarray = np.asarray(label(differs, connectivity=1))
    sizes = np.bincount(labels.ravel())
    peaks = np.zeros(len(sizes))
    np.maximum.at(peaks, labels.ravel(), certainty.ravel())
    kept = (sizes >= FEWEST_PIXELS) & (peaks > SURE)
    kept[0] = False
    return kept[labels]


def shadows(image: np.ndarray, still: np.ndarray) -> np.ndarray:
    """Return (..., H, W) bool: as ``still`` but darker, all channels alike (after Horprasert et al.
    1999)."""
    left = (image + _DARK) / (still + _DARK)
    tint = left.max(-1) - left.min(-1)
    return (left.max(-1) < 1) & (left.min(-1) > DARKEST_SHADOW) & (tint < SHADOW_TINT)
