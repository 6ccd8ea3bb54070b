"""Pinhole camera matrices of stored images, and their scaling with the image."""

from __future__ import annotations

import numpy as np

from dyngs.errors import DyngsError

MAX_SIDE = 2**20
"""Largest side of an image in pixels; more is taken for a mistake."""
FOCAL_RANGE = (1e-4, 1e6)
"""Plausible focal lengths, in units of the image's longer side: fields of view from 0.00006 to 179.99 degrees."""


def pinhole_matrix(fx: float, fy: float, cx: float, cy: float) -> np.ndarray:
    """Return the (3, 3) float64 camera matrix, in pixels."""
    return np.array([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]])


def scaled_intrinsics(intrinsics: np.ndarray, scale_x: float, scale_y: float) -> np.ndarray:
    """Return the (3, 3) matrix for the image scaled by the two factors; exact, as pixel centres are at (0.5, 0.5)."""
    return np.diag([scale_x, scale_y, 1.0]) @ intrinsics


def match_size(
    intrinsics: np.ndarray, described: tuple[int, int], stored: tuple[int, int] | None, where: str
) -> tuple[np.ndarray, tuple[int, int], bool]:
    """Return the intrinsics for the stored image, its (width, height), and whether they were rescaled.

    Args:
        intrinsics: (3, 3) for an image of ``described`` (width, height).
        stored: (width, height) of the file, None where it could not be opened.
        where: the image, for messages.

    Raises:
        DyngsError: another aspect ratio, so that no rescaling is right; an implausible focal length or principal point.
    """
    _check_plausible(intrinsics, described, where)
    if stored is None or stored == described:
        return intrinsics, described, False
    scale_x, scale_y = stored[0] / described[0], stored[1] / described[1]
    # Each side of a shrunk image was rounded to whole pixels: half a pixel either way is the same aspect.
    slack = max(0.5 / stored[0], 0.5 / stored[1]) + 1e-9
    if abs(scale_x / scale_y - 1) > 2 * slack:
        turned = " (turned by its EXIF tag?)" if stored == described[::-1] else ""
        raise DyngsError(
            f"{where}: the image is {stored[0]}x{stored[1]} but its intrinsics are for {described[0]}x{described[1]}"
            f"{turned}; correct the size and focal length or restore the original image"
        )
    return scaled_intrinsics(intrinsics, scale_x, scale_y), stored, True


def _check_plausible(intrinsics: np.ndarray, described: tuple[int, int], where: str) -> None:
    side = max(described)
    low, high = FOCAL_RANGE[0] * side, FOCAL_RANGE[1] * side
    fx, fy, *center = (float(intrinsics[i, j]) for i, j in ((0, 0), (1, 1), (0, 2), (1, 2)))
    if not (low <= fx <= high and low <= fy <= high):
        raise DyngsError(
            f"{where}: the focal length ({fx:g}, {fy:g}) px does not suit an image of {described[0]}x{described[1]}; "
            "correct it, or the field of view that it follows from"
        )
    if not all(abs(x) <= high for x in center):
        raise DyngsError(f"{where}: the principal point ({center[0]:g}, {center[1]:g}) px lies too far out; correct it")


def rescale_warning(where: list[str]) -> list[str]:
    """Return one line about the images whose intrinsics were rescaled, none if there are none."""
    if not where:
        return []
    return [f"{len(where)} images have another size than their intrinsics, which were rescaled; first {where[0]}"]
