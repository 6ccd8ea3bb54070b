"""EXIF tags of images: how they are rotated, the focal length, and how much light was let in."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING

import numpy as np

from dyngs.files.write import any_text

if TYPE_CHECKING:
    import OpenImageIO

_FULL_FRAME_DIAGONAL_MM = math.hypot(36, 24)
_MM_PER_UNIT = {2: 25.4, 3: 10.0}
_FOCAL_RANGE = (0.1, 20.0)
"""Plausible focal lengths in units of the image's longer side; others are taken for mistakes of a tag."""


@dataclass(frozen=True)
class PhotoTags:
    """What the camera wrote into a photo.

    Attributes:
        orientation: 1 to 8; 1 = upright, 2 to 4 = mirrored or upside down, 5 to 8 = lying.
        focal_px: focal length in pixels of the stored image.
        exposure: light let in: seconds of exposure x ISO / 100 / f-number squared, each factor 1 where its tag is
            missing; None without a time of exposure.
        model: name of the camera.
    """

    orientation: int = 1
    focal_px: float | None = None
    exposure: float | None = None
    model: str = ""


def tags_of(spec: OpenImageIO.ImageSpec) -> PhotoTags:
    """Return the tags of an opened image; those that make no sense count as missing."""
    orientation = spec.get_int_attribute("Orientation", 1)
    return PhotoTags(
        orientation if 1 <= orientation <= 8 else 1,
        _focal_px(spec),
        _exposure(spec),
        any_text(partial(spec.get_string_attribute, "Model")),
    )


def is_lying(orientation: int) -> bool:
    """Whether width and height are exchanged when an image of this orientation is rotated upright."""
    return orientation >= 5


def rotated_upright(pixels: np.ndarray, orientation: int) -> np.ndarray:
    """Return the (H, W, D) image as the orientation of EXIF says it is to be shown; exact."""
    if orientation == 1:
        return pixels
    down, across = orientation in (3, 4, 6, 7), orientation in (2, 3, 7, 8)
    rotated = pixels[:: -1 if down else 1, :: -1 if across else 1]
    return np.ascontiguousarray(rotated.swapaxes(0, 1) if is_lying(orientation) else rotated)


def _focal_px(spec: OpenImageIO.ImageSpec) -> float | None:
    """Focal length from its equivalent for 35 mm film (by the diagonals), else from the resolution of the sensor."""
    focal = None
    film = spec.get_float_attribute("Exif:FocalLengthIn35mmFilm", spec.get_int_attribute("Exif:FocalLengthIn35mmFilm"))
    millimetres = spec.get_float_attribute("Exif:FocalLength")
    density = spec.get_float_attribute("Exif:FocalPlaneXResolution")
    unit = _MM_PER_UNIT.get(spec.get_int_attribute("Exif:FocalPlaneResolutionUnit", 2))
    if film > 0:
        focal = film / _FULL_FRAME_DIAGONAL_MM * math.hypot(spec.width, spec.height)
    elif millimetres > 0 and density > 0 and unit:
        taken = spec.get_int_attribute("Exif:PixelXDimension")
        focal = millimetres * density / unit * (spec.width / taken if taken > 0 else 1.0)
    low, high = _FOCAL_RANGE
    plausible = focal is not None and low <= focal / max(spec.width, spec.height, 1) <= high
    return focal if plausible else None


def _exposure(spec: OpenImageIO.ImageSpec) -> float | None:
    seconds = spec.get_float_attribute("ExposureTime")
    if not (math.isfinite(seconds) and seconds > 0):
        return None
    sensitivity = spec.get_int_attribute("Exif:PhotographicSensitivity") or 100
    stop = spec.get_float_attribute("FNumber") or 1.0
    light = seconds * sensitivity / 100 / stop**2
    return light if math.isfinite(light) and light > 0 else None
