"""Masks of a person by the difference from the background, where the camera stands: what most frames show at a pixel.

Local letters: F frames of one camera, H height, W width.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy import ndimage

NOISE = 1.5
"""Least standard deviation of the background that is expected, grey levels."""
LOW, HIGH = 5.0, 12.0
"""Differences, in standard deviations, above which a pixel may be, and is, the person: what may be is, where it touches
what is."""
GAP = 0.006
"""Half the width of gaps that are closed, as a fraction of the image's longer side."""
OFTEN, MOST_STAYING = 0.4, 0.1
LEAST_ON_EDGES, LEAST_AREA = 0.8, 1e-3
"""Limits of what can be trusted. Two people walking by, and on the spot: on edges 0.96 to 1.00, and 0.56 to 0.79;
staying 0.00, and 0.14 to 0.61."""
LEAST_FRACTION = 0.1
"""Smaller parts than this fraction of the largest are left out."""
SHADE = (0.5, 0.97)
"""Range of brightness, as a fraction of the background's, that a shadow has."""
SHADE_SPREAD = 0.08
"""Largest spread of that share, of its mean, in a window where it is a shadow."""
_WINDOW = 5
_SMOOTH = 0.7
EDGE, HALF = 2, 0.45
"""Width of the rim of a mask, px, and the fraction of the largest difference nearby that a pixel in it has: a pixel at
the outline is a mixture."""


@dataclass(frozen=True)
class Background:
    """What a fixed camera sees without the person.

    Attributes:
        colours: (H, W, 3) float32, grey levels: the median over time.
        noise: (H, W) float32, grey levels: robust standard deviation over time of smoothed images, at least
            ``NOISE``.
    """

    colours: np.ndarray
    noise: np.ndarray


@dataclass(frozen=True)
class Separation:
    """How well masks separate a person from the background.

    Attributes:
        contrast: median difference from the background inside the masks, in its standard deviations.
        on_edges: fraction of the masks' outlines along which the image changes more than the background does: outlines
            of who is there are edges of the image, outlines of who has left are edges of the background.
        area: median fraction of the image that the masks cover.
        staying: fraction of the masks at pixels that they cover in more than ``OFTEN`` of the frames: somebody stands
            there so long that the background may be a part of them.
    """

    contrast: float
    on_edges: float
    area: float
    staying: float

    @property
    def is_clear(self) -> bool:
        """Whether the masks can be trusted."""
        return self.on_edges > LEAST_ON_EDGES and self.staying < MOST_STAYING and self.area > LEAST_AREA


def background_of(images: np.ndarray) -> Background:
    """Return the background of a fixed camera.

    Args:
        images: (F, H, W, 3) uint8, spread over time.
    """
    colours = np.median(images, axis=0).astype(np.float32)
    away = np.stack([_away(colours, image) for image in images])
    noise = 1.4826 * np.median(away, axis=0)
    typical = float(np.median(noise))  # where somebody passed often the spread is that of the person
    return Background(colours, np.clip(noise, max(NOISE, typical), 3 * max(NOISE, typical)))


def person_mask(background: Background, image: np.ndarray) -> np.ndarray:
    """Return the mask (H, W) bool of what stands before the background in an image (H, W, 3) uint8.

    Shadows are left out: there the image is the background times a number that hardly varies.
    """
    away = _difference(background, image)
    sure = ndimage.binary_opening(away > HIGH, iterations=1)
    seen = ndimage.binary_propagation(sure, mask=away > LOW) & ~_shadow(background, image)
    radius = max(1, round(GAP * max(away.shape)))
    # Closing with room around, so that who is cut off by the border is not eaten from there.
    padded = np.pad(seen, 2 * radius, mode="edge")
    closed = ndimage.binary_closing(padded, _disc(radius))[2 * radius : -2 * radius, 2 * radius : -2 * radius]
    opened = ndimage.binary_opening(ndimage.binary_fill_holes(closed), _disc(1))
    rim = opened & np.logical_not(ndimage.binary_erosion(opened, iterations=EDGE, border_value=1))
    opened = opened & np.logical_not(rim & (away < HALF * ndimage.maximum_filter(away, 2 * EDGE + 1)))
    labels = np.empty(opened.shape, np.int32)
    if not ndimage.label(opened, output=labels):
        return opened
    sizes = np.bincount(labels.ravel())[1:]
    return np.isin(labels, 1 + np.flatnonzero(sizes >= LEAST_FRACTION * sizes.max()))


def separation(background: Background, images: np.ndarray, masks: np.ndarray) -> Separation:
    """Return how well masks (F, H, W) bool separate what is in images (F, H, W, 3) uint8 from the background."""
    inside, on_edges = [], []
    slope = _slope(background.colours)
    for image, mask in zip(images, masks, strict=True):
        outline = ndimage.binary_dilation(mask) & np.logical_not(ndimage.binary_erosion(mask, border_value=1))
        if outline.any():
            inside.append(np.median(_difference(background, image)[mask]))
            on_edges.append(float((_slope(image.astype(np.float32)) > slope)[outline].mean()))
    if not inside:
        return Separation(0.0, 0.0, 0.0, 0.0)
    often = masks.mean(0) > OFTEN
    staying = float((masks & often).sum() / masks.sum())
    area = float(np.median(masks.mean((1, 2))))
    return Separation(float(np.median(inside)), float(np.mean(on_edges)), area, staying)


def _difference(background: Background, image: np.ndarray) -> np.ndarray:
    """Return the difference (H, W) from the background, in its standard deviations."""
    return _away(background.colours, image) / background.noise


def _away(colours: np.ndarray, image: np.ndarray) -> np.ndarray:
    """Return the largest difference (H, W) of any channel, smoothed, grey levels."""
    return np.abs(ndimage.gaussian_filter(image - colours, (_SMOOTH, _SMOOTH, 0))).max(-1)


def _shadow(background: Background, image: np.ndarray) -> np.ndarray:
    """Return where (H, W) the image is the background, darker."""
    smooth = ndimage.gaussian_filter(image.astype(np.float32), (_SMOOTH, _SMOOTH, 0))
    ground = ndimage.gaussian_filter(background.colours, (_SMOOTH, _SMOOTH, 0))
    ratio = smooth.mean(-1) / np.maximum(ground.mean(-1), 1.0)
    mean, spread = _mean_and_spread(ratio)
    colour = np.abs(smooth - ratio[..., None] * ground).max(-1) < LOW * background.noise
    shaded = (mean > SHADE[0]) & (mean < SHADE[1]) & (spread < SHADE_SPREAD * mean) & colour
    return ndimage.binary_opening(shaded, _disc(1))


def _mean_and_spread(values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return mean and standard deviation (H, W) in a window around each pixel."""
    mean = ndimage.uniform_filter(values, _WINDOW)
    return mean, np.sqrt(np.maximum(ndimage.uniform_filter(values**2, _WINDOW) - mean**2, 0.0))


def _slope(colours: np.ndarray) -> np.ndarray:
    """Return the largest gradient (H, W) over the channels of colours (H, W, 3), grey levels per pixel."""
    smooth = ndimage.gaussian_filter(colours, (1.0, 1.0, 0))
    down, across = np.gradient(smooth, axis=(0, 1))
    return np.hypot(down, across).max(-1)


def _disc(radius: int) -> np.ndarray:
    """Return the (2 radius + 1, 2 radius + 1) bool disc."""
    rows, columns = np.mgrid[-radius : radius + 1, -radius : radius + 1]
    return rows**2 + columns**2 <= radius**2 + radius
