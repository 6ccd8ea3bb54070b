"""Changes in the images of fixed cameras.

Local letters: T images of one camera.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from dyngs.core.camera import Cameras
from dyngs.data.loader import Image

LONGEST_SIDE, MAX_FULL_IMAGES = 200, 2000
"""Longest side in pixels after downscaling, and number of images up to which it holds.

More images are downscaled further, so that all of them take the same memory.
"""
SMALLEST_CHANGE = 0.05  # smallest change of a channel in [0, 1]
NOISE_MULTIPLE = 5.0
"""Smallest change in standard deviations of the noise, which is estimated from the median."""
# A region must exceed its threshold by this factor somewhere (hysteresis, Canny 1986).
HYSTERESIS = 2.0
MIN_PIXELS = 6
DARKEST_SHADOW = 0.35
SHADOW_TINT = 0.14
"""A shadow leaves at least ``DARKEST_SHADOW`` of the light, and its channels differ by at most
this."""
_MAD_TO_STD = 1.4826
_DARK = 0.03  # added to colours before division


@dataclass(frozen=True)
class FixedCameraClip:
    """Images of one fixed camera, and the changes in them."""

    camera: Cameras  # (V = 1), with the size of the images
    times: tuple[float, ...]  # T, ascending
    images: np.ndarray  # (T, H, W, 3) uint8
    # (T, H, W) bool, pixels that differ from the static background.
    changed: np.ndarray
    counted: np.ndarray  # (T, H, W) bool; False where the image is masked
    median: np.ndarray  # (H, W, 3) uint8, static background


def build_fixed_camera_clip(
    images: Iterable[Image], background: Tensor, total: int = 1
) -> FixedCameraClip:
    """Build the clip of one fixed camera, on the CPU.

    ``total``: number of images of all cameras.
    """
    longest = LONGEST_SIDE * min(1.0, (MAX_FULL_IMAGES / max(total, 1)) ** 0.5)
    shown = []
    counted = []
    times = []
    camera: Cameras | None = None
    for image in images:
        small = image.downscaled(
            math.ceil(max(image.cameras.width, image.cameras.height) / longest)
        )
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
    return FixedCameraClip(
        camera, tuple(times), stack, detect_changes(stack) & valid, valid, median
    )


def detect_changes(images: np.ndarray) -> np.ndarray:
    """Return a mask (T, H, W) where ``images`` (T, H, W, 3), uint8, differ from their median.

    The threshold per pixel is the largest of ``SMALLEST_CHANGE`` and a multiple of the noise, of
    all pixels and of its own. Noise is estimated by the median absolute deviation, which is robust
    to motion. Shadows, weak regions and specks are dropped; holes are filled.
    """
    from scipy import ndimage

    values = images.astype(np.float32) / 255
    median = np.median(values, axis=0).astype(np.float32)
    difference_maps = np.abs(values - median).max(-1)
    own = _MAD_TO_STD * np.median(difference_maps, axis=0)
    threshold = np.maximum(
        SMALLEST_CHANGE,
        NOISE_MULTIPLE * np.maximum(own, _MAD_TO_STD * float(np.median(difference_maps))),
    )
    masks = np.zeros(difference_maps.shape, bool)
    for i, (difference, image) in enumerate(zip(difference_maps, values, strict=True)):
        differs = (difference > threshold) & ~detect_shadows(image, median)
        differs = ndimage.binary_closing(np.pad(differs, 2), iterations=1)[2:-2, 2:-2]
        masks[i] = _drop_specks(
            np.asarray(ndimage.binary_fill_holes(differs)), difference / threshold
        )
    return masks


def _drop_specks(differs: np.ndarray, certainty: np.ndarray) -> np.ndarray:
    """Drop small regions, and regions where ``certainty`` is below ``HYSTERESIS`` everywhere."""
    from scipy import ndimage
    from skimage.measure import label

    labels: np.ndarray = np.asarray(label(differs, connectivity=1))
    sizes = np.bincount(labels.ravel())
    peaks = ndimage.maximum(certainty, labels, np.arange(len(sizes)))
    kept = (sizes >= MIN_PIXELS) & (peaks > HYSTERESIS)
    kept[0] = False
    return kept[labels]


def detect_shadows(image: np.ndarray, static: np.ndarray) -> np.ndarray:
    """Return a mask (..., H, W) of shadows: pixels darker than ``static`` by one factor.

    After Horprasert et al. 1999.
    """
    left = (image + _DARK) / (static + _DARK)
    tint = left.max(-1) - left.min(-1)
    return (left.max(-1) < 1) & (left.min(-1) > DARKEST_SHADOW) & (tint < SHADOW_TINT)
